"""Solves frames of a shot: connects USD and the solver, and chooses device and threads."""

from __future__ import annotations

import dataclasses
import os
import time as clock
from collections.abc import Generator, Sequence
from contextlib import suppress
from functools import partial
from statistics import mean
from typing import Any

import torch

from ..errors import At, SolveError, StageError
from ..interrupts import leave_if_asked
from ..solver.frame.lead_in import prerolled_cages
from ..solver.frame.refiner import Refiner
from ..solver.mesh.kernels import device_of, start_warp
from ..solver.scene import Frame, Result
from ..usd.read.reader import Shot
from .chunks import Mover, Positions, counts, worse
from .from_rest import FromRest
from .job import open_for
from .options import RefineOptions, why_not_posed
from .report import faults_of
from .run_in import MOST_POSES, POSES, RUN_IN, RunIn, crossings_of_cloth, pose_in
from .workers import cores

Results = Generator[Result, None, None]


def prepare_device(device: str) -> str:
    """Start Warp, and limit torch to one thread: torch's sums depend on the number of threads.

    Arguments, result and errors are `device_of`'s.
    """
    start_warp()
    torch.set_num_threads(1)
    return device_of(device)


class ShotSolver:
    """Solves time codes of a shot, in this process or after pickling in another process.

    Attributes:
        levels: Subdivisions of each garment.
    """

    def __init__(self, shot: str, levels: list[int], options: RefineOptions, *, opened: Shot | None = None) -> None:
        """Take a shot; ``opened`` is used in this process only, other processes open the shot again."""
        self.levels = levels
        self._shot, self._options = shot, dataclasses.replace(options, progress=None)
        self._threads = max(1, cores() // options.workers)
        self._opened = opened
        self._refiner: Refiner | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Drop what is open: each process opens the shot itself, perhaps in a different working directory."""
        weights = self._options.weights
        options = self._options if weights is None else dataclasses.replace(self._options, weights=weights.absolute())
        opened = {"_opened": None, "_refiner": None}
        return self.__dict__ | opened | {"_shot": os.path.abspath(self._shot), "_options": options}

    def __call__(self, times: Sequence[float | None]) -> Results:
        """Solve time codes in order; a failed one yields its error, the next starts from the last solved frame."""
        shot, refiner = self._built()
        before, first = self._begin(shot, refiner, times), True
        for time in times:
            began = clock.perf_counter()
            try:
                with At(time=time):
                    frame = shot.frame(time)
                    read_ms = round(1e3 * (clock.perf_counter() - began), 3)
                    result = refiner.solve(frame, sampled_at(shot, time))
                    if first:
                        refiner, result, run_in = self._from_bind_pose(shot, refiner, frame, result)
                        before |= run_in
                result = dataclasses.replace(result, telemetry={"read_ms": read_ms, **before})
            except (SolveError, StageError) as error:
                result = Result(time, telemetry={"error": str(error)})
            leave_if_asked()  # A signal may have cut the frame short.
            before, first = {}, False
            yield result
        self._refiner = refiner

    def mover(self) -> Mover:
        """A mover for the frames of one seam; the levels are those of the last solved range, if any."""
        if self._refiner is None or self._opened is None:
            self._opened, self._refiner = self._built()
        self._refiner.forget()
        return partial(self._move_safely, self._opened, self._refiner)

    @staticmethod
    def _move_safely(
        shot: Shot, refiner: Refiner, time: float | None, near: Positions, far: Positions, wanted: Positions
    ) -> tuple[Positions, str]:
        """Move cloth without new intersections or vertices in bodies, as `Mover` requires.

        The two solutions are measured only if the result crosses something.
        """
        frame = shot.frame(time)

        def moved(start: Positions, end: Positions) -> tuple[Positions, list[dict[str, Any]]]:
            moves = refiner.moved_safely(frame, start, end)
            return [points for points, _ in moves], [contact for _, contact in moves]

        points, contacts = moved(near, wanted)
        crosses = any(any(counts(contact).values()) for contact in contacts)
        sides = [moved(side, side)[1] for side in (near, far)] if crosses else []
        return points, worse([str(source.path) for source in shot.sources], contacts, *sides)

    def _built(self) -> tuple[Shot, Refiner]:
        """The shot, opened if necessary, and a new refiner."""
        device = prepare_device(self._options.device)
        self._opened = self._opened or open_for(self._shot, self._options)
        refiner = Refiner(
            self._opened.scene,
            self._options.solve_settings(),
            levels=self.levels,
            device=device,
            threads=self._threads,
            heat_map=self._options.heat_map,
        )
        return self._opened, refiner

    def _begin(self, shot: Shot, refiner: Refiner, times: Sequence[float | None]) -> dict[str, object]:
        """Solve what comes before the first frame: poses from the bind pose, if they are requested; else, in the middle
        of a shot whose cage crosses itself there, cages alone from an earlier frame.

        Returns:
            Telemetry of the first frame: `RUN_IN`, and `POSES` if poses were solved.
        """
        if self._options.pose_in and times and not why_not_posed(shot, self._options):
            seconds, _ = pose_in(shot, refiner, times[0], self._options.pose_in)
            return {RUN_IN: round(1e3 * seconds, 3), POSES: self._options.pose_in}
        earlier = [] if not times or times[0] is None else shot.times_until(times[0])
        run_in = RunIn(shot.frame, earlier, self._shot)
        advanced = prerolled_cages(
            shot.scene,
            self._options.solve_settings(),
            run_in,
            times=earlier,
            device=device_of(self._options.device),
            threads=self._threads,
        )
        if advanced is not None:
            refiner.start_from_cages(advanced[0], time_code=advanced[1])
        return {RUN_IN: round(1e3 * run_in.seconds, 3)} if run_in.seconds else {}

    def _from_bind_pose(
        self, shot: Shot, refiner: Refiner, frame: Frame, result: Result
    ) -> tuple[Refiner, Result, dict[str, object]]:
        """A first frame of skinned cloth that crosses itself, solved once more after poses from the bind pose.

        The second result is used if it has fewer faults. The frame is not solved again if cloth crosses cloth in a
        pose, as where limbs go through a body, or if the first solve reached its limit of time.

        Args:
            refiner: The refiner after the frame.
            result: The frame, solved from its cage.

        Returns:
            The refiner and the result to continue with, and telemetry as from `_begin`.
        """
        options = self._options
        automatic = options.pose_in is None and options.self_contact != "off" and not why_not_posed(shot, options)
        late = any("time_limit" in garment.telemetry for garment in result.garments)
        if not automatic or late or not crossings_of_cloth(result):
            return refiner, result, {}
        posed = refiner.fork(options.solve_settings())
        posed.forget()
        seconds, all_clean = pose_in(shot, posed, frame.time, MOST_POSES, while_clean=True)
        telemetry: dict[str, object] = {RUN_IN: round(1e3 * seconds, 3)}
        again = result
        with suppress(SolveError):  # The first result is there.
            again = posed.solve(frame, sampled_at(shot, frame.time)) if all_clean else result
        is_better = _faults(again) < _faults(result)
        return (posed, again, telemetry | {POSES: MOST_POSES}) if is_better else (refiner, result, telemetry)


def _faults(result: Result) -> int:
    """Faults of all garments, by `faults_of`; garments that are solved together each count those of all."""
    return sum(faults_of(garment.telemetry.get("contact", {}), "after") for garment in result.garments)


def sampled_at(shot: Shot, time: float | None) -> list[bool]:
    """For each garment, whether the layer gets a sample at a time code: an authored time code, or the shot's first."""
    first = shot.scene.times[0] if shot.scene.times else None
    return [time in source.times if source.times else time == first for source in shot.sources]


def time_frames(shot: Shot, options: RefineOptions, levels: list[int]) -> dict[str, dict[str, Any]]:
    """Time up to three frames in the middle of a shot, one cold and two warm, and say how far from rest they end.

    Args:
        shot: The shot.
        options: Options of the solve.
        levels: Subdivisions of each garment.

    Returns:
        ``timed``: wall time of the cold frame, mean of the warm ones, and the estimate for the whole shot [s]; and
        ``from_rest``, as `FromRest.plain`.
    """
    device, from_rest = prepare_device(options.device), FromRest()
    settings = dataclasses.replace(options.solve_settings(), ended=from_rest.note)
    refiner = Refiner(shot.scene, settings, levels=levels, device=device, threads=cores())
    times, spent = list(shot.scene.times) or [None], []
    middle = max(len(times) // 2 - 1, 0)
    for time in times[middle : middle + 3]:
        began = clock.perf_counter()
        refiner.solve(shot.frame(time))
        spent.append(clock.perf_counter() - began)
        from_rest.measure()
    warm = mean(spent[1:] or spent)
    total = spent[0] + warm * (len(times) - 1)
    seconds = {"first_frame_seconds": spent[0], "seconds_a_frame": warm, "whole_shot_seconds": total}
    return {"timed": {name: float(f"{value:.3g}") for name, value in seconds.items()}, "from_rest": from_rest.plain()}
