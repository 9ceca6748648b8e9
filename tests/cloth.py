"""Small scenes for tests of the solver: cages, frames made of points, and their solves without a stage."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from meshes import grid
from sheets import garment_of

from physgraph_usd.lab.methods import METHODS
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate.base import Carry, Integrator, System
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Scene

DOWN = np.array([0.0, -9.81, 0.0])
FABRIC = Fabric(30.0, 4.7e-6, 0.187)
GUIDE = 2000.0


def sheet(columns: int, rows: int, edge: float = 0.05, *, kind: str = "triangles") -> tuple[PolygonMesh, np.ndarray]:
    """A flat sheet in the plane of x and y [m]."""
    mesh, points = grid(columns, rows, kind)
    return mesh, edge * points


def settings_of(*, integrator: str = "quasi-newton", **options: Any) -> SolveSettings:
    return SolveSettings(METHODS[integrator], **options)


class Answer(NamedTuple):
    """A result of which every garment was solved."""

    time: float | None
    points: tuple[np.ndarray, ...]
    telemetry: tuple[dict[str, Any], ...]
    reused: tuple[bool, ...]


class Solver:
    """A refiner whose answers are complete."""

    def __init__(self, refiner: Refiner) -> None:
        self.refinements, self.forget, self._refiner = refiner.refinements, refiner.forget, refiner

    def solve(self, frame: Frame) -> Answer:
        result = self._refiner.solve(frame)
        points = tuple(garment.points for garment in result.garments if garment.points is not None)
        assert len(points) == len(result.garments)
        telemetry, reused = zip(*((garment.telemetry, garment.reused) for garment in result.garments), strict=True)
        return Answer(result.time, points, telemetry, reused)

    def refine(self, frames: Iterable[Frame]) -> Iterator[Answer]:
        return (self.solve(frame) for frame in frames)


def refiner_of(
    garments: Sequence[Garment],
    *,
    level: int = 1,
    times: Sequence[float] = (),
    gravity: np.ndarray = DOWN,
    dtype: torch.dtype = torch.float64,
    threads: int = 1,
    **options: Any,
) -> Solver:
    """A refiner of garments, all at one level."""
    scene = Scene(tuple(garments), gravity, tuple(times))
    return Solver(Refiner(scene, settings_of(**options), levels=[level] * len(garments), dtype=dtype, threads=threads))


def frame_of(points: np.ndarray, time: float | None = None, *, fabric: Fabric = FABRIC, guide: float = GUIDE) -> Frame:
    return Frame(time, (GarmentFrame(points, fabric, guide),))


def solved(
    mesh: PolygonMesh,
    rest: np.ndarray,
    points: np.ndarray,
    *,
    fabric: Fabric = FABRIC,
    painted: dict[str, Any] | None = None,
    **options: Any,
) -> Answer:
    """One garment's frame, solved from cold."""
    garment = replace(garment_of(mesh, rest), **(painted or {}))
    return refiner_of([garment], **options).solve(frame_of(points, fabric=fabric))


def base_of(mesh: PolygonMesh, points: np.ndarray, level: int) -> np.ndarray:
    """Cage points placed linearly at a level."""
    for refinement in refine_garments([garment_of(mesh, points)], [level])[0]:
        points = refinement.linear @ points
    return points


def group_of(
    mesh: PolygonMesh,
    rest: np.ndarray,
    *,
    level: int = 1,
    gravity: np.ndarray = DOWN,
    dtype: torch.dtype = torch.float64,
    **options: Any,
) -> Group:
    garments = [garment_of(mesh, rest)]
    return Group.of(
        garments, refine_garments(garments, [level]), gravity, settings_of(**options), dtype=dtype, device="cpu"
    )


def finest_system(group: Group, points: np.ndarray, *, fabric: Fabric = FABRIC) -> tuple[System, torch.Tensor]:
    """The finest level's problem of one frame and its linear start [m], recentred."""
    systems, coarse = group.systems([GarmentFrame(points, fabric, GUIDE)])
    return systems[-1], group.levels[-1].base.apply(coarse)


def wave(points: np.ndarray, *, squeeze: float = 0.1, height: float = 0.01, phase: float = 0.0) -> np.ndarray:
    """A sheet squeezed along x and waved in z."""
    size = max(float(np.ptp(points[:, 0])), 1e-9)
    z = height * np.sin(2 * np.pi * points[:, 0] / size + 3.0 * points[:, 1] / size + phase)
    return np.stack([(1.0 - squeeze) * points[:, 0], points[:, 1], z], axis=1)


def rms(values: np.ndarray) -> float:
    """Root mean square of vectors' lengths."""
    return float(np.sqrt((np.asarray(values) ** 2).sum(axis=-1).mean())) if np.size(values) else 0.0


def total(telemetry: dict[str, Any], which: str) -> float:
    """Total energy of the "input" or the "output" of a frame [J]."""
    return sum(telemetry["energy_joules"][which].values())


class Watched:
    """An integrator whose carries are seen, after the start and after each step."""

    def __init__(self, integrator: Integrator, see: Callable[[Carry], object]) -> None:
        self.name, self._inner, self._see = integrator.name, integrator, see

    def start(self, system: System, x: torch.Tensor) -> Carry:
        return self._seen(self._inner.start(system, x))

    def step(self, system: System, carry: Carry) -> Carry:
        return self._seen(self._inner.step(system, carry))

    def _seen(self, carry: Carry) -> Carry:
        self._see(carry)
        return carry
