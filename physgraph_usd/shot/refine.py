"""Public functions: open a shot, describe, solve frame by frame, write, and report.

The solver is imported only once a shot is open and described: torch and Warp take seconds.
"""

from __future__ import annotations

import dataclasses
import time as clock
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ..errors import NOTICE, LayerError, PhysGraphError, StageError, UsageError
from ..interrupts import SIGNALLED, exit_code_of, importing, signals_noted
from ..solver.scene import Result
from ..usd.files import files_of
from ..usd.provenance import write_root
from ..usd.read.reader import Shot
from ..usd.stage import shot_name
from ..usd.view import Layer, Stage
from ..usd.write.atomic import check_folder_of
from .describe import begin_report, describe, describe_meshes, too_large
from .findings.table import FINDINGS
from .frames import kept_for
from .job import Job, check_jobs, check_new, check_of_stage, check_places, finished, open_for, results
from .options import RefineOptions, json_of, picture_of
from .report import DONE, LOG, RefineReport, is_of_failure, levels_of
from .workers import call_each, memory_is_named, shots_at_once

if TYPE_CHECKING:
    from .run import Run

DEFAULTS = RefineOptions()


def refine_shot(shot: str | Path, out: str | Path, options: RefineOptions = DEFAULTS) -> RefineReport:
    """Refine a shot's garments into a new layer.

    Args:
        shot: The stage to read; never edited.
        out: The layer to write.
        options: Options of the run.

    Returns:
        The report. Failed frames are in ``failed`` and have no sample in the layer.

    Raises:
        UsageError: An option is wrong or the output exists.
        StageError: The stage cannot be read with the options, or the result does not fit in memory.
        SolveError: No frame could be solved.
        LayerError: The layer cannot be written.
    """
    out = Path(out)
    check_jobs([(shot, out, options)])
    if report_before := finished(shot, out, options):
        return report_before
    if not options.dry_run:
        check_folder_of(out)
        check_places(out, options)
    with running(str(shot), options, out=out) as (opened, report):
        if options.dry_run:
            return report
        check_new(out, options)
        with importing():
            from .run import Run
        picture = picture_of(options)
        show_first = None if picture is None else partial(_draw_first, report, opened, options, picture)
        write_all(Run(opened, out, options, report, show_first=show_first), out)
    return report


def write_all(run: Run, out: Path) -> None:
    """Write a run's layer or chunk, and the root and report if requested.

    Args:
        run: The run.
        out: The layer, or the chunk's folder.

    Raises:
        SolveError: No frame could be solved.
        LayerError: A file cannot be written, or seams are refused.
    """
    run.refine()
    options = run.options
    if options.root is not None:
        write_root(
            Path(options.root),
            layer=out,
            shot=Path(run.shot.path),
            absolute=options.asset_paths == "absolute",
            overwrite=options.overwrite,
        )
    if options.report is not None:
        _write_report(run.report, Path(options.report), run.shot)


def refine_stage(
    stage: Stage, options: RefineOptions = DEFAULTS, *, on_report: Callable[[RefineReport], None] | None = None
) -> Layer:
    """Refine the garments of an open stage into a layer in memory.

        layer = pg.refine_stage(stage)
        stage.GetSessionLayer().subLayerPaths.insert(0, layer.identifier)

    The stage is read in its current state: session layer, unsaved edits, muted layers, variant selections, payloads and
    population. The stage and its layers are not changed.

    Args:
        stage: The open stage.
        options: Options of the run. An open stage lives in one process and the result in memory, so ``workers``,
            ``resume``, ``dry_run``, ``root`` and a folder for the report are refused; a report's JSON file is written.
        on_report: Called with the report, also of a failed run.

    Returns:
        An anonymous layer, to be sublayered over the stage or exported; keep a reference as long as a stage uses the
        layer. Failed frames have no sample in the layer: they are in the report's ``failed`` and the layer's
        ``customLayerData["physgraph"]["failed"]``.

    Raises:
        UsageError: An option is wrong, or not applicable to an open stage.
        StageError: The stage cannot be read with the options, or the result does not fit in memory.
        SolveError: No frame could be solved.
        LayerError: The layer is invalid, or the report cannot be written.
    """
    check_of_stage(stage, options)
    with running(stage, options, on_report=on_report) as (opened, report):
        with importing():
            from .run import Run
        layer = Run(opened, None, options, report).refine()
        if options.report is not None:
            _write_report(report, Path(options.report), opened)
    assert layer is not None
    return layer


