"""A coarse cloth simulation by projective dynamics, just enough to animate the samples.

Source: Bouaziz et al., "Projective Dynamics: Fusing Constraint Projections for Fast Simulation", 2014.
Springs resist stretch but give way to compression down to a limit. That is the state in which a coarse
simulation leaves a garment: shortened in places where the real cloth would have wrinkled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from .shapes import springs

GRAVITY = np.array([0.0, -9.81, 0.0])
"""Gravity of the samples' simulations [m/s^2]; they are made with Y up."""
RENEWALS = 3
"""Iterations of a step that may still change the set of contacts."""


@dataclass(frozen=True)
class DrapeOptions:
    """Values of a coarse cloth and of its solve.

    Attributes:
        step: Time step [s].
        iterations: Projections per step.
        spring: Spring stiffness [N/m].
        give: Shortest length of a spring, as a part of its rest length.
        bend: Weight of the squared Laplacian [N/m], keeps the cage smooth.
        drag: Part of the velocity lost per second.
        density: Areal density [kg/m^2].
        contact: Stiffness with which points that are moved out of something stay there, in springs; with 0 they
            are moved but do not hold up their neighbours.
    """

    step: float = 1.0 / 48.0
    iterations: int = 12
    spring: float = 40.0
    give: float = 0.8
    bend: float = 0.15
    drag: float = 1.0
    density: float = 0.2
    contact: float = 0.0


class Drape:
    """A cloth with positions and velocities that is stepped through time."""

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        pinned: np.ndarray,
        *,
        options: DrapeOptions,
        project: Callable[[np.ndarray, float], np.ndarray] | None = None,
        start: np.ndarray | None = None,
    ) -> None:
        """Factorise the constant system.

        Args:
            rest: Rest positions [m], shape (V, 3).
            faces: Triangles or quads, shape (F, 3) or (F, 4).
            pinned: Vertices following targets, shape (K,).
            project: Moves positions out of colliders at a time, in place of contact forces; or None.
            start: Positions at the beginning when they differ from ``rest``.
        """
        self.options, self.pinned, self._project = options, pinned, project
        self.points = np.array(rest if start is None else start, dtype=float)
        self.velocity = np.zeros_like(self.points)
        self.time = 0.0
        ends = springs(faces)
        count = len(rest)
        self._length = np.linalg.norm(rest[ends[:, 1]] - rest[ends[:, 0]], axis=1)
        rows = np.repeat(np.arange(len(ends)), 2)
        signs = np.tile([-1.0, 1.0], len(ends))
        self._difference = sparse.csr_matrix((signs, (rows, ends.ravel())), shape=(len(ends), count))
        self._gather = (self.options.spring * self._difference.T).tocsr()
        self._inertia = self.options.density * _areas(rest, faces) / self.options.step**2
        self._hold = np.zeros(count)
        self._hold[pinned] = 1e3 * self.options.spring
        smooth = _smoothing(rest, faces)
        self._elastic = self._gather @ self._difference, self.options.bend * self.options.spring * (smooth.T @ smooth)
        self._touching = np.zeros(count, bool)
        self._solver = self._factorise()

    def _factorise(self) -> SuperLU:
        fixed = self._inertia + self._hold + self._contact()
        system = sparse.csc_matrix(sparse.diags(fixed) + self._elastic[0] + self._elastic[1])
        if self.options.contact == 0.0:
            return splu(system)
        # factorised often: an ordering for symmetric matrices is quicker
        return splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def _contact(self) -> np.ndarray:
        """Stiffness of the springs to moved points [N/m]."""
        return self.options.contact * self.options.spring * self._touching

    def step(self, targets: np.ndarray) -> np.ndarray:
        """Positions after one time step [m], shape (V, 3), from those of the pinned vertices [m], shape (K, 3)."""
        step = self.options.step
        self.time += step
        free = self.points + step * (1.0 - self.options.drag * step) * self.velocity + step * step * GRAVITY
        right = self._inertia[:, None] * free
        right[self.pinned] += self._hold[self.pinned, None] * targets
        points = free
        for iteration in range(self.options.iterations):
            edge = self._difference @ points
            length = np.linalg.norm(edge, axis=1)
            wanted = np.clip(length, self.options.give * self._length, self._length)
            held = self._contact()[:, None] * points
            points = self._solver.solve(right + held + self._gather @ (edge * (wanted / length)[:, None]))
            if self._project is not None:
                moved = self._project(points, self.time)
                if iteration < RENEWALS and self.options.contact > 0.0:
                    touching = np.abs(moved - points).max(axis=1) > 1e-9
                    touching = touching if iteration == 0 else touching | self._touching
                    if not np.array_equal(touching, self._touching):
                        self._touching = touching
                        self._solver = self._factorise()
                points = moved
        self.velocity = (points - self.points) / step
        self.points = points
        return points

    def film(self, frames: int, steps: int, targets: Callable[[float], np.ndarray]) -> np.ndarray:
        """Positions of frames that lie a number of steps apart [m], shape (frames, V, 3), the present ones first.

        ``targets`` gives the positions of the pinned vertices at a time [s].
        """
        samples = []
        for _ in range(frames):
            samples.append(self.points)
            for _ in range(steps):
                self.step(targets(self.time + self.options.step))
        return np.stack(samples)


def _smoothing(rest: np.ndarray, faces: np.ndarray) -> sparse.csr_matrix:
    """Distance of each vertex from its neighbours' mean; along the border only from its two border neighbours.

    Rows not vanishing at rest, at corners for example, are dropped: flat cloth must not curl.
    """
    size, count = faces.shape[1], len(rest)
    sides = np.sort(np.concatenate([faces[:, [i, (i + 1) % size]] for i in range(size)]), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    border = np.zeros(count, bool)
    border[edges[uses == 1]] = True
    pairs = np.concatenate([springs(faces), edges[uses == 1]])
    inner = np.arange(len(pairs)) < len(pairs) - np.count_nonzero(uses == 1)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[border[both[:, 0]] != np.tile(inner, 2)]
    weights = sparse.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    smooth = sparse.eye(count) - sparse.diags(1.0 / np.maximum(np.asarray(weights.sum(axis=1)).ravel(), 1.0)) @ weights
    edge = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1).mean()
    flat = np.linalg.norm(smooth @ rest, axis=1) < 0.3 * edge
    return sparse.csr_matrix(sparse.diags(flat.astype(float)) @ smooth)


def _areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Each vertex's share of the area of its faces [m^2]."""
    corners = points[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1]), axis=1)
    total = np.zeros(len(points))
    for i in range(faces.shape[1]):
        np.add.at(total, faces[:, i], area / faces.shape[1])
    return total
