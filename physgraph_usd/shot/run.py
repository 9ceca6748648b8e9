"""One run over an open shot: each frame is solved and written as it comes, and recorded in the report."""

from __future__ import annotations

import dataclasses
import sys
import time as clock
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ..errors import NOTICE, SolveError, counted
from ..solver.level import refine_garments
from ..solver.mesh.kernels import kernels_are_compiled
from ..usd.provenance import CROSSED, FAILED, UNSETTLED, UNSOLVED
from ..usd.read.reader import Shot
from ..usd.view import Layer
from ..usd.write.chunk import Chunk, chunk_of
from ..usd.write.writer import LayerWriter
from .chunks import PREROLL, solve_in_chunks
from .cuts import Cuts
from .describe import say_what_was
from .farm import connected
from .finished import made_from
from .frames import FrameFolder, Outcome, frames_folder
from .joined import SafeMover, joined
from .notes import of_energy, of_folds, of_rest
from .options import RefineOptions
from .report import LOG, RefineReport
from .settled import unsettled_frames
from .solve import Outcomes, ShotSolver
from .untagged import AUTO
from .warnings import WARNINGS, of_frames

try:
    import resource
except ImportError:  # Windows has none.
    resource = None
TIMED_FRAMES, LONG_RUN = 3, 60.0
"""Frames after which a run says when it will end, where that is so far away [s]."""


