"""`physgraph` on CUDA: a step recorded once as a graph of kernels and replayed.

A step of some hundred small kernels costs a GPU a tenth of a millisecond and Python several: replayed, only the first
is left. Everything between two steps lives in buffers that stay where they are. The L-BFGS direction is a combination
of vectors whose coefficients depend on their scalar products alone, so one product of matrices, a kernel of one thread
a garment and one more product replace the two loops of `secants.secant_direction`.

| symbol | here | meaning |
|---|---|---|
| s_i, y_i, z_i | ``rows`` 0-4, 5-9, 10-14 | moves, differences of negative forces, their images; newest last |
| F, H0^-1 F | ``rows`` 15, 16 | force and its image |
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportIndexIssue=false, reportReturnType=false
from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.threads import Launch
from .base import Carry, System

wp.set_module_options({"enable_backward": False})

SECANTS = 5
"""Secant pairs kept."""
FORCE, IMAGE, ROWS = 3 * SECANTS, 3 * SECANTS + 1, 3 * SECANTS + 2
MOST_GARMENTS = 8
"""Garments solved together beyond which steps are not recorded: each has scalar products of its own."""
Propose = Callable[["Recording"], Tensor]


@dataclass(frozen=True, eq=False)
class Place:
    """Where a carry stands: its recording, and how many steps that had made."""

    recording: Recording
    version: int


class Recording:
    """The steps of one system.

    Attributes:
        system: The system.
        x: Positions [m].
        known: Energy [J] and remaining move in edge lengths, float64, shape (2,).
        rows: What the direction combines, shape (17, V, 3).
        images: H0^-1 F one and two steps ago [m], shape (2, V, 3).
        force_before: Force one step ago [N].
        step: Steps made, float32 scalar.
        version: The same, on the host; a carry of another version is of the past.
    """

    def __init__(self, system: System, propose: Propose) -> None:
        """Make the buffers.

        Args:
            system: A system on CUDA.
            propose: Gives the next displacement [m]; it reads this recording.
        """
        self.system, self._propose = system, propose
        count, like = len(system.spacing), {"dtype": system.spacing.dtype, "device": system.spacing.device}
        self.x, self.force_before = torch.zeros((count, 3), **like), torch.zeros((count, 3), **like)
        self.rows, self.images = torch.zeros((ROWS, count, 3), **like), torch.zeros((2, count, 3), **like)
        self.known = torch.zeros(2, dtype=torch.float64, device=like["device"])
        self.step = torch.zeros((), device=like["device"])
        level = system.level
        self._spans = (slice(0, count),) if level is None else level.spans
        self._products = torch.zeros((len(self._spans), ROWS, ROWS), **like)
        self._coefficients = torch.zeros((len(self._spans), ROWS), **like)
        arrays = [wp.from_torch(self._products), wp.from_torch(self._coefficients)]
        self._combine = Launch(_KERNEL[like["dtype"]], len(self._spans), arrays, device=str(like["device"]))
        self._graph: torch.cuda.CUDAGraph | None = None
        self._loaded = False
        self.version, self._from = 0, -1

    def begin(self, x: Tensor, energy: float, force: Tensor, image: Tensor) -> Carry:
        """Start at x with an empty memory."""
        self.rows.zero_()
        self.images.zero_()
        self.force_before.zero_()
        self.step.zero_()
        return self.go_on(x, energy, force, image)

    def go_on(self, x: Tensor, energy: float, force: Tensor, image: Tensor) -> Carry:
        """Start at x with the memory that there is."""
        self.x.copy_(x)
        self.rows[FORCE].copy_(force)
        self.rows[IMAGE].copy_(image)
        self.version += 1
        return Carry(x, energy, force, image, "physgraph", Place(self, self.version))

    def take_over(self, other: Recording) -> None:
        """The memory of another recording of the same cloth."""
        for mine, theirs in ((self.rows, other.rows), (self.images, other.images)):
            mine.copy_(theirs)
        self.force_before.copy_(other.force_before)
        self.step.copy_(other.step)

    def advance(self, carry: Carry) -> Carry:
        """One step; a carry of the past starts again from where it was."""
        place: Place = carry.memory
        if place.version != self.version:
            assert carry.preconditioned is not None
            self.begin(carry.x, carry.energy, carry.force, carry.preconditioned)
        self._run()
        self.system.evaluations += 1
        self._from = place.version
        self.version += 1
        x, force, image = self.x.clone(), self.rows[FORCE].clone(), self.rows[IMAGE].clone()
        energy, remaining = self.known.tolist()  # One wait for both.
        return Carry(x, energy, force, image, "physgraph", Place(self, self.version), remaining=remaining)

    def follow(self, carry: Carry, x: Tensor, energy: float, force: Tensor, image: Tensor) -> Carry:
        """Put a step from a carry to x in the place of the one that was made from there last."""
        place: Place = carry.memory
        if place.version != self._from:
            return self.begin(x, energy, force, image)
        last = SECANTS - 1
        self.rows[last].copy_(x - carry.x)
        self.rows[SECANTS + last].copy_(self.force_before - force)
        self.rows[2 * SECANTS + last].copy_(self.images[0] - image)
        return self.go_on(x, energy, force, image)

    def direction(self) -> Float[Tensor, "vertices 3"]:
        """The L-BFGS direction of each garment [m]."""
        flat = self.rows.reshape(ROWS, -1)
        out = torch.empty_like(self.x)
        parts = [flat[:, 3 * span.start : 3 * span.stop] for span in self._spans]
        for number, part in enumerate(parts):
            torch.mm(part, part.T, out=self._products[number])
        self._combine({})
        for number, part in enumerate(parts):
            span = self._spans[number]
            out[span] = (self._coefficients[number].unsqueeze(0) @ part).reshape(-1, 3)
        return out

    def _run(self) -> None:
        """The first step as it is, which loads every kernel; the second is recorded; all others are replayed."""
        if not self._loaded or not self.x.is_cuda:
            self._loaded = True
            self._step()
            return
        if self._graph is None:
            graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side), uncollected():
                graph.capture_begin(pool=_anchor(self.x.device).pool(), capture_error_mode="relaxed")
                self._step()
                graph.capture_end()
            torch.cuda.current_stream().wait_stream(side)
            self._graph = graph
            self.system.metric_solves -= 1  # recording is no solve
        self._graph.replay()
        self.system.metric_solves += 1

    def _step(self) -> None:
        """The kernels of a step."""
        system, rows = self.system, self.rows
        move = self._propose(self)
        x = self.x + move
        energy, force = system.field.energy_and_force(x)
        force = force * system.free
        image = system.apply_smooth_inverse(force)
        self.images.copy_(torch.stack([rows[IMAGE], self.images[0]]))
        self.force_before.copy_(rows[FORCE])
        last = SECANTS - 1
        new = [rows[1 : last + 1], move.unsqueeze(0), rows[SECANTS + 1 : SECANTS + last + 1]]
        new += [(rows[FORCE] - force).unsqueeze(0), rows[2 * SECANTS + 1 : 2 * SECANTS + last + 1]]
        new += [(rows[IMAGE] - image).unsqueeze(0), force.unsqueeze(0), image.unsqueeze(0)]
        rows.copy_(torch.cat(new))
        self.x.copy_(x)
        self.known.copy_(torch.stack([energy.double(), system.relative_move(image)]))
        self.step += 1.0


@functools.cache
def _anchor(device: torch.device) -> torch.cuda.CUDAGraph:
    """A graph that stays, and with it the memory that all recordings on a device share.

    They are replayed one after another and leave nothing in it.
    """
    graph, one = torch.cuda.CUDAGraph(), torch.zeros((), device=device)
    with torch.cuda.device(device), torch.cuda.graph(graph):
        one.add_(1.0)
    return graph


@contextmanager
def uncollected() -> Iterator[None]:
    """Hold back the garbage collector: it may free an earlier frame's device memory, which no recording allows."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


