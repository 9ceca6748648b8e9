"""Frames of a shot that are solved by any method, as often as one likes, and judged by the same measures."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...shot.options import RefineOptions
from ...solver.contact.settings import ContactSettings
from ...solver.forces.base import ForceModule
from ...solver.frame.problem import begin
from ...solver.frame.refiner import Refiner
from ...solver.frame.settings import SolveSettings
from ...solver.frame.solve import solve_frame
from ...solver.frame.state import State
from ...solver.level import Level, fine_meshes
from ...solver.resolution import edge_strain
from ...solver.scene import Frame, Scene

DEFAULT = RefineOptions().solve_settings()
"""How `refine` solves by default."""
COLD = replace(DEFAULT, temporal="off")
"""By default, but each frame by itself."""
ALONE = replace(COLD, contact=ContactSettings("off", cloth="off"))
"""Each frame by itself, and cloth that touches nothing."""


@dataclass(frozen=True)
class Judgement:
    """Energy, strain and contact of fine positions.

    Attributes:
        energies: Energy of each term [J].
        strain: Largest over the garments of the edges' 99th percentile.
        inside: Vertices inside closed bodies.
        percent: Fraction of all vertices [%].
        deepest_mm: Depth of the deepest [mm].
        crossings: Edges of cloth through faces of bodies and the other way round.
        tangles: Edges of cloth through faces of cloth.
    """

    energies: dict[str, float]
    strain: float
    inside: int
    percent: float
    deepest_mm: float
    crossings: int
    tangles: int

    @property
    def energy(self) -> float:
        """The potential [J]."""
        return sum(self.energies.values())


@dataclass(frozen=True, eq=False)
class Solved:
    """A solved frame.

    Attributes:
        points: Fine world positions [m] of each garment.
        milliseconds: Time of preparing and solving the frame, without reading, writing and telemetry.
        prepared: Time of preparing the frame, included in `milliseconds`.
        elapsed: Wall time of the whole frame [ms].
        steps: Steps made at the finest levels.
        waited: Milliseconds of waiting for a busy core, or None if unknown.
    """

    points: tuple[np.ndarray, ...]
    milliseconds: float
    prepared: float
    elapsed: float
    steps: int
    waited: float | None


class Problem:
    """The frames of a scene with the solver's levels built, in one precision."""

    def __init__(
        self,
        scene: Scene,
        levels: Sequence[int],
        *,
        device: str,
        threads: int,
        dtype: torch.dtype = torch.float32,
        clock: str = "wall",
    ) -> None:
        """Build the levels.

        Args:
            scene: The scene; its gain of detail is left out, for it is no part of the potential.
            levels: Subdivisions of each garment.
            device: "cpu" or a CUDA device.
            threads: Most threads of a kernel.
            clock: "wall", or "cpu" to count the processor's time alone.
        """
        self._clock = clock
        garments = tuple(
            replace(garment, detail_scale=np.ones_like(garment.detail_scale)) for garment in scene.garments
        )
        scene = replace(scene, garments=garments)
        self.scene = scene
        self.refiner = Refiner(scene, DEFAULT, levels=levels, dtype=dtype, device=device, threads=threads)

    @property
    def vertex_count(self) -> int:
        """Number of fine vertices."""
        return sum(mesh.vertex_count for mesh in fine_meshes(self.scene.garments, self.refiner.refinements))

    @cached_property
    def triangles(self) -> tuple[np.ndarray, ...]:
        """Vertices of each fine triangle, shape (T, 3), one array a garment."""
        meshes = fine_meshes(self.scene.garments, self.refiner.refinements)
        return tuple(mesh.triangulate().triangles for mesh in meshes)

    def solve(self, frame: Frame, settings: SolveSettings) -> Solved:
        """Solve a frame from a cold start."""
        self.refiner.use(settings)
        return self.next(frame)

    def next(self, frame: Frame) -> Solved:
        """Solve a frame from the previous result, with the settings in use."""
        before, began, worked = _waited(), time.perf_counter(), time.process_time()
        garments = self.refiner.solve(frame).garments
        after, elapsed, worked = _waited(), time.perf_counter() - began, time.process_time() - worked
        entries = list({id(garment.telemetry): garment.telemetry for garment in garments}.values())
        spent = {
            name: sum(entry.get("milliseconds", {}).get(name, 0.0) for entry in entries)
            for name in ("prepare", "solve")
        }
        reports = [report for entry in entries for report in entry.get("levels", [])]
        last = max((report["level"] for report in reports), default=0)
        steps = sum(report["steps"] for report in reports if report["level"] == last)
        waited = None if before is None or after is None else after - before
        busy = worked / elapsed if self._clock == "cpu" else 1.0
        points = tuple(garment.points for garment in garments if garment.points is not None)
        prepared = busy * spent["prepare"]
        return Solved(points, prepared + busy * spent["solve"], prepared, 1e3 * elapsed, steps, waited)

    def go_on(
        self, frame: Frame, settings: SolveSettings, states: Sequence[State | None]
    ) -> tuple[tuple[np.ndarray, ...], list[State]]:
        """Continue a frame from the state of each part; cold for a state None.

        Returns:
            Fine world positions [m] of each garment, and the new state of each part.
        """
        self.refiner.use(replace(settings, temporal="warm"))
        points: dict[int, np.ndarray] = {}
        after = []
        for part, state in zip(self.refiner.parts_of(frame), states, strict=True):
            frames, touching = [frame.garments[index] for index in part], self.refiner.touching(part, frame)
            group = self.refiner.group_of(part)
            solved, _ = solve_frame(begin(group, frames, state, at=frame.time, touching=touching))
            points.update(zip(part, group.per_garment(solved.points), strict=True))
            after.append(solved)
        return tuple(points[index] for index in sorted(points)), after

    def judge(self, frame: Frame, points: Sequence[np.ndarray], settings: SolveSettings = COLD) -> Judgement:
        """Energy, strain and contact of fine world positions [m], one array a garment, in a potential and a contact."""
        self.refiner.use(settings)
        return judge(self.refiner, frame, points)

    def upsampled(self, frame: Frame, *, smooth: bool) -> tuple[np.ndarray, ...]:
        """The cage's fine positions [m], by the linear or by the smooth map, without any physics."""
        return self._of_finest(
            frame,
            lambda level, points: np.asarray((level.smooth_from_coarse if smooth else level.from_coarse) @ points),
        )

    def spacing(self, frame: Frame) -> tuple[np.ndarray, ...]:
        """Mean rest edge at each fine vertex [m], one array a garment."""
        return self._of_finest(frame, lambda level, _: level.spacing.double().cpu().numpy())

    def _of_finest(self, frame: Frame, measure: Callable[[Level, np.ndarray], np.ndarray]) -> tuple[np.ndarray, ...]:
        """A value per fine vertex from the finest levels and the cages' points, one array a garment."""
        points_at: dict[int, np.ndarray] = {}
        for part in self.refiner.parts_of(frame):
            finest = self.refiner.group_of(part).levels[-1]
            values = measure(finest, np.concatenate([frame.garments[index].points for index in part]))
            points_at.update((index, values[span]) for index, span in zip(part, finest.spans, strict=True))
        return tuple(points_at[index] for index in sorted(points_at))


