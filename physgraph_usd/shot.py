"""`refine_shot`: the one place where USD meets the solver; picks device, dtype and threads."""

from __future__ import annotations

import dataclasses
import os
import resource
import sys
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
import warp as wp

from . import __version__
from .chunks import RUN_UP, solve_in_chunks
from .contact.passed import told
from .describe import begin_report, describe, describe_meshes, say_what_was, too_large
from .errors import LayerError, PhysGraphError, SolveError, StageError, UsageError
from .frames import FrameFolder, Outcome, frames_folder
from .history import told_broken
from .lead_in import cages_walked
from .options import RefineOptions, json_of
from .page.report import write_folder
from .pipeline import Refiner
from .processes import call_each, memory_is_named
from .report import RefineReport
from .resolution import too_coarse
from .settled import told_contact, told_unsettled, unsettled_frames
from .usd.atomic import check_place
from .usd.files import LAYER_SUFFIXES, Target, check_suffix, check_targets, files_of
from .usd.provenance import FAILED, UNSETTLED, asset_path, file_hashes, is_result_of, write_root
from .usd.reader import Shot, open_shot
from .usd.writer import LayerWriter

MOST_LANES = 4
"""Threads beyond which a frame's kernels gain nothing: the metric's solve stays on one."""
DEFAULTS = RefineOptions()


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
    began = clock.perf_counter()
    out = Path(out)
    check_jobs([(shot, out, options)])
    if not options.dry_run:
        _check_places(out, options)
    with memory_is_named():
        return _refine(shot, out, options, began=began)


def _refine(shot: str | Path, out: Path, options: RefineOptions, *, began: float) -> RefineReport:
    opened = _open(shot, options)
    try:
        report = begin_report(opened, options)
        report.seconds["open"] = clock.perf_counter() - began
        if large := too_large(opened, report, options):
            raise large
        if options.dry_run:
            return report
        if options.resume and _is_done(opened, out, options):
            report.warnings.append(f"{out} is taken as done: the same files, options and version made it")
            report.out = out
            return report
        _check_new(out, options)
        _tell(report.warnings, options)
        solver = _ShotSolver(str(shot), [garment["level"] for garment in report.garments], options)
        solver.adopt(opened)
        _write_layer(opened, solver, out, options, report)
        report.seconds["total"] = clock.perf_counter() - began
        report.peak_memory_mb = _peak_memory_mb()
        report.out = out
        if options.root is not None:
            files = {"layer": out, "shot": Path(shot), "absolute": options.asset_paths == "absolute"}
            write_root(Path(options.root), **files, overwrite=options.overwrite)
        if options.report is not None:
            _write_report(report, Path(options.report), opened)
    finally:
        opened.close()
    return report


Job = tuple[str | Path, Path, RefineOptions]
"""A shot, the layer to write and options."""


def refine_shots(
    jobs: Sequence[Job], *, workers: int, refine: Callable[..., RefineReport] = refine_shot
) -> Iterator[RefineReport | PhysGraphError]:
    """Refine several shots, each in a process of its own: one that fails, or dies, leaves the others alone.

    Args:
        jobs: Shot, layer to write and options of each.
        workers: Shots at a time.
        refine: What refines one of them; it must be picklable.

    Returns:
        Per job, in order, its report or the error that ended it.

    Raises:
        UsageError: No job was begun: an option is wrong, or a file to write is one that another job reads or writes.
    """
    check_jobs(jobs)
    alone = [(s, out, dataclasses.replace(options, workers=1, progress=None, say=None)) for s, out, options in jobs]
    return call_each(refine, alone, workers=workers)


def check_jobs(jobs: Sequence[Job]) -> None:
    """Refuse options that no shot could be refined with, and to write over what is read or written by any of the jobs.

    Raises:
        UsageError: With the value, and the file.
    """
    targets: list[Target] = []
    inputs: set[Path] = set()
    for shot, out, options in jobs:
        options.check()
        for what, path in (("the layer", out), ("the root", options.root)):
            if path is not None:
                check_suffix(what, Path(path), LAYER_SUFFIXES)
        targets += options.targets(out)
        inputs |= files_of(shot) | {Path(file) for file in (options.weights,) if file}
    check_targets(targets, inputs)


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
        if path.is_file() and not options.overwrite:
            raise UsageError(f"{path} exists; choose another name or allow overwriting")


