"""`refine_shot`: the one place where USD meets the solver; picks device, dtype and threads."""

from __future__ import annotations

import dataclasses
import os
import sys
import time as clock
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import torch

from ..errors import NOTICE, LayerError, PhysGraphError, SolveError, StageError, UsageError, counted
from ..interrupts import SIGNALLED, exit_code_of, signals_raise
from ..solver.frame.lead_in import cages_walked
from ..solver.frame.refiner import Refiner
from ..solver.integrate.metric import FACTOR
from ..solver.level import refine_garments
from ..solver.mesh.threads import kernels_are_kept, start_warp
from ..usd.files import check_targets, files_of
from ..usd.provenance import CROSSED, FAILED, UNSETTLED, UNSOLVED, is_result_of, write_root
from ..usd.read.reader import Shot
from ..usd.stage import shot_name
from ..usd.view import Layer, Stage
from ..usd.write.atomic import check_place
from ..usd.write.chunk import Chunk, chunk_of
from ..usd.write.writer import LayerWriter
from .chunks import PREROLL, solve_in_chunks
from .describe import begin_report, describe, describe_meshes, say_what_was, too_large
from .farm import connected, shots_at_once
from .finished import Job, check_jobs, finished, in_order, made_from, may_be_done, skipped, taken_as_done
from .frames import FrameFolder, Outcome, frames_folder, kept_for
from .joined import SafeMover, joined
from .options import RefineOptions, json_of
from .page.report import write_folder
from .processes import call_each, memory_is_named
from .report import LOG, RefineReport, is_of_failure
from .settled import unsettled_frames
from .untagged import AUTO, open_with_colliders
from .warnings import WARNINGS, of_frames

try:
    import resource
except ImportError:  # Windows has none.
    resource = None
MOST_THREADS = 4
"""Threads beyond which a frame's kernels gain nothing: the metric's solve stays on one."""
TIMED_FRAMES, LONG_RUN = 3, 60.0
"""Frames after which a run says when it will end, where that is so far away [s]."""
DEFAULTS = RefineOptions()
Outcomes = Generator[Outcome, None, None]


def refine_shot(shot: str | Path, out: str | Path, options: RefineOptions = DEFAULTS) -> RefineReport:
    """Refine a shot's garments into a new layer.

    Args:
        shot: The stage to read; never edited.
        out: The layer to write.
        options: What to do and how.

    Returns:
        The report. Frames that could not be solved are in ``failed`` and have no sample in the layer.

    Raises:
        UsageError: An option is wrong or the output exists.
        StageError: The stage cannot be read as asked, or what it makes does not fit in memory.
        SolveError: No frame could be solved.
        LayerError: The layer cannot be written.
    """
    out = Path(out)
    check_jobs([(shot, out, options)])
    if there := skipped(shot, out, options):
        return there
    if not options.dry_run:
        _check_places(out, options)
    with _run(str(shot), options, out=out) as (opened, report):
        if options.dry_run:
            return report
        if may_be_done(out, options) and is_result_of(out, made_from(opened, out, options), settled=options.strict):
            return taken_as_done(report, out)
        _check_new(out, options)
        _refine(opened, out, options, report)
        if options.root is not None:
            files = {"layer": out, "shot": Path(shot), "absolute": options.asset_paths == "absolute"}
            write_root(Path(options.root), **files, overwrite=options.overwrite)
        if options.report is not None:
            _write_report(report, Path(options.report), opened)
    return report


def refine_stage(
    stage: Stage, options: RefineOptions = DEFAULTS, *, on_report: Callable[[RefineReport], None] | None = None
) -> Layer:
    """Refine the garments of an open stage into a layer in memory.

        layer = pg.refine_stage(stage)
        stage.GetSessionLayer().subLayerPaths.insert(0, layer.identifier)

    The stage is read as it stands: session layer, edits that are not saved, muted layers, variant selections, payloads
    and population. Neither it nor any of its layers is changed.

    Args:
        stage: The open stage.
        options: What to do and how. An open stage lives in one process and its result in memory, so ``workers``,
            ``resume``, ``dry_run``, ``root`` and a folder for the report are refused; a report's JSON file is written.
        on_report: Called with the report, also of a run that failed.

    Returns:
        An anonymous layer, to be laid over the stage or exported; keep it alive as long as a stage names it. Frames
        that could not be solved have no sample in it: they are in the report's ``failed`` and the layer's
        ``customLayerData["physgraph"]["failed"]``.

    Raises:
        UsageError: An option is wrong, or of no use here.
        StageError: The stage cannot be read as asked, or what it makes does not fit in memory.
        SolveError: No frame could be solved.
        LayerError: The layer is invalid, or the report cannot be written.
    """
    _check_of_stage(stage, options)
    with _run(stage, options, on_report=on_report) as (opened, report):
        layer = _refine(opened, None, options, report)
        if options.report is not None:
            _write_report(report, Path(options.report), opened)
    assert layer is not None
    return layer