@wp.func
def two_loops(
    products: wp.array(dtype=Any, ndim=3),
    g: wp.int32,
    out: wp.array(dtype=Any, ndim=2),
    inverse: Any,
    weight: Any,
    along: Any,
):
    """The recursion of `secants.secant_direction` on scalar products; ``inverse`` is 1 / s.y, or 0 for a bad pair."""
    n = wp.static(SECANTS)
    for k in range(n):
        i = n - 1 - k
        rest = products[g, i, 3 * n]
        for j in range(i + 1, n):
            rest = rest - weight[j] * products[g, i, n + j]
        weight[i] = inverse[i] * rest
    gamma = inverse.dtype(1.0)
    if inverse[n - 1] > inverse.dtype(0.0):
        gamma = gamma / (inverse[n - 1] * products[g, 2 * n - 1, 3 * n - 1])
    for i in range(n):
        seen = gamma * products[g, n + i, 3 * n + 1]
        for j in range(n):
            seen = seen - gamma * weight[j] * products[g, n + i, 2 * n + j]
        for j in range(i):
            seen = seen + along[j] * products[g, n + i, j]
        along[i] = weight[i] - inverse[i] * seen
    for i in range(n):
        out[g, i] = along[i]
        out[g, n + i] = inverse.dtype(0.0)
        out[g, 2 * n + i] = -gamma * weight[i]
    out[g, 3 * n] = inverse.dtype(0.0)
    out[g, 3 * n + 1] = gamma


def _overload(scalar: type) -> wp.Kernel:
    """The coefficients of the L-BFGS direction from the vectors' scalar products, one thread a garment."""
    each = wp.types.vector(length=SECANTS, dtype=scalar)

    @wp.kernel(module="unique")
    def combine(first: wp.int32, products: wp.array(dtype=scalar, ndim=3), out: wp.array(dtype=scalar, ndim=2)):
        g = first + wp.tid()
        n = wp.static(SECANTS)
        inverse, weight, along = each(), each(), each()
        for i in range(n):
            curvature = products[g, i, n + i]
            floor = scalar(1.0e-8) * wp.sqrt(products[g, i, i] * products[g, n + i, n + i])
            if curvature > floor and products[g, n + i, 2 * n + i] > scalar(0.0):
                inverse[i] = scalar(1.0) / curvature
        two_loops(products, g, out, inverse, weight, along)

    return combine


_KERNEL = {torch.float32: _overload(wp.float32), torch.float64: _overload(wp.float64)}