@contextmanager
def running(
    shot: str | Stage,
    options: RefineOptions,
    *,
    out: Path | None = None,
    on_report: Callable[[RefineReport], None] | None = None,
) -> Iterator[tuple[Shot, RefineReport]]:
    """Open a shot and begin its report; a run ended by a signal or any exception writes the report if requested."""
    report = RefineReport(shot_name(shot), None, options.plain(), options.value_sources())
    began = clock.perf_counter()
    with ExitStack() as ends:
        if on_report is not None:
            ends.callback(on_report, report)
        ends.push(partial(_record_end, report, options, out))
        with signals_noted(), memory_is_named(), closing(open_for(shot, options)) as opened:
            warnings = begin_report(report, opened, options)
            report.seconds["open"] = clock.perf_counter() - began
            if large := too_large(opened, report, options):
                raise large
            with importing():
                from ..solver.integrate.factors import FACTOR
            report.warn(*warnings, *([] if FACTOR == "cholespy" else [FINDINGS["slower"]()]))
            yield opened, report


def _record_end(
    report: RefineReport,
    options: RefineOptions,
    out: Path | None,
    kind: type[BaseException] | None,
    error: BaseException | None,
    trace: TracebackType | None,
) -> None:
    """Record the exception or signal that ends a run, and write the report if requested; the exception goes on.

    A protected file is not written, and errors here give way to the run's error.
    """
    if isinstance(error, Exception):
        report.fail(error)
    elif (code := exit_code_of(error)) is not None:
        folder_text = None if out is None else kept_for(out)
        report.signal, report.error = code - SIGNALLED, f"interrupted, {folder_text or 'no frame is kept'}"
    else:
        return
    if options.report is not None and not options.dry_run:
        file = json_of(Path(options.report))
        with suppress(LayerError):
            if options.overwrite or not file.exists() or is_of_failure(file):
                report.write(file)


def refine_shots(
    jobs: Sequence[Job], *, workers: int, refine: Callable[..., RefineReport] = refine_shot
) -> Iterator[RefineReport | PhysGraphError]:
    """Refine several shots, each in a separate process: a failed or dead process does not affect the rest.

    Args:
        jobs: Shot, layer to write and options of each.
        workers: Shots at a time; with a scheduler, chunks of each shot, and as many shots as keep its workers busy.
        refine: Refines one shot; must be picklable.

    Returns:
        Per job, in order, the report or the error.

    Raises:
        UsageError: No job was begun: an option is wrong, or an output of a job is read or written by another job.
    """

    from ..solver.mesh.kernels import cards_for

    def solve(left: Sequence[Job]) -> Generator[RefineReport | PhysGraphError, None, None]:
        options = left[0][2] if left else DEFAULTS
        chunks, at_once = 1, workers
        if options.scheduler:
            chunks, at_once = workers, shots_at_once(options.scheduler, workers)
        calls = [
            (shot, out, dataclasses.replace(job_options, workers=chunks, progress=None))
            for shot, out, job_options in left
        ]
        return call_each(refine, calls, workers=at_once, cards=cards_for(options.device))

    return results(jobs, solve)


def inspect_shot(shot: str | Path | Stage, *, timed: bool = False, **reading: Any) -> dict[str, Any]:
    """Plan of a refinement: garments, values and their sources, and every defect found.

    Args:
        shot: The stage to read, a file or open.
        timed: Whether to solve three frames in the middle of the shot, to measure the time of a run on this machine and
            how far from rest frames end.
        reading: Options of `RefineOptions` for reading.

    Returns:
        Plain values. If the shot cannot be refined as asked, ``problem`` gives the reason, ``meshes`` lists the stage's
        meshes, and ``exit_code`` is 0 if ``command`` names what to refine, 2 if a named garment or collider is missing,
        else 1.

    Raises:
        StageError: The file cannot be opened at all.
        UsageError: An option is wrong.
    """
    options = RefineOptions(**reading)
    source = str(shot) if isinstance(shot, Path) else shot
    files_of(source)  # Raises an error for a pipe; opening a pipe would wait for ever.
    try:
        with closing(open_for(source, options)) as opened:
            plan = describe(opened, options)
            if timed and "problem" not in plan:
                from .solve import time_frames

                plan |= time_frames(opened, options, levels_of(plan["garments"]))
            return plan
    except StageError as error:
        plan = describe_meshes(source, str(error), options)
        return plan | {"exit_code": DONE if "command" in plan else error.exit_code}


def _write_report(report: RefineReport, path: Path, opened: Shot) -> None:
    if json_of(path) == path:
        report.write(path)
    else:
        from .page.report import write_folder

        write_folder(report, path, opened)


def _draw_first(report: RefineReport, opened: Shot, options: RefineOptions, picture: Path, result: Result) -> None:
    """Draw the first refined frame; a picture that cannot be drawn is a warning, because the frames are worth more."""
    from .page.frames import draw_frames

    try:
        draw_frames(opened, levels_of(report.garments), [result], picture, options=options, overwrite=options.overwrite)
        LOG.log(NOTICE, "%s shows the first frame", picture, extra={"shot": report.shot})
    except (LayerError, StageError, UsageError) as error:
        report.warn(FINDINGS["undrawn"](picture=picture, error=error))