@contextmanager
def _run(
    shot: str | Stage,
    options: RefineOptions,
    *,
    out: Path | None = None,
    on_report: Callable[[RefineReport], None] | None = None,
) -> Iterator[tuple[Shot, RefineReport]]:
    """Open a shot and begin its report; a run that fails or is interrupted writes it where it was asked for."""
    report = RefineReport(shot_name(shot), None, options.plain(), options.value_sources())
    began = clock.perf_counter()
    try:
        with signals_raise(), memory_is_named(), closing(_open(shot, options)) as opened:
            warnings = begin_report(report, opened, options, before_a_run=options.dry_run)
            report.seconds["open"] = clock.perf_counter() - began
            if large := too_large(opened, report, options):
                raise large
            report.warn(*warnings, *([] if FACTOR == "cholespy" else [WARNINGS["slower"]()]))
            yield opened, report
    except PhysGraphError as error:
        report.error = str(error)
        if not isinstance(error, UsageError):
            _write_failure(report, options)
        raise
    except (KeyboardInterrupt, SystemExit) as error:
        if (code := exit_code_of(error)) is not None:
            kept = None if out is None else kept_for(out)
            report.signal, report.error = code - SIGNALLED, f"interrupted, {kept or 'no frame is kept'}"
            _write_failure(report, options)
        raise
    finally:
        if on_report is not None:
            on_report(report)


def _refine(opened: Shot, out: Path | None, options: RefineOptions, report: RefineReport) -> Layer | None:
    """Solve and write all frames; returns the layer where it is in memory."""
    began = clock.perf_counter()
    if not kernels_are_kept():
        LOG.info("kernels are compiled, once on this machine: some 15 s; physgraph-usd warm-up does it ahead")
    named = dataclasses.replace(options, colliders=opened.colliders) if AUTO in options.colliders else options
    solver = _ShotSolver(opened.path, [garment["level"] for garment in report.garments], named)
    solver.adopt(opened)
    layer = _write_layer(opened, solver, out, options, report=report)
    report.seconds["total"] = report.seconds["open"] + clock.perf_counter() - began
    report.peak_memory_mb = _peak_memory_mb()
    report.out = out
    return layer


def refine_shots(
    jobs: Sequence[Job], *, workers: int, refine: Callable[..., RefineReport] = refine_shot
) -> Iterator[RefineReport | PhysGraphError]:
    """Refine several shots, each in a process of its own: one that fails, or dies, leaves the others alone.

    Args:
        jobs: Shot, layer to write and options of each.
        workers: Shots at a time; with a scheduler, chunks of each shot, and as many shots as keep its workers busy.
        refine: What refines one of them; it must be picklable.

    Returns:
        Per job, in order, its report or the error that ended it.

    Raises:
        UsageError: No job was begun: an option is wrong, or a file to write is one that another job reads or writes.
    """
    check_jobs(jobs)
    scheduler = jobs[0][2].scheduler if jobs else None
    chunks, at_once = (workers, shots_at_once(scheduler, workers)) if scheduler else (1, workers)
    found = [finished(*job) for job in jobs]
    alone = [
        (shot, out, dataclasses.replace(options, workers=chunks, progress=None))
        for (shot, out, options), there in zip(jobs, found, strict=True)
        if there is None
    ]
    return in_order(found, call_each(refine, alone, workers=at_once))


def _check_places(out: Path, options: RefineOptions) -> None:
    """Refuse before the work, not after an hour of frames, what could not be written then."""
    if not out.resolve().parent.is_dir():
        raise LayerError(f"the folder {out.resolve().parent} does not exist")
    if not options.resume:
        _check_new(out, options)
    for _, path in options.targets(out):
        check_place(path)


def _check_new(out: Path, options: RefineOptions) -> None:
    for _, path in options.targets(out):
        _check_none(path, options)


def _check_none(path: Path, options: RefineOptions) -> None:
    if path.is_file() and not (options.overwrite or is_of_failure(path)):
        raise UsageError(f"{path} exists; choose another name or replace it by --overwrite")