def judge(refiner: Refiner, frame: Frame, points: Sequence[np.ndarray]) -> Judgement:
    """Fine world positions [m] of a frame, one array a garment, judged by the solver's full potential and contact."""
    energies: defaultdict[str, float] = defaultdict(float)
    strains, bodies, tangles, count = [0.0], list[dict[str, Any]](), 0, 0
    for part in refiner.parts_of(frame):
        group = refiner.group_of(part)
        joined = np.concatenate([points[index] for index in part])
        module, touching, origin = group.potential([frame.garments[i] for i in part], refiner.touching(part, frame))
        finest = group.levels[-1]
        x = torch.as_tensor(joined - origin, dtype=finest.dtype, device=finest.device)
        touched = () if touching is None else touching.at(finest).terms(x)
        for name, value in ForceModule((*module.forces, *touched)).energies(x).items():
            energies[name] += value
        strains.append(edge_strain(finest, x)["p99"])
        contact: dict[str, Any] = {} if touching is None else touching.measure(x)[0]
        bodies += [body["after"] for body in contact.get("bodies", {}).values()]
        tangles += contact.get("cloth", {}).get("after", {}).get("crossings", 0)
        count += finest.vertex_count
    inside = sum(body["inside"] for body in bodies)
    return Judgement(
        energies=dict(energies),
        strain=max(strains),
        inside=inside,
        percent=100.0 * inside / max(count, 1),
        deepest_mm=max((body["deepest_mm"] for body in bodies), default=0.0),
        crossings=sum(body["crossings"] for body in bodies),
        tangles=tangles,
    )


OVER_FRAMES: dict[str, Callable[..., Any]] = {
    "strain": max,
    "inside": sum,
    "deepest_mm": max,
    "crossings": sum,
    "tangles": sum,
}
"""How each measure of several frames is made one."""


def over_frames(judged: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The measures of `OVER_FRAMES` of several frames' judgements."""
    return {name: join(measures[name] for measures in judged) for name, join in OVER_FRAMES.items()}


def plain_detail(frame: Frame) -> Frame:
    """A frame with the solution itself as the result, ignoring the artist's gain of the detail."""
    return replace(frame, garments=tuple(replace(garment, detail=1.0) for garment in frame.garments))


def with_garments(frame: Frame, change: Callable[[Any], Any]) -> Frame:
    """A frame with every garment's values changed."""
    return replace(frame, garments=tuple(change(garment) for garment in frame.garments))


def _waited() -> float | None:
    """Milliseconds that this process's threads have been ready to run and had no core; None but on Linux."""
    tasks = Path("/proc/self/task")
    if not tasks.is_dir():
        return None
    total = 0
    for file in tasks.glob("*/schedstat"):
        with suppress(FileNotFoundError, ProcessLookupError):
            total += int(file.read_text().split()[1])
    return 1e-6 * total
