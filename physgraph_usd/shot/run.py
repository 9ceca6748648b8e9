"""A run over an open shot.

    for result in the frames, solved here or by other processes, or stored by an earlier run:
        write the result's points into the layer
        add its telemetry to the report
    close the layer; warnings and notes from the telemetry go into the report

Each frame is written as soon as it is solved. The frames of processes are joined where they meet (`joined`).
"""

from __future__ import annotations

import dataclasses
import sys
import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import NOTICE, SolveError, counted, named_time
from ..solver.level import fine_meshes, refine_garments
from ..solver.mesh.kernels import cards_for, kernels_are_compiled
from ..solver.mesh.subdivide import Refinement
from ..solver.scene import Result
from ..usd.provenance import CROSSED, FAILED, UNSETTLED, UNSOLVED
from ..usd.read.reader import Shot
from ..usd.times import none_within, within
from ..usd.view import Layer
from ..usd.write.writer import LayerWriter
from .chunks import PREROLL, solve_in_chunks
from .cuts import Cuts, Loop
from .describe import say_what_was
from .farm import connected
from .finished import made_from
from .forecast import Forecast
from .frames import CHUNK, FrameFolder, frames_folder
from .notes import of_energy, of_folds, of_following, of_given_up, of_inertia, of_poses, of_rest
from .options import RefineOptions
from .processes import Start, separate_processes
from .report import LOG, RefineReport, of_a_kind
from .settled import unsettled_frames
from .skin import DrawnCloth, Shown, frames_compared, of_polygons, shown_through
from .solve import Results, ShotSolver
from .untagged import AUTO
from .warnings import WARNINGS, of_drawn, of_frames, of_loops, of_more

try:
    import resource
except ImportError:  # Windows has none.
    resource = None


@dataclass(frozen=True, eq=False)
class Stored:
    """Frames stored by other runs, written instead of solving.

    Attributes:
        numbers: Numbers of the frames, in order.
        record: Entries of the layer's record.
        results: The frames.
    """

    numbers: Sequence[int]
    record: Mapping[str, Any]
    results: Results