def _check_of_stage(stage: Stage, options: RefineOptions) -> None:
    """Refuse what an open stage cannot be refined with, and to write the report over a file that it is made of."""
    options.check()
    if options.workers > 1:
        raise UsageError(f"workers is {options.workers}: an open stage lives in one process; save it, or take 1")
    for name in ("resume", "dry_run", "root", "scheduler", "preroll"):
        if getattr(options, name):
            raise UsageError(f"{name} is for layers on disk; an open stage is refined into a layer in memory")
    if options.report is not None:
        report = Path(options.report)
        if json_of(report) != report:
            raise UsageError(f"the report of an open stage is a file: {report} does not end with .json")
        check_targets([("the report", report)], files_of(stage))
        check_place(report)
        _check_none(report, options)


def inspect_shot(shot: str | Path | Stage, *, timed: bool = False, **given: Any) -> dict[str, Any]:
    """What would be refined, with what, from where, and every defect found.

    Args:
        shot: The stage to read, a file or open.
        timed: Whether to solve two frames in the middle of the shot, for what a run takes on this machine.
        given: Options of `RefineOptions` that concern reading.

    Returns:
        Plain values. Where the shot cannot be refined as asked, ``problem`` says why, ``meshes`` lists what is there,
        and ``exit_code`` is 2 where a garment or collider that was named is not there, else 1.

    Raises:
        StageError: The file cannot be opened at all.
        UsageError: An option is wrong.
    """
    options = RefineOptions(**given)
    source = str(shot) if isinstance(shot, Path) else shot
    try:
        with closing(_open(source, options)) as opened:
            found = describe(opened, options)
            return found | ({"timed": _timed(opened, found, options)} if timed and "problem" not in found else {})
    except StageError as error:
        return describe_meshes(source, str(error), options) | {"exit_code": error.exit_code}


def _timed(opened: Shot, found: dict[str, Any], options: RefineOptions) -> dict[str, float]:
    """Wall time of a frame from nothing, of the one after it, and of the whole shot by these [s]."""
    prepare_device(options.device)
    levels = [garment["level"] for garment in found["garments"]]
    own = {"device": options.device, "threads": min(MOST_THREADS, max(1, os.cpu_count() or 1))}
    refiner = Refiner(opened.scene, options.solve_settings(), levels=levels, **own)
    times, spent = list(opened.scene.times) or [None], []
    middle = (len(times) - 1) // 2
    for time in times[middle : middle + 2]:
        began = clock.perf_counter()
        refiner.solve(opened.frame(time))
        spent.append(clock.perf_counter() - began)
    whole = spent[0] + spent[-1] * (len(times) - 1)
    seconds = {"first_frame_seconds": spent[0], "seconds_a_frame": spent[-1], "whole_shot_seconds": whole}
    return {name: float(f"{value:.3g}") for name, value in seconds.items()}


def _open(shot: str | Stage, options: RefineOptions) -> Shot:
    """Open a shot with the options that concern reading."""
    return open_with_colliders(
        shot,
        garments=options.garments,
        colliders=options.colliders,
        frames=options.frames if options.preroll is None else None,
        level=options.level,
        overrides=options.overrides,
        rest_frame=options.rest_frame,
    )


