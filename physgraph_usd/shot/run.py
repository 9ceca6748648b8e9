"""A run over an open shot, `Run.refine`:

    for result in the frames, solved here or by other processes, or stored by an earlier run:
        add its telemetry to the report, with a warning if it failed; write its points into the layer
        compare its ends with those of a loop, and a few frames with the bodies as they are drawn
        say how far the run is
    close the layer with a record of what it lacks
    add the findings about all frames to the report

Each frame is written as soon as it is solved. The frames of processes are joined where they meet (`chunks`).
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
from .estimate import Forecast
from .findings.drawn import Compared
from .findings.table import FINDINGS, Facts, warnings_and_notes
from .findings.unsettled import unsettled_frames
from .findings.untagged import AUTO
from .frames import CHUNK, FrameFolder, frames_folder
from .job import made_from
from .options import RefineOptions
from .report import LOG, RefineReport, levels_of, of_a_kind
from .solve import Results, ShotSolver
from .workers import Start, connected, separate_processes

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
        began, report, options, count = clock.perf_counter(), self.report, self.options, len(self._numbers)
        known = len(self.shot.warnings)  # Warnings about the shot itself are already reported.
        measures_depth = bool(options.report) and options.scheme == "keep"
        compared = Compared(
            self.shot, self.solver.levels if measures_depth else (), count=count if options.contact != "off" else 0
        )
        loop = Loop(self.shot, self.solver.levels)
        report.seconds["write"] = 0.0
        with ExitStack() as stack:
            writer, results = self._start(stack)
            started, forecast = clock.perf_counter(), Forecast(count, options.workers)
            for done, result in enumerate(results, start=1):
                self._write_frame(writer, result)
                loop.add(result)
                compared.add(result)
                self._say_progress(done, count, forecast.after(clock.perf_counter() - started))
            self._close(writer)
            layer = writer.layer if writer is not None and self.out is None else None
        facts = Facts(report=report, options=options, depths=compared.depths, shown=compared.shown, gaps=loop.gaps())
        warnings, notes = warnings_and_notes(facts)
        report.note(*notes)
        report.warn(*warnings, *map(str, self.shot.warnings[known:]))
        say_what_was(report)
        report.strict, report.out, report.peak_memory_mb = options.strict, self.out, peak_memory_mb()
        report.seconds["frames"] = clock.perf_counter() - began
        report.seconds["total"] = report.seconds["open"] + report.seconds["frames"]
        return layer

    def _start(self, stack: ExitStack) -> tuple[LayerWriter | None, Results]:
        """The layer's writer, None for a chunk, and the frames; ``stack`` closes both."""
        if not kernels_are_compiled():
            LOG.info("kernels are compiled, once on this machine: some 15 s; physgraph-usd warm-up does it ahead")
        provenance = made_from(self.shot, self.out, self.options) | dict(self.stored.record if self.stored else {})
        refinements = refine_garments(self.shot.scene.garments, self.solver.levels)
        frames = writer = None
        if self.out is not None and self.stored is None:
            frames = stack.enter_context(self._folder(self.out, provenance, refinements))
        if not self._is_chunk:
            writer = stack.enter_context(self._writer(provenance, refinements))
        return writer, stack.enter_context(closing(self._results(frames)))

    def _folder(
        self, out: Path, provenance: dict[str, Any], refinements: Sequence[Sequence[Refinement]]
    ) -> FrameFolder:
        """The folder of finished frames: a chunk's own, or the one beside a layer until the layer is done."""
        options, chunk = self.options, self._is_chunk
        decides = {"levels": self.solver.levels, "times": self._times, "report": options.report is not None}
        if chunk:
            decides[CHUNK] = [self._numbers[0], self._numbers[-1] + 1]
        return FrameFolder(
            out if chunk else frames_folder(out),
            provenance | decides,
            counts=[mesh.vertex_count for mesh in fine_meshes(self.shot.scene.garments, refinements)],
            resume=options.resume,
            drop=options.overwrite,
            keep=options.keep_frames,
            stays=chunk,
        )

    def _writer(self, provenance: dict[str, Any], refinements: Sequence[Sequence[Refinement]]) -> LayerWriter:
        """The writer of the layer."""
        options = self.options
        part = [time for time in (self._times[k] for k in self._numbers) if time is not None]
        return LayerWriter(
            self.shot,
            refinements,
            self.out,
            provenance=provenance,
            mode=options.mode,
            scheme=options.scheme,
            velocities=options.velocities,
            overwrite=options.overwrite,
            times=part if len(part) < len(self.shot.scene.times) else None,
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
        return ShotSolver(self.shot.path, levels_of(self.report.garments), options, opened=self.shot)

    @cached_property
    def _cuts(self) -> Cuts:
        """Jumps of the garments, across which no velocity is taken."""
        return Cuts(self.shot, velocities=self.options.velocities)

    def _results(self, frames: FrameFolder | None) -> Results:
        """Frames in order, including reused frames of an interrupted run, joined if solved by several processes."""
        if self.stored is not None:
            yield from self.stored.results
            return
        if frames is None:
            yield from self.solver(self._times)
            return
        options, chunk = self.options, self._is_chunk
        preroll = PREROLL if options.preroll is None else options.preroll
        preroll = 0 if options.temporal == "off" else preroll
        self._say_begin(frames, preroll)
        with _processes(options) as start:
            chunks = solve_in_chunks(
                self.solver,
                self._times,
                frames,
                workers=options.workers,
                only=self._numbers,
                preroll=preroll,
                start=start,
                movers=None if chunk else self.solver.mover,
                warn=self.report.warn,
            )
            with closing(chunks) as solved:
                yield from solved

    def _write_frame(self, writer: LayerWriter | None, result: Result) -> None:
        """Add the telemetry of a time code to the report, and its points to the layer; a chunk has no layer."""
        report = self.report
        report.add(result)
        if not result.garments:
            name, error = named_time(result.time), str(result.telemetry["error"])
            report.failed[name] = error
            report.warn(FINDINGS["failed"](name=name, error=error))
            return
        if self.show_first is not None and len(report.frames) == len(report.failed) + 1:
            self.show_first(result)
        if writer is not None:
            start = clock.perf_counter()
            writer.write(result, cuts=self._cuts(report.frames[-2:]))
            report.seconds["write"] += clock.perf_counter() - start

    def _close(self, writer: LayerWriter | None) -> None:
        """Close the layer with a record of what it lacks.

        Raises:
            SolveError: No frame could be solved.
        """
        report, start = self.report, clock.perf_counter()
        if len(report.failed) == len(self._numbers):
            raise SolveError(next(iter(report.failed.values())))
        report.unsettled = unsettled_frames(report.garments, report.frames, tolerance=self.options.tolerance)
        if writer is not None:
            lacking = {
                FAILED: list(report.failed) or None,
                UNSOLVED: sum(bool(entry["error"]) for entry in report.unsettled) or None,
                UNSETTLED: len(report.unsettled) or None,
                CROSSED: report.crossings if report.leaves_crossings else None,
            }
            writer.close(lacking=lacking)
            report.warn(*map(str, writer.notices))
            report.note(*of_a_kind(map(str, writer.notes)))
        report.seconds["close"] = clock.perf_counter() - start

    def _say_begin(self, frames: FrameFolder, preroll: int) -> None:
        """Warn if frames of an earlier run are used, or could have been; say how many a chunk solves before its own."""
        report, early = self.report, min(preroll, self._numbers[0])
        if frames.dropped:
            are, them = ("is", "it") if frames.dropped == 1 else ("are", "them")
            dropped = counted(frames.dropped, "finished frame")
            report.warn(FINDINGS["solved_anew"](dropped=dropped, are=are, them=them))
        elif frames.kept:
            again = f", each stretch after {counted(preroll, 'frame')} solved again" if preroll else ""
            kept = f"{len(frames.kept)} of {counted(len(self._numbers), 'frame')}"
            report.warn(FINDINGS["resumed"](kept=kept, again=again))
        if self._is_chunk and early and not frames.kept:
            first = f"before time code {named_time(self._times[self._numbers[0]])} the pre-roll is solved"
            LOG.log(NOTICE, "%s: %s", first, counted(early, "frame"), extra={"shot": report.shot})

    def _say_progress(self, done: int, count: int, forecast: str) -> None:
        """Say how many frames are done, and when all will be."""
        frame, shot = self.report.frames[-1], {"shot": self.report.shot}
        LOG.info("frame %d of %d: time code %s", done, count, named_time(frame["time"]), extra=shot)
        if forecast:
            LOG.log(NOTICE, "%s", forecast, extra=shot)
        LOG.debug("%s", frame, extra=shot)
        if self.options.progress:
            self.options.progress(done, count)


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
