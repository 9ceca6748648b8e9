"""Detects runs with nothing to do: the layer exists and is kept, or was made from the same files, options and version.

The check works without the solver, whose libraries take seconds to import.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import PhysGraphError, UsageError
from ..usd.files import LAYER_SUFFIXES, Target, check_suffix, check_targets, files_of
from ..usd.provenance import asset_path, file_hashes, is_result_of, mute_refined, unsaved_layers
from ..usd.stage import open_stage
from ..usd.view import StageView
from ..version import __version__, code_digest
from .frames import frames_folder
from .options import RefineOptions
from .report import LOG, RefineReport

if TYPE_CHECKING:
    from ..usd.read.reader import Shot

Job = tuple[str | Path, Path, RefineOptions]
"""A shot, the layer to write and options."""


class _Opened:
    """A shot's stage, opened for its files alone."""

    def __init__(self, shot: str) -> None:
        self.path, (self.stage, _) = shot, open_stage(shot)
        self.view = StageView.of(self.stage)
        mute_refined(self.stage)
        self.unsaved = unsaved_layers(self.stage)


def finished(shot: str | Path, out: Path, options: RefineOptions) -> RefineReport | None:
    """The report of a shot with nothing left to refine, or None.

    Args:
        shot: Input file.
        options: With ``skip_existing``, an existing layer is kept. With ``resume``, the layer is kept if all outputs
            exist and the layer's record names the same inputs.
    """
    if there := skipped(shot, out, options):
        return there
    if options.dry_run or not may_be_done(out, options):
        return None
    try:
        wanted = made_from(_Opened(str(shot)), out, options)
    except PhysGraphError:  # The run itself will raise the error.
        return None
    if not is_result_of(out, wanted, settled=options.strict):
        return None
    return taken_as_done(RefineReport(str(shot), None, options.plain(), options.value_sources()), out)


def skipped(shot: str | Path, out: Path, options: RefineOptions) -> RefineReport | None:
    """The report of a shot whose existing layer is kept, or None."""
    if not options.skip_existing or not out.is_file():
        return None
    LOG.info("skipped: %s is there", out, extra={"shot": str(shot)})
    return RefineReport(str(shot), out, options.plain(), options.value_sources(), skipped=True)


def may_be_done(out: Path, options: RefineOptions) -> bool:
    """Whether a resumed run left all outputs and no unfinished frames."""
    made = options.resume and all(path.is_file() for _, path in options.targets(out))
    return made and not frames_folder(out).exists()


def taken_as_done(report: RefineReport, out: Path) -> RefineReport:
    """The report of a run whose layer exists."""
    report.warn(f"{out} is taken as done: the same files, options and version made it")
    report.out = out
    return report


def made_from(opened: Shot | _Opened, out: Path | None, options: RefineOptions) -> dict[str, Any]:
    """Everything the layer depends on, for its record: version, code, options, the shot and hashes of its files."""
    folder, absolute = out and out.resolve().parent, options.asset_paths == "absolute"
    return {
        "version": __version__,
        "code": code_digest(),
        "options": options.plain(),
        "shot": None if opened.view.root.anonymous else asset_path(opened.path, folder, absolute=absolute),
        "inputs": file_hashes(opened.stage, folder, absolute=absolute),
        "unsaved": list(opened.unsaved) or None,
    }


def check_jobs(jobs: Sequence[Job], *, also: Sequence[Target] = ()) -> None:
    """Refuse invalid options, and outputs over files read or written by any job.

    Args:
        jobs: Shot, layer to write and options of each.
        also: Further files to be written.

    Raises:
        UsageError: Names the value, or the file.
    """
    targets = [*also]
    inputs: set[Path] = set()
    for shot, out, options in jobs:
        options.check()
        for what, path in (("the layer", out), ("the root", options.root)):
            if path is not None and (options.preroll is None or path is not out):
                check_suffix(what, Path(path), LAYER_SUFFIXES)
        if options.preroll is not None and out.suffix in LAYER_SUFFIXES:
            raise UsageError(f"{out} is a layer's name, and a chunk is a folder of finished frames; name one by -o")
        targets += options.targets(out)
        left = options.skip_existing and out.is_file()  # Skipped: no file is opened or replaced.
        inputs |= ({Path(shot)} if left else files_of(shot)) | {Path(file) for file in (options.weights,) if file}
    check_targets(targets, inputs)


def in_order(
    found: Sequence[RefineReport | None], done: Generator[RefineReport | PhysGraphError, None, None]
) -> Iterator[RefineReport | PhysGraphError]:
    """Results of jobs in order: the report of a job finished before, else the next result of ``done``."""
    with closing(done):
        for there in found:
            yield next(done) if there is None else there