class _ShotSolver:
    """Solves time codes of a shot; opens the shot for itself where it was not handed one.

    Attributes:
        levels: Subdivisions of each garment.
    """

    def __init__(self, shot: str, levels: list[int], options: RefineOptions) -> None:
        self.levels = levels
        self._shot, self._options = shot, dataclasses.replace(options, progress=None)
        self._threads = min(MOST_THREADS, max(1, (os.cpu_count() or 1) // options.workers))
        self._opened: Shot | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the stage behind, since each process opens its own, perhaps in another folder."""
        weights = self._options.weights
        options = self._options if weights is None else dataclasses.replace(self._options, weights=weights.absolute())
        return self.__dict__ | {"_opened": None, "_shot": os.path.abspath(self._shot), "_options": options}

    def adopt(self, opened: Shot) -> None:
        """Use an open shot in this process."""
        self._opened = opened

    def __call__(self, times: Sequence[float | None]) -> Outcomes:
        """Solve time codes in order; one that fails yields its error, and the next starts from the last good one."""
        device = self._options.device
        prepare_device(device)
        shot = self._opened = self._opened or _open(self._shot, self._options)
        settings = self._options.solve_settings()
        options = {"device": device, "threads": self._threads, "heat_map": self._options.heat_map}
        refiner = Refiner(shot.scene, settings, levels=self.levels, **options)
        self._lead_in(shot, refiner, times)
        for time in times:
            began = clock.perf_counter()
            try:
                frame = shot.frame(time)
                read_ms = round(1e3 * (clock.perf_counter() - began), 3)
                state = refiner.solve(frame, sampled_at(shot, time))
            except (SolveError, StageError) as error:
                yield Outcome(time, (), (), {"time": time, "error": str(error)})
                continue
            record = {"time": time, "read_ms": read_ms, "garments": list(state.telemetry)}
            yield Outcome(time, state.points, state.reused, record, state.heat)

    def _lead_in(self, shot: Shot, refiner: Refiner, times: Sequence[float | None]) -> None:
        """Begin in the middle of a shot, where its cage crosses, with the cage walked there from an earlier frame."""
        earlier = [] if not times or times[0] is None else shot.times_until(times[0])
        own = {"times": earlier, "device": self._options.device, "threads": self._threads}
        found = cages_walked(shot.scene, self._options.solve_settings(), shot.frame, **own)
        if found is not None:
            refiner.begin_at(found[0], since=found[1])


def sampled_at(shot: Shot, time: float | None) -> list[bool]:
    """For each garment, whether the layer gets a sample at a time code: its own authored times, or the first of all."""
    first = shot.scene.times[0] if shot.scene.times else None
    return [time in source.times if source.times else time == first for source in shot.sources]


def prepare_device(device: str) -> None:
    """Start Warp, and keep torch on one thread: its sums depend on how many share them.

    Raises:
        UsageError: CUDA was asked for and is not there.
    """
    start_warp()
    torch.set_num_threads(1)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError("device 'cuda' was asked for and no CUDA device is there; use --device cpu")


def _write_layer(
    opened: Shot, solver: _ShotSolver, out: Path | None, options: RefineOptions, *, report: RefineReport
) -> Layer | None:
    """Solve and write all frames; returns the layer where it is in memory."""
    chunk = None if options.preroll is None else chunk_of(opened.scene.times, options.frames)
    times, leads = _to_solve(opened, chunk, options)
    began, provenance = clock.perf_counter(), made_from(opened, out, options)
    known = len(opened.warnings)  # What is said of the shot itself has been.
    made = {"mode": options.mode, "velocities": options.velocities, "overwrite": options.overwrite, "chunk": chunk}
    refinements = refine_garments(opened.scene.garments, solver.levels)
    with ExitStack() as stack:
        frames = None if out is None else stack.enter_context(_frames(solver, times, out, options, provenance))
        writer = stack.enter_context(LayerWriter(opened, refinements, out, provenance=provenance, **made))
        solved = solver(times) if frames is None else _solved(opened, solver, times, frames, options, report=report)
        stack.enter_context(closing(solved))
        for _ in range(leads):
            _begin_after(next(solved), writer)
        _write_frames(writer, solved, len(times) - leads, options, report=report)
        layer = writer.layer if out is None else None
    report.strict = options.strict
    report.seconds["frames"] = clock.perf_counter() - began
    report.warn(*map(str, opened.warnings[known:]))
    return layer


def _write_frames(
    writer: LayerWriter,
    solved: Outcomes,
    count: int,
    options: RefineOptions,
    *,
    report: RefineReport,
) -> None:
    """Write each frame as it comes, then close the layer."""
    written, shot, began = 0.0, {"shot": report.shot}, clock.perf_counter()
    for done, outcome in enumerate(solved, start=1):
        written += _take(outcome, writer, report)
        LOG.info("frame %d of %d: time code %s", done, count, _time_name(outcome.time), extra=shot)
        if done == TIMED_FRAMES < count and (said := ending(clock.perf_counter() - began, count, options.workers)):
            LOG.log(NOTICE, "%s", said, extra=shot)
        LOG.debug("%s", outcome.record, extra=shot)
        if options.progress:
            options.progress(done, count)
    if len(report.failed) == count:
        raise SolveError(next(iter(report.failed.values())))
    report.unsettled = unsettled_frames(report.garments, report.frames, tolerance=options.tolerance)
    start = clock.perf_counter()
    lacking = {
        FAILED: list(report.failed) or None,
        UNSOLVED: sum(bool(entry["error"]) for entry in report.unsettled) or None,
        UNSETTLED: len(report.unsettled) or None,
        CROSSED: report.crossings if report.leaves_crossings else None,
    }
    writer.close(lacking=lacking)
    report.seconds["close"] = clock.perf_counter() - start
    report.seconds["write"] = written
    report.warn(*map(str, writer.notices), *of_frames(report))
    say_what_was(report)


def ending(seconds: float, count: int, workers: int) -> str:
    """When a run will end, or "" where that is soon.

    Args:
        seconds: What the first `TIMED_FRAMES` frames took [s].
        count: Frames of the run.
        workers: Processes that share them; the first one's frames are the first to come.
    """
    own = -(-count // workers) - TIMED_FRAMES
    left = own * seconds / TIMED_FRAMES
    if left < LONG_RUN:
        return ""
    at = clock.strftime("%H:%M", clock.localtime(clock.time() + left))
    about = f"{left / 60.0:.0f} min" if left < 5400.0 else f"{left / 3600.0:.1f} h"
    return f"{TIMED_FRAMES} of {count} frames in {seconds:.0f} s: all in about {about} more, at {at}"


def _frames(
    solver: _ShotSolver, times: list[float | None], out: Path, options: RefineOptions, provenance: dict[str, Any]
) -> FrameFolder:
    """The folder of a run's finished frames."""
    run = provenance | {"levels": solver.levels, "times": times, "report": options.report is not None}
    kept = {"resume": options.resume, "drop": options.overwrite, "keep": options.keep_frames}
    return FrameFolder(frames_folder(out), run, **kept)


def _solved(
    opened: Shot,
    solver: _ShotSolver,
    times: list[float | None],
    frames: FrameFolder,
    options: RefineOptions,
    *,
    report: RefineReport,
) -> Outcomes:
    """Frames in order, those of an interrupted run among them, joined where several processes solved them."""
    preroll = _preroll(options)
    report.warn(*_resumed(frames, len(times), preroll))
    mover = SafeMover(opened, options, solver.levels)
    with connected(options.scheduler) if options.scheduler else nullcontext() as farm:
        solved = solve_in_chunks(solver, times, frames, workers=options.workers, preroll=preroll, start=farm)
        with closing(solved):
            yield from joined(solved, mover, report.warn)


def _preroll(options: RefineOptions) -> int:
    """Frames solved before a chunk, where frames depend on one another."""
    asked = PREROLL if options.preroll is None else options.preroll
    return 0 if options.temporal == "off" else asked


def _to_solve(opened: Shot, chunk: Chunk | None, options: RefineOptions) -> tuple[list[float | None], int]:
    """Time codes to solve, in order, and how many of the first are the pre-roll of a chunk."""
    every: list[float | None] = list(opened.scene.times) or [None]
    if chunk is None or not chunk.times:
        return every, 0
    first = every.index(chunk.times[0])
    lead = min(first, _preroll(options))
    return every[first - lead : first + len(chunk.times)], lead


def _begin_after(outcome: Outcome, writer: LayerWriter) -> None:
    """Keep a frame of a chunk's pre-roll, unless it failed."""
    if outcome.points and outcome.time is not None:
        writer.begin_after(outcome.time, outcome.points)


def _resumed(frames: FrameFolder, count: int, preroll: int) -> list[str]:
    """A warning where frames of an earlier run are used, or could have been."""
    if frames.dropped:
        are, them = ("is", "it") if frames.dropped == 1 else ("are", "them")
        dropped = counted(frames.dropped, "finished frame")
        return [WARNINGS["solved_anew"](dropped=dropped, are=are, them=them)]
    if not frames.kept:
        return []
    again = f", each stretch after {counted(preroll, 'frame')} solved again" if preroll else ""
    return [WARNINGS["resumed"](kept=f"{len(frames.kept)} of {counted(count, 'frame')}", again=again)]


def _take(outcome: Outcome, writer: LayerWriter, report: RefineReport) -> float:
    """Write one time code's result and record it; returns the seconds that writing took."""
    report.frames.append(outcome.record)
    if not outcome.points:
        name = _time_name(outcome.time)
        report.failed[name] = str(outcome.record["error"])
        report.warn(WARNINGS["failed"](name=name, error=report.failed[name]))
        return 0.0
    start = clock.perf_counter()
    writer.write(outcome.time, outcome.points, changed=[not kept for kept in outcome.reused], heat=outcome.heat)
    return clock.perf_counter() - start


def _time_name(time: float | None) -> str:
    return "default" if time is None else f"{time:g}"


def _write_report(report: RefineReport, path: Path, opened: Shot) -> None:
    if json_of(path) == path:
        report.write(path)
    else:
        write_folder(report, path, opened)


def _write_failure(report: RefineReport, options: RefineOptions) -> None:
    """Write the JSON of a run that failed over no file that may not be replaced; that error is the one told."""
    if options.report is not None and not options.dry_run:
        file = json_of(Path(options.report))
        with suppress(LayerError):
            if options.overwrite or not file.exists() or is_of_failure(file):
                report.write(file)


def _peak_memory_mb() -> float | None:
    """Peak resident memory of this process [MB]; None where the system does not tell, as on Windows."""
    if resource is None:
        return None
    if sys.platform == "linux":  # Its getrusage counts the program that started this one too.
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return round(int(status.partition("VmHWM:")[2].split()[0]) / 1024.0, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)
