"""Frames of a shot that can be solved by any method, as often as one likes, and judged by one ruler."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..detail import Carried
from ..group import SolveSettings
from ..options import RefineOptions
from ..pipeline import Refiner
from ..scene import Frame, Scene

DEFAULT = RefineOptions().solve_settings()
"""What `refine` does by default."""
COLD = replace(DEFAULT, temporal="off")
"""The same, each frame by itself."""


@dataclass(frozen=True, eq=False)
class Solved:
    """One frame, solved.

    Attributes:
        points: Fine world positions [m] of each garment.
        milliseconds: Wall time of preparing and solving the frame, without reading, writing and telemetry.
        steps: Steps made at the finest levels.
        waited: Milliseconds that its threads waited for a core that others had, or None where that is not known.
    """

    points: tuple[np.ndarray, ...]
    milliseconds: float
    steps: int
    waited: float | None


@dataclass(frozen=True)
class Judgement:
    """What fine positions are worth.

    Attributes:
        energies: Energy of each term [J].
        strain: Largest over the garments of the edges' 99th percentile.
        inside: Vertices inside closed bodies.
        percent: Their share of all vertices.
        deepest_mm: Depth of the deepest [mm].
        crossings: Edges through faces.
    """

    energies: dict[str, float]
    strain: float
    inside: int
    percent: float
    deepest_mm: float
    crossings: int

    @property
    def energy(self) -> float:
        """The potential [J]."""
        return sum(self.energies.values())


class Problem:
    """The frames of a scene with the solver's levels built, in one precision.

    Attributes:
        refiner: The solver.
        has_bodies: Whether a garment may touch something.
    """

    def __init__(
        self, scene: Scene, levels: Sequence[int], *, device: str, lanes: int, dtype: torch.dtype = torch.float32
    ) -> None:
        """Build the levels.

        Args:
            scene: The scene; its gain of detail is left out, for it is no part of the potential.
            levels: Subdivisions of each garment.
            device: "cpu" or a CUDA device.
            lanes: Most threads of a kernel.
            dtype: Scalar type of the solve.
        """
        garments = tuple(replace(each, detail_scale=np.ones_like(each.detail_scale)) for each in scene.garments)
        scene = replace(scene, garments=garments)
        self.refiner = Refiner(scene, DEFAULT, levels=levels, dtype=dtype, device=device, lanes=lanes)
        self.has_bodies = any(garment.colliders for garment in garments)

    @property
    def vertex_count(self) -> int:
        """Number of fine vertices."""
        return sum(group.levels[-1].vertex_count for group in self.refiner.groups)

    def solve(self, frame: Frame, settings: SolveSettings) -> Solved:
        """Solve a frame from a cold start."""
        self.refiner.use(settings)
        return self.next(frame)

    def next(self, frame: Frame) -> Solved:
        """Solve a frame from where the last one ended, with the settings in use."""
        before = _waited()
        state = self.refiner.solve(frame)
        after = _waited()
        spent = [entry.get("milliseconds") or {"prepare": 0.0, "solve": 0.0} for entry in state.telemetry]
        milliseconds = sum(each["prepare"] + each["solve"] for each in spent)  # type: ignore[index]
        steps = [level["steps"] for entry in state.telemetry for level in entry.get("levels", [])[-1:]]  # type: ignore
        waited = None if before is None or after is None else after - before
        return Solved(tuple(p for p in state.points if p is not None), milliseconds, sum(steps), waited)

    def go_on(
        self, frame: Frame, settings: SolveSettings, kept: Sequence[Carried | None]
    ) -> tuple[tuple[np.ndarray, ...], list[Carried]]:
        """Solve a frame from a kept result of its own; cold where that is None.

        Returns:
            Fine world positions [m] of each garment, and what to go on from.
        """
        self.refiner.use(replace(settings, temporal="warm"))
        points, carried = [], []
        for index, (group, own) in enumerate(zip(self.refiner.groups, kept, strict=True)):
            touching = self.refiner.touching(index, frame)
            found, after, _ = group.solve([frame.garments[index]], own, at=frame.time, touching=touching)
            points.append(found[0])
            carried.append(after)
        return tuple(points), carried

    def judge(self, frame: Frame, points: Sequence[np.ndarray]) -> Judgement:
        """Energy, strain and contact of fine world positions [m], one array a garment."""
        energies: Counter[str] = Counter()
        bodies: list[dict[str, Any]] = []
        strains = []
        for index, group in enumerate(self.refiner.groups):
            touching = self.refiner.touching(index, frame)
            found = group.judge([frame.garments[index]], [points[index]], touching=touching)
            for name, value in found["energy_joules"].items():
                energies[name] += value
            strains.append(found["strain"]["p99"])
            bodies += [body["after"] for body in found.get("bodies", {}).values()]
        inside = sum(body["inside"] for body in bodies)
        return Judgement(
            dict(energies),
            max(strains),
            inside,
            100.0 * inside / max(self.vertex_count, 1),
            max((body["deepest_mm"] for body in bodies), default=0.0),
            sum(body["crossings"] for body in bodies),
        )

    def upsampled(self, frame: Frame, *, smooth: bool) -> tuple[np.ndarray, ...]:
        """The cage's fine positions [m], by the linear or by the smooth map, without any physics."""
        finest = [group.levels[-1] for group in self.refiner.groups]
        maps = [level.smooth_from_coarse if smooth else level.from_coarse for level in finest]
        return tuple(np.asarray(m @ g.points) for m, g in zip(maps, frame.garments, strict=True))


def plain_detail(frame: Frame) -> Frame:
    """A frame whose result is the solution itself, whatever gain an artist gave its detail."""
    return replace(frame, garments=tuple(replace(garment, detail=1.0) for garment in frame.garments))


def with_garments(frame: Frame, change: Callable[[Any], Any]) -> Frame:
    """A frame with every garment's values changed."""
    return replace(frame, garments=tuple(change(garment) for garment in frame.garments))


def _waited() -> float | None:
    """Milliseconds that this process's threads have been ready to run and had no core; Linux alone tells."""
    tasks = Path("/proc/self/task")
    if not tasks.is_dir():
        return None
    total = 0
    for file in tasks.glob("*/schedstat"):
        with suppress(FileNotFoundError, ProcessLookupError):
            total += int(file.read_text().split()[1])
    return 1e-6 * total
