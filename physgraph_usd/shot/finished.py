"""Detects runs with nothing to do: the layer exists and is kept, or was made from the same files, options and version.

The check works without the solver, whose libraries take seconds to import.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import PhysGraphError, UsageError
from ..usd.files import LAYER_SUFFIXES, Target, check_suffix, check_targets, files_of
from ..usd.provenance import asset_path, file_hashes, is_result_of, mute_refined, unsaved_layers
from ..usd.stage import open_stage
from ..usd.view import StageView
from ..version import __version__, code_digest
from .findings.table import FINDINGS
from .frames import frames_folder
from .options import PICTURE, RefineOptions
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
            exist, no unfinished frames do, and the layer's record names the same inputs.
    """
    report = RefineReport(str(shot), None, options.plain(), options.value_sources())
    if options.skip_existing and out.is_file():
        LOG.info("skipped: %s is there", out, extra={"shot": report.shot})
        report.out, report.skipped = out, True
        return report
    complete = options.resume and all(path.is_file() for name, path in options.targets(out) if name != PICTURE)
    if options.dry_run or not complete or frames_folder(out).exists():
        return None
    try:
        wanted = made_from(_Opened(report.shot), out, options)
    except PhysGraphError:  # The run itself will raise the error.
        return None
    if not is_result_of(out, wanted, settled=options.strict):
        return None
    report.warn(FINDINGS["taken_as_done"](out=out))
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
        for result, path in (("the layer", out), ("the root", options.root)):
            if path is not None and (options.preroll is None or path is not out):
                check_suffix(result, Path(path), LAYER_SUFFIXES)
        if options.preroll is not None and out.suffix in LAYER_SUFFIXES:
            raise UsageError(f"{out} is a layer's name, and a chunk is a folder of finished frames; name one by -o")
        targets += options.targets(out)
        skipped = options.skip_existing and out.is_file()  # Skipped: no file is opened or replaced.
        inputs |= ({Path(shot)} if skipped else files_of(shot)) | {Path(file) for file in (options.weights,) if file}
    check_targets(targets, inputs)


def results(
    jobs: Sequence[Job], solve: Callable[[list[Job]], Generator[RefineReport | PhysGraphError, None, None]]
) -> Generator[RefineReport | PhysGraphError, None, None]:
    """Results of jobs in order, without solving the finished ones.

    Args:
        jobs: Shot, layer to write and options of each.
        solve: Yields the results of the unfinished jobs.

    Raises:
        UsageError: As in `check_jobs`; no job was begun.
    """
    check_jobs(jobs)
    reports = [finished(*job) for job in jobs]
    solved = solve([job for job, report in zip(jobs, reports, strict=True) if report is None])

    def each() -> Generator[RefineReport | PhysGraphError, None, None]:
        with closing(solved):
            for report in reports:
                yield next(solved) if report is None else report

    return each()