@dataclass(frozen=True, eq=False)
class Run:
    """A run.

    Attributes:
        shot: The shot, open.
        out: The layer to write, or None for a layer in memory.
        report: The report, with the garments filled in.
        stored: Frames to write instead of solving; None to solve.
        show_first: Called with the first refined frame as soon as it is done; or None.
    """

    shot: Shot
    out: Path | None
    options: RefineOptions
    report: RefineReport
    stored: Stored | None = None
    show_first: Callable[[Result], None] | None = None

    def refine(self) -> Layer | None:
        """Solve and write all frames; returns the layer if in memory.

        Raises:
            SolveError: No frame could be solved.
            LayerError: The layer cannot be written.
        """
        began = clock.perf_counter()
        if not kernels_are_compiled():
            LOG.info("kernels are compiled, once on this machine: some 15 s; physgraph-usd warm-up does it ahead")
        layer = self._write_layer()
        self.report.seconds["total"] = self.report.seconds["open"] + clock.perf_counter() - began
        self.report.peak_memory_mb = peak_memory_mb()
        self.report.out = self.out
        return layer

    def _write_layer(self) -> Layer | None:
        """Solve all frames and write the layer or the chunk; returns the layer if in memory."""
        began, options = clock.perf_counter(), self.options
        provenance = made_from(self.shot, self.out, options) | dict(self.stored.record if self.stored else {})
        reported = len(self.shot.warnings)  # Warnings about the shot itself are already reported.
        refinements = refine_garments(self.shot.scene.garments, self.solver.levels)
        with ExitStack() as stack:
            frames = writer = None
            if self.out is not None and self.stored is None:
                frames = stack.enter_context(self._folder(self.out, provenance, refinements))
            if not self._is_chunk:
                writer = stack.enter_context(_layer_writer(self, provenance, refinements))
            solved = stack.enter_context(closing(self._solved(frames)))
            self._write_frames(writer, solved, len(self._numbers))
            layer = writer.layer if writer is not None and self.out is None else None
        self.report.strict = options.strict
        self.report.seconds["frames"] = clock.perf_counter() - began
        self.report.warn(*map(str, self.shot.warnings[reported:]))
        return layer

    def _folder(
        self, out: Path, provenance: dict[str, Any], refinements: Sequence[Sequence[Refinement]]
    ) -> FrameFolder:
        """The folder of finished frames: a chunk's own, or the one beside a layer until the layer is done."""
        options, chunk = self.options, self._is_chunk
        decides = {"levels": self.solver.levels, "times": self._times, "report": options.report is not None}
        if chunk:
            decides[CHUNK] = [self._numbers[0], self._numbers[-1] + 1]
        meshes = fine_meshes(self.shot.scene.garments, refinements)
        counts = [mesh.vertex_count for mesh in meshes]
        return FrameFolder(
            out if chunk else frames_folder(out),
            provenance | decides,
            counts=counts,
            resume=options.resume,
            drop=options.overwrite,
            keep=options.keep_frames,
            stays=chunk,
        )

    @property
    def _is_chunk(self) -> bool:
        """Whether the run makes a chunk for `stitch` instead of a layer."""
        return self.options.preroll is not None

    @cached_property
    def _times(self) -> list[float | None]:
        """Time codes of the open shot."""
        return list(self.shot.scene.times) or [None]

    @cached_property
    def _numbers(self) -> Sequence[int]:
        """Numbers of the time codes to solve: all open time codes, or for a chunk those of the shot in ``frames``."""
        if self.stored is not None:
            return self.stored.numbers
        return numbers_in(self.shot.scene.times, self.options.frames if self._is_chunk else None)

    @cached_property
    def solver(self) -> ShotSolver:
        """Solves the shot's frames, here and in worker processes, with the same colliders everywhere."""
        options = self.options
        if AUTO in options.colliders:
            options = dataclasses.replace(options, colliders=self.shot.colliders)
        levels = [garment["level"] for garment in self.report.garments]
        return ShotSolver(self.shot.path, levels, options, opened=self.shot)

    @cached_property
    def _cuts(self) -> Cuts:
        """Jumps of the garments, across which no velocity is taken."""
        return Cuts(self.shot, velocities=self.options.velocities)

    @cached_property
    def _loop(self) -> Loop:
        """First and last result, compared where the shot closes."""
        return Loop(self.shot, self.solver.levels)

    @property
    def _preroll(self) -> int:
        """Frames solved before a chunk if frames depend on their predecessors."""
        preroll = PREROLL if self.options.preroll is None else self.options.preroll
        return 0 if self.options.temporal == "off" else preroll

    def _solved(self, frames: FrameFolder | None) -> Results:
        """Frames in order, including reused frames of an interrupted run, joined if solved by several processes."""
        if self.stored is not None:
            yield from self.stored.results
            return
        if frames is None:
            yield from self.solver(self._times)
            return
        _warn_of_finished(self, frames, len(self._numbers))
        _announce_preroll(self, frames)
        with _processes(self.options) as start:
            chunks = solve_in_chunks(
                self.solver,
                self._times,
                frames,
                workers=self.options.workers,
                only=self._numbers,
                preroll=self._preroll,
                start=start,
                movers=None if self._is_chunk else self.solver.mover,
                warn=self.report.warn,
            )
            with closing(chunks) as solved:
                yield from solved

    def _write_frames(self, writer: LayerWriter | None, solved: Results, count: int) -> None:
        """Write each frame as soon as solved, then close the layer; a chunk's frames are already in its folder."""
        report, options = self.report, self.options
        written, shot, began = 0.0, {"shot": report.shot}, clock.perf_counter()
        forecast = Forecast(count, options.workers)
        compared = frames_compared(count if options.contact != "off" else 0)
        drawn_through, entered = list[Shown](), dict[float | None, dict[str, float]]()
        drawn = DrawnCloth(self.shot, self.solver.levels if options.report and options.scheme == "keep" else ())
        for done, result in enumerate(solved, start=1):
            written += self._write_frame(writer, result)
            drawn_through += shown_through(self.shot, result) if done - 1 in compared else []
            entered[result.time] = drawn.depths(result) if done - 1 in compared else {}
            LOG.info("frame %d of %d: time code %s", done, count, named_time(result.time), extra=shot)
            if message := forecast.after(clock.perf_counter() - began):
                LOG.log(NOTICE, "%s", message, extra=shot)
            LOG.debug("%s", report.frames[-1], extra=shot)
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
        if writer is not None:
            writer.close(lacking=lacking)
            report.warn(*map(str, writer.notices))
            report.note(*of_a_kind(map(str, writer.notes)))
        report.seconds |= {"close": clock.perf_counter() - start, "write": written}
        report.warn(*of_frames(report), *of_drawn(entered), *of_loops(self._loop.gaps()))
        report.note(*of_following(report), *of_given_up(report), *of_inertia(report))
        report.note(*(of_poses(report) if options.pose_in is None else ()))
        report.note(*of_folds(report), *of_energy(report), *of_polygons(drawn_through))
        (report.warn if options.strict else report.note)(*of_rest(report.unsettled, len(report.frames)))
        say_what_was(report)
        report.warn(*of_more(report))  # The last line of a run.

    def _write_frame(self, writer: LayerWriter | None, result: Result) -> float:
        """Write the result of one time code and record the result; returns the seconds spent writing."""
        self.report.add(result)
        self._loop.add(result)
        if not result.garments:
            name, error = named_time(result.time), str(result.telemetry["error"])
            self.report.failed[name] = error
            self.report.warn(WARNINGS["failed"](name=name, error=error))
            return 0.0
        if self.show_first is not None and len(self.report.frames) == len(self.report.failed) + 1:
            self.show_first(result)
        if writer is None:
            return 0.0
        start = clock.perf_counter()
        writer.write(result, cuts=self._cuts(self.report.frames[-2:]))
        return clock.perf_counter() - start