def _is_done(opened: Shot, out: Path, options: RefineOptions) -> bool:
    """Whether a run with these options has made everything there is to make, from the same files."""
    made = all(path.is_file() for _, path in options.targets(out)) and not frames_folder(out).exists()
    return made and is_result_of(out, _provenance(opened, out, options), settled=options.strict)


def inspect_shot(shot: str | Path, **given: Any) -> dict[str, Any]:
    """What would be refined, with what, from where, and every defect found.

    Args:
        shot: The stage to read.
        given: Options of `RefineOptions` that concern reading.

    Returns:
        Plain values. Where the shot cannot be refined as asked, ``problem`` says why and ``meshes`` lists what is
        there.

    Raises:
        StageError: The file cannot be opened at all.
        UsageError: An option is wrong.
    """
    options = RefineOptions(**given)
    try:
        opened = _open(shot, options)
    except StageError as error:
        return describe_meshes(str(shot), str(error))
    try:
        return describe(opened, options)
    except StageError as error:
        return describe_meshes(str(shot), str(error))
    finally:
        opened.close()


def _open(shot: str | Path, options: RefineOptions) -> Shot:
    """Open a shot with the options that concern reading."""
    return open_shot(
        str(shot),
        garments=options.garments,
        colliders=options.colliders,
        frames=options.frames,
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
        self._shot, self._options = shot, dataclasses.replace(options, progress=None, say=None)
        self._lanes = min(MOST_LANES, max(1, (os.cpu_count() or 1) // options.workers))
        self._opened: Shot | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the stage behind: each process opens its own."""
        return self.__dict__ | {"_opened": None}

    def adopt(self, opened: Shot) -> None:
        """Use an open shot in this process."""
        self._opened = opened

    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        """Solve time codes in order; one that fails yields its error, and the next starts from the last good one."""
        device = self._options.device
        prepare_device(device)
        shot = self._opened = self._opened or _open(self._shot, self._options)
        settings = self._options.solve_settings()
        options = {"device": device, "lanes": self._lanes, "heat_map": self._options.heat_map}
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
        own = {"times": earlier, "device": self._options.device, "lanes": self._lanes}
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
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    torch.set_num_threads(1)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError("device 'cuda' was asked for and no CUDA device is there; use --device cpu")


def _write_layer(opened: Shot, solver: _ShotSolver, out: Path, options: RefineOptions, report: RefineReport) -> None:
    times: list[float | None] = list(opened.scene.times) or [None]
    refinements = Refiner.subdivide(opened.scene, solver.levels)
    began, written, provenance = clock.perf_counter(), 0.0, _provenance(opened, out, options)
    run = provenance | {"levels": solver.levels, "times": times, "report": options.report is not None}
    frames = FrameFolder(
        frames_folder(out), run, resume=options.resume, drop=options.overwrite, keep=options.keep_frames
    )
    with (
        frames,
        LayerWriter(
            opened,
            refinements,
            out,
            mode=options.mode,
            velocities=options.velocities,
            provenance=provenance,
            overwrite=options.overwrite,
        ) as writer,
    ):
        run_up = 0 if options.temporal == "off" else RUN_UP
        solved = solve_in_chunks(solver, times, frames, workers=options.workers, run_up=run_up)
        report.warnings += _tell(_resumed(frames, len(times), run_up), options)
        with closing(solved):
            for done, outcome in enumerate(solved, start=1):
                written += _take(outcome, writer, report)
                if options.progress:
                    options.progress(done, len(times))
        if len(report.failed) == len(times):
            raise SolveError(next(iter(report.failed.values())))
        report.unsettled = unsettled_frames(report.garments, report.frames, tolerance=options.tolerance)
        start = clock.perf_counter()
        writer.close(lacking={FAILED: list(report.failed) or None, UNSETTLED: len(report.unsettled) or None})
        report.seconds["close"] = clock.perf_counter() - start
        report.warnings += [str(notice) for notice in writer.notices] + _of_frames(report)
        say_what_was(report)
    report.strict = options.strict
    report.seconds["write"] = written
    report.seconds["frames"] = clock.perf_counter() - began
    report.warnings += [str(notice) for notice in opened.warnings if str(notice) not in report.warnings]


def _tell(warnings: list[str], options: RefineOptions) -> list[str]:
    """Say warnings before the first frame, and return them."""
    if options.say is not None:
        for warning in warnings:
            options.say(warning)
    return warnings


def _resumed(frames: FrameFolder, count: int, run_up: int) -> list[str]:
    """A warning where frames of an earlier run are used, or could have been."""
    if frames.dropped:
        said = "finished frames of a run that was interrupted are solved anew; --resume would have used them"
        return [f"{frames.dropped} {said}"]
    if not frames.kept:
        return []
    how = f", each stretch after {run_up} frames that are solved again" if run_up else ""
    return [f"{len(frames.kept)} of {count} frames are those of a run that was interrupted; the others are solved{how}"]


def _take(outcome: Outcome, writer: LayerWriter, report: RefineReport) -> float:
    """Write one time code's result and record it; returns the seconds that writing took."""
    report.frames.append(outcome.record)
    if not outcome.points:
        name = "default" if outcome.time is None else f"{outcome.time:g}"
        report.failed[name] = str(outcome.record["error"])
        report.warnings.append(f"no sample is written at time code {name}: {report.failed[name]}")
        return 0.0
    start = clock.perf_counter()
    writer.write(outcome.time, outcome.points, changed=[not kept for kept in outcome.reused], heat=outcome.heat)
    return clock.perf_counter() - start


def _write_report(report: RefineReport, path: Path, opened: Shot) -> None:
    if json_of(path) == path:
        report.write(path)
    else:
        write_folder(report, path, opened)


def _of_frames(report: RefineReport) -> list[str]:
    """What frames say that the user should know."""
    return [
        *_coarse_garments(report),
        *_of_garments(report, told, "passed_through"),
        *_of_garments(report, told_broken, "broken_before"),
        *_of_garments(report, told_contact),
        *told_unsettled(report.unsettled),
    ]


def _coarse_garments(report: RefineReport) -> list[str]:
    """A warning for each garment whose level was too coarse for its folds."""
    said = []
    for index, garment in enumerate(report.garments):
        entries = {f["time"]: f["garments"][index] for f in report.frames if "garments" in f}
        shares = {time: entry["sharp_folds"] for time, entry in entries.items() if "sharp_folds" in entry}
        said.append(too_coarse(garment["path"], garment["level"], shares))
    return [warning for warning in said if warning]


def _of_garments(report: RefineReport, tell: Callable[[str, Any], list[str]], name: str | None = None) -> list[str]:
    """What a function of a garment's path and entries by time code warns of; of the entries with a name, that of it."""
    said = []
    for index, garment in enumerate(report.garments):
        entries = {f["time"]: f["garments"][index] for f in report.frames if "garments" in f}
        given = entries if name is None else {time: each[name] for time, each in entries.items() if name in each}
        said += tell(garment["path"], given)
    return said


def _provenance(opened: Shot, out: Path, options: RefineOptions) -> dict[str, Any]:
    folder, absolute = out.resolve().parent, options.asset_paths == "absolute"
    return {
        "version": __version__,
        "options": options.plain(),
        "shot": asset_path(opened.path, folder, absolute=absolute),
        "inputs": file_hashes(opened.stage, folder, absolute=absolute),
    }


def _peak_memory_mb() -> float:
    """Peak resident memory of this process [MB]; Linux counts kilobytes, macOS bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)
