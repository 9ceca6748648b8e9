"""A job: a shot, the layer to write and options. Checks jobs, opens their shots, and detects those with nothing to do.

A job has nothing to do if its layer exists and is kept, or was made from the same files, options and version. The check
works without the solver, whose libraries take seconds to import.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from ..errors import PhysGraphError, UsageError
from ..usd.files import LAYER_SUFFIXES, Target, check_suffix, check_targets, files_of
from ..usd.provenance import asset_path, file_hashes, is_result_of, mute_refined, unsaved_layers
from ..usd.read.reader import Shot
from ..usd.stage import open_stage
from ..usd.view import Stage
from ..usd.write.atomic import check_place
from ..version import __version__, code_digest
from .findings.table import FINDINGS
from .findings.untagged import open_with_colliders
from .frames import frames_folder
from .options import PICTURE, RefineOptions, json_of
from .report import LOG, RefineReport, is_of_failure

Job = tuple[str | Path, Path, RefineOptions]
"""A shot, the layer to write and options."""


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
        stage, _ = open_stage(report.shot)
        mute_refined(stage)
        wanted = _record(stage, report.shot, unsaved_layers(stage), out, options)
    except PhysGraphError:  # The run itself will raise the error.
        return None
    if not is_result_of(out, wanted, settled=options.strict):
        return None
    report.warn(FINDINGS["taken_as_done"](out=out))
    report.out = out
    return report


def made_from(opened: Shot, out: Path | None, options: RefineOptions) -> dict[str, Any]:
    """Everything the layer depends on, for its record: version, code, options, the shot and hashes of its files."""
    path = None if opened.view.root.anonymous else opened.path
    return _record(opened.stage, path, opened.unsaved, out, options)


def _record(
    stage: Stage, path: str | None, unsaved: Sequence[str], out: Path | None, options: RefineOptions
) -> dict[str, Any]:
    folder, absolute = out and out.resolve().parent, options.asset_paths == "absolute"
    return {
        "version": __version__,
        "code": code_digest(),
        "options": options.plain(),
        "shot": None if path is None else asset_path(path, folder, absolute=absolute),
        "inputs": file_hashes(stage, folder, absolute=absolute),
        "unsaved": list(unsaved) or None,
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

    def in_order() -> Generator[RefineReport | PhysGraphError, None, None]:
        with closing(solved):
            for report in reports:
                yield next(solved) if report is None else report

    return in_order()


def check_places(out: Path, options: RefineOptions) -> None:
    """Refuse unwritable outputs before the work, not after an hour of frames."""
    if not options.resume:
        check_new(out, options)
    for _, path in options.targets(out):
        if path != out or options.preroll is None:  # A chunk is a folder.
            check_place(path)


def check_new(out: Path, options: RefineOptions) -> None:
    """Refuse (UsageError) outputs that exist, unless they may be replaced."""
    for _, path in options.targets(out):
        _check_none(path, options)


def _check_none(path: Path, options: RefineOptions) -> None:
    if path.is_file() and not (options.overwrite or is_of_failure(path)):
        raise UsageError(f"{path} exists; choose another name or replace it by --overwrite")


def check_of_stage(stage: Stage, options: RefineOptions) -> None:
    """Refuse options not applicable to an open stage, and a report over a file of the stage."""
    options.check()
    if options.workers > 1:
        raise UsageError(f"workers is {options.workers}: an open stage lives in one process; save it, or take 1")
    for name in ("resume", "dry_run", "root", "scheduler", "preroll", "preview"):
        if getattr(options, name):
            raise UsageError(f"{name} is for layers on disk; an open stage is refined into a layer in memory")
    if options.report is not None:
        report = Path(options.report)
        if json_of(report) != report:
            raise UsageError(f"the report of an open stage is a file: {report} does not end with .json")
        check_targets([("the report", report)], files_of(stage))
        check_place(report)
        _check_none(report, options)


def open_for(shot: str | Stage, options: RefineOptions) -> Shot:
    """Open a shot with the reading options.

    Raises:
        UsageError: An option cannot be used.
        StageError: The stage cannot be read.
    """
    return open_with_colliders(
        shot,
        garments=options.garments,
        colliders=options.colliders,
        bind=options.bind,
        frames=options.frames if options.preroll is None else None,
        level=options.level,
        overrides=options.overrides,
        rest_frame=options.rest_frame,
        gravity=options.gravity,
    )