def _layer_writer(run: Run, provenance: dict[str, Any], refinements: Sequence[Sequence[Refinement]]) -> LayerWriter:
    """The writer of the layer."""
    options = run.options
    part = [time for time in (run._times[k] for k in run._numbers) if time is not None]
    return LayerWriter(
        run.shot,
        refinements,
        run.out,
        provenance=provenance,
        mode=options.mode,
        scheme=options.scheme,
        velocities=options.velocities,
        overwrite=options.overwrite,
        times=part if len(part) < len(run.shot.scene.times) else None,
    )


def _warn_of_finished(run: Run, frames: FrameFolder, count: int) -> None:
    """Warn if frames of an earlier run are used, or could have been."""
    if frames.dropped:
        are, them = ("is", "it") if frames.dropped == 1 else ("are", "them")
        dropped = counted(frames.dropped, "finished frame")
        run.report.warn(WARNINGS["solved_anew"](dropped=dropped, are=are, them=them))
    elif frames.kept:
        again = f", each stretch after {counted(run._preroll, 'frame')} solved again" if run._preroll else ""
        reused = f"{len(frames.kept)} of {counted(count, 'frame')}"
        run.report.warn(WARNINGS["resumed"](kept=reused, again=again))


def _announce_preroll(run: Run, frames: FrameFolder) -> None:
    """Say how many frames a chunk solves before its own."""
    early = min(run._preroll, run._numbers[0])
    if run._is_chunk and early and not frames.kept:
        first = f"before time code {named_time(run._times[run._numbers[0]])} the pre-roll is solved"
        LOG.log(NOTICE, "%s: %s", first, counted(early, "frame"), extra={"shot": run.report.shot})


def _processes(options: RefineOptions) -> AbstractContextManager[Start | None]:
    """Starter of chunks: on a farm, in processes of this machine, or None to solve in this process."""
    if options.scheduler:
        return connected(options.scheduler)
    if options.workers == 1:
        return nullcontext()
    return separate_processes(options.workers, cards=cards_for(options.device))


def numbers_in(every: Sequence[float], frames: tuple[float, float] | None) -> range:
    """Numbers of the shot's time codes within a range; a shot without samples has one frame.

    Args:
        every: Time codes of the whole shot, in order.
        frames: First and last time code; None for all.

    Raises:
        AbsentError: No time code lies in the range.
    """
    if frames is None:
        return range(max(len(every), 1))
    times = within(every, frames)
    if not times:
        raise none_within(every, frames)
    return range(every.index(times[0]), every.index(times[-1]) + 1)


def peak_memory_mb() -> float | None:
    """Peak resident memory of this process [MB]; None if unknown, as on Windows."""
    if resource is None:
        return None
    if sys.platform == "linux":  # On Linux, getrusage also counts the parent program.
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return round(int(status.partition("VmHWM:")[2].split()[0]) / 1024.0, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)