@dataclass(frozen=True, eq=False)
class Run:
    """A run.

    Attributes:
        shot: The shot, open.
        out: The layer to write, or None for one in memory.
        options: What to do and how.
        report: Its report, in which the garments are.
    """

    shot: Shot
    out: Path | None
    options: RefineOptions
    report: RefineReport

    def refine(self) -> Layer | None:
        """Solve and write all frames; returns the layer where it is in memory.

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
        """Solve and write all frames; returns the layer where it is in memory."""
        began, options = clock.perf_counter(), self.options
        chunk = None if options.preroll is None else chunk_of(self.shot.scene.times, options.frames)
        times, leads = self._times(chunk)
        provenance = made_from(self.shot, self.out, options)
        known = len(self.shot.warnings)  # What is said of the shot itself has been.
        made = {"mode": options.mode, "velocities": options.velocities, "overwrite": options.overwrite, "chunk": chunk}
        refinements = refine_garments(self.shot.scene.garments, self._solver.levels)
        with ExitStack() as stack:
            frames = None
            if self.out is not None:
                decides = {"levels": self._solver.levels, "times": times, "report": options.report is not None}
                settings = {"resume": options.resume, "drop": options.overwrite, "keep": options.keep_frames}
                meshes = zip(self.shot.scene.garments, refinements, strict=True)
                counts = [[cage, *steps][-1].mesh.vertex_count for cage, steps in meshes]
                frames = stack.enter_context(
                    FrameFolder(frames_folder(self.out), provenance | decides, counts=counts, **settings)
                )
            writer = stack.enter_context(LayerWriter(self.shot, refinements, self.out, provenance=provenance, **made))
            solved = stack.enter_context(closing(self._solved(times, frames)))
            for _ in range(leads):
                outcome = next(solved)
                if outcome.points and outcome.time is not None:
                    writer.begin_after(outcome.time, outcome.points)
            self._write_frames(writer, solved, len(times) - leads)
            layer = writer.layer if self.out is None else None
        self.report.strict = options.strict
        self.report.seconds["frames"] = clock.perf_counter() - began
        self.report.warn(*map(str, self.shot.warnings[known:]))
        return layer

    @cached_property
    def _solver(self) -> ShotSolver:
        """Solves the shot's frames, here and in other processes, which find the same colliders."""
        options = self.options
        if AUTO in options.colliders:
            options = dataclasses.replace(options, colliders=self.shot.colliders)
        levels = [garment["level"] for garment in self.report.garments]
        return ShotSolver(self.shot.path, levels, options, opened=self.shot)

    @cached_property
    def _cuts(self) -> Cuts:
        """Jumps of the garments, across which no velocity is taken."""
        return Cuts(self.shot, velocities=self.options.velocities)

    @property
    def _preroll(self) -> int:
        """Frames solved before a chunk, where frames depend on one another."""
        asked = PREROLL if self.options.preroll is None else self.options.preroll
        return 0 if self.options.temporal == "off" else asked

    def _times(self, chunk: Chunk | None) -> tuple[list[float | None], int]:
        """Time codes to solve, in order, and how many of the first are the pre-roll of a chunk."""
        every: list[float | None] = list(self.shot.scene.times) or [None]
        if chunk is None or not chunk.times:
            return every, 0
        first = every.index(chunk.times[0])
        lead = min(first, self._preroll)
        return every[first - lead : first + len(chunk.times)], lead

    def _solved(self, times: list[float | None], frames: FrameFolder | None) -> Outcomes:
        """Frames in order, those of an interrupted run among them, joined where several processes solved them."""
        if frames is None:
            yield from self._solver(times)
            return
        self._warn_of_finished(frames, len(times))
        mover, options = SafeMover(self.shot, self.options, self._solver.levels), self.options
        with connected(options.scheduler) if options.scheduler else nullcontext() as farm:
            chunks = {"workers": options.workers, "preroll": self._preroll, "start": farm}
            with closing(solve_in_chunks(self._solver, times, frames, **chunks)) as solved:
                yield from joined(solved, mover, self.report.warn)

    def _warn_of_finished(self, frames: FrameFolder, count: int) -> None:
        """Warn where frames of an earlier run are used, or could have been."""
        if frames.dropped:
            are, them = ("is", "it") if frames.dropped == 1 else ("are", "them")
            dropped = counted(frames.dropped, "finished frame")
            self.report.warn(WARNINGS["solved_anew"](dropped=dropped, are=are, them=them))
        elif frames.kept:
            again = f", each stretch after {counted(self._preroll, 'frame')} solved again" if self._preroll else ""
            kept = f"{len(frames.kept)} of {counted(count, 'frame')}"
            self.report.warn(WARNINGS["resumed"](kept=kept, again=again))

    def _write_frames(self, writer: LayerWriter, solved: Outcomes, count: int) -> None:
        """Write each frame as it comes, then close the layer."""
        report, options = self.report, self.options
        written, shot, began = 0.0, {"shot": report.shot}, clock.perf_counter()
        for done, outcome in enumerate(solved, start=1):
            written += self._write_frame(writer, outcome)
            LOG.info("frame %d of %d: time code %s", done, count, _name_of(outcome.time), extra=shot)
            if done == TIMED_FRAMES < count and (
                message := ending(clock.perf_counter() - began, count, options.workers)
            ):
                LOG.log(NOTICE, "%s", message, extra=shot)
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
        report.note(*of_folds(report.garments, report.frames), *of_energy(report.garments, report.frames))
        (report.warn if options.strict else report.note)(*of_rest(report.unsettled, len(report.frames)))
        say_what_was(report)

    def _write_frame(self, writer: LayerWriter, outcome: Outcome) -> float:
        """Write one time code's result and record it; returns the seconds that writing took."""
        self.report.frames.append(outcome.record)
        if not outcome.points:
            name, error = _name_of(outcome.time), str(outcome.record["error"])
            self.report.failed[name] = error
            self.report.warn(WARNINGS["failed"](name=name, error=error))
            return 0.0
        start, records = clock.perf_counter(), self.report.frames
        how = {
            "changed": [not reused for reused in outcome.reused],
            "cuts": self._cuts(records[-2:]),
            "heat": outcome.heat,
        }
        writer.write(outcome.time, outcome.points, **how)
        return clock.perf_counter() - start


def _name_of(time: float | None) -> str:
    return "default" if time is None else f"{time:g}"


def ending(seconds: float, count: int, workers: int) -> str:
    """When a run will end, or "" where that is soon.

    Args:
        seconds: What the first `TIMED_FRAMES` frames took [s].
        count: Frames of the run.
        workers: Processes that share them; the first one's frames are the first to come.
    """
    frames = -(-count // workers) - TIMED_FRAMES
    left = frames * seconds / TIMED_FRAMES
    if left < LONG_RUN:
        return ""
    at = clock.strftime("%H:%M", clock.localtime(clock.time() + left))
    about = f"{left / 60.0:.0f} min" if left < 5400.0 else f"{left / 3600.0:.1f} h"
    return f"{TIMED_FRAMES} of {count} frames in {seconds:.0f} s: all in about {about} more, at {at}"


def peak_memory_mb() -> float | None:
    """Peak resident memory of this process [MB]; None where the system does not tell, as on Windows."""
    if resource is None:
        return None
    if sys.platform == "linux":  # Its getrusage counts the program that started this one too.
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return round(int(status.partition("VmHWM:")[2].split()[0]) / 1024.0, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)
