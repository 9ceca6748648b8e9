"""Steps on CUDA: recorded once as a graph of kernels and replayed.

A step of some hundred small kernels costs a tenth of a millisecond on a GPU, and several in Python: a replay saves the
latter. A graph reads and writes fixed buffers, so a carry is copied in before a replay and out after.

The L-BFGS direction is a combination of fields with coefficients depending on scalar products only, so one product of
matrices, a kernel of one thread per garment and one more product replace the two loops of `secants`.

| symbol | field | meaning |
|---|---|---|
| s_i, y_i, z_i | 0-4, 5-9, 10-14 | moves, differences of negative forces, their images; newest last |
| F, H0^-1 F | 15, 16 | force and its image |
| | 17-20 | x, the force before, the two images before |
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportReturnType=false
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import torch
import warp as wp
from torch import Tensor

from ..mesh.kernels import ALONE, KERNELS
from ..mesh.threads import Launch
from .base import Carry, System
from .capture import captured
from .secants import Dot, Secant

wp.set_module_options(KERNELS)

SECANTS = 5
"""Secants kept."""
MOST_GARMENTS = 8
"""Most garments solved together with recorded steps: each garment has separate scalar products."""
KEPT = 12
"""Recordings kept: enough for the levels of one or two garments, with contact and without."""
WORTH = 6
"""Least number of steps for recording a system used only once: recording costs as much as four steps."""
COMBINED, FIELDS = 3 * SECANTS + 2, 3 * SECANTS + 6
"""Number of fields combined by the L-BFGS direction, and of all fields."""


@dataclass(frozen=True, eq=False)
class Memory:
    """The past of a step.

    Attributes:
        force: Force one step ago [N].
        images: H0^-1 F one and two steps ago [m].
        secants: The last `SECANTS`, oldest first.
        step: Number of steps made; a scalar on the device while a step is recorded.
    """

    force: Tensor
    images: tuple[Tensor, Tensor]
    secants: tuple[Secant, ...] = ()
    step: int | Tensor = 0

    def after(self, carry: Carry, move: Tensor, force: Tensor, image: Tensor, *, dot: Dot) -> Memory:
        """The memory after a displacement [m] from a carry with this memory; force [N] and image [m] are at the end."""
        assert carry.preconditioned is not None
        newest = Secant(move, carry.force - force, carry.preconditioned - image, dot)
        images = (carry.preconditioned, self.images[0])
        return Memory(carry.force, images, (*self.secants, newest)[-SECANTS:], self.step + 1)


class Propose(Protocol):
    """Gives the next displacement [m] from a carry, given a function for the L-BFGS direction."""

    def __call__(self, carry: Carry, *, secant: Callable[[Carry], Tensor]) -> Tensor:
        """The displacement [m]."""
        ...


class Recording:
    """The recorded steps of one system on CUDA: for the network, and as base class for any integrator."""

    def __init__(self, system: System, propose: Propose, *, dot: Dot, together: bool = False) -> None:
        """Make the buffers.

        Args:
            system: The system.
            propose: Gives the next displacement [m].
            dot: The scalar product for unrecorded steps.
            together: Whether all garments share one L-BFGS direction.
        """
        self._system, self._propose, self._dot = system, propose, dot
        like = {"dtype": system.spacing.dtype, "device": system.spacing.device}
        self._fields = torch.zeros((FIELDS, len(system.spacing), 3), **like)
        self._after, self._nothing = torch.zeros_like(self._fields), torch.zeros_like(self._fields[0])
        self._scalars_after: Tensor | None = None
        self._step = torch.zeros((), device=like["device"])
        each = None if together or system.level is None else system.level.spans
        self._spans = each or (slice(0, len(system.spacing)),)
        self._products = torch.zeros((len(self._spans), COMBINED, COMBINED), **like)
        self._coefficients = torch.zeros((len(self._spans), COMBINED), **like)
        arrays = [wp.from_torch(self._products), wp.from_torch(self._coefficients)]
        self._combine = Launch(_KERNEL[like["dtype"]], len(self._spans), arrays, device=str(like["device"]))
        self._graph: torch.cuda.CUDAGraph | None = None
        self._loaded = False

    def step(self, system: System, carry: Carry) -> Carry:
        """One step of a system with the recorded system's values; counts evaluations and solves in the given system."""
        step = carry.memory.step
        torch.stack(self._fields_of(carry), out=self._fields)
        self._step.fill_(step)
        solves = system.metric_solves
        self._run()
        system.evaluations, system.metric_solves = system.evaluations + 1, solves + 1
        after = self._carry_of(self._after.clone(), step + 1)
        assert self._scalars_after is not None
        energy, remaining, *others = self._scalars_after.tolist()  # One wait for all.
        return self._judged(carry, replace(after, energy=energy, remaining=remaining), others)

    def _judged(self, before: Carry, after: Carry, measures: Sequence[float]) -> Carry:
        """The carry to continue with, from the carries before and after and the results of `_measures`."""
        return after

    def _measures(self, before: Carry, after: Carry, move: Tensor) -> list[Tensor]:
        """Numbers of a step beside the energy and the remaining move."""
        return []

    def _fields_of(self, carry: Carry) -> list[Tensor]:
        """The fields of a carry, in buffer order."""
        memory: Memory = carry.memory
        assert carry.preconditioned is not None
        unused = (Secant(self._nothing, self._nothing, self._nothing),) * (SECANTS - len(memory.secants))
        secants = (*unused, *memory.secants)
        fields = [getattr(each, name) for name in ("move", "yields", "image") for each in secants]
        return [*fields, carry.force, carry.preconditioned, carry.x, memory.force, *memory.images]

    def _carry_of(self, fields: Tensor, step: int | Tensor) -> Carry:
        """The carry of given fields; the energy is unknown."""
        force, image, x, before, *images = fields[3 * SECANTS :]
        moves, yields, images_of_yields = (fields[k * SECANTS : (k + 1) * SECANTS] for k in range(3))
        secants = tuple(Secant(*each, dot=self._dot) for each in zip(moves, yields, images_of_yields, strict=True))
        return Carry(x, math.nan, force, image, "physgraph", Memory(before, (images[0], images[1]), secants, step))

    def _direction(self, _: Carry) -> Tensor:
        """The L-BFGS direction of each garment [m], for the carry in the buffers."""
        flat, out = self._fields[:COMBINED].reshape(COMBINED, -1), torch.empty_like(self._nothing)
        parts = [flat[:, 3 * span.start : 3 * span.stop] for span in self._spans]
        for part, products in zip(parts, self._products, strict=True):
            torch.mm(part, part.T, out=products)
        self._combine({})
        for part, span, coefficients in zip(parts, self._spans, self._coefficients, strict=True):
            out[span] = (coefficients.unsqueeze(0) @ part).reshape(-1, 3)
        return out

    def _run(self) -> None:
        """Run the first step unrecorded, to load every kernel; record the second; replay all later steps."""
        if not self._loaded or not self._fields.is_cuda:
            self._loaded = True
            self._advance()
            return
        if self._graph is None:
            self._graph = captured(self._advance, self._fields.device)
        self._graph.replay()

    def _advance(self) -> None:
        """The kernels of a step, as for an unrecorded step, between buffers."""
        system, before = self._system, self._carry_of(self._fields, self._step)
        move = self._propose(before, secant=self._direction)
        x = before.x + move
        energy, force = system.field.energy_and_force(x)
        force = force * system.free
        image = self._image(force)
        memory = before.memory.after(before, move, force, image, dot=self._dot)
        after = Carry(x, math.nan, force, image, memory=memory)
        torch.stack(self._fields_of(after), out=self._after)
        scalars = [energy, system.relative_move(image), *self._measures(before, after, move)]
        found = torch.stack([each.double().reshape(()) for each in scalars])
        if self._scalars_after is None:  # The first step is not recorded.
            self._scalars_after = torch.zeros_like(found)
        self._scalars_after.copy_(found)

    def _image(self, force: Tensor) -> Tensor:
        """H0^-1 F [m]."""
        return self._system.apply_short_inverse(force)


RecordingT = TypeVar("RecordingT", bound=Recording)


class Recordings(Generic[RecordingT]):
    """The recordings of the last few lasting systems, and of the last non-lasting system."""

    def __init__(self) -> None:
        """Start empty."""
        self._kept: dict[System, RecordingT] = {}

    def of(self, system: System, make: Callable[[], RecordingT]) -> RecordingT:
        """The recording of a system's steps, created if missing."""
        recording = self._kept.pop(system, None)
        if recording is None:
            recording = make()
            for other in [each for each in self._kept if not (each.lasting or system.lasting)]:
                del self._kept[other]
        self._kept[system] = recording
        while len(self._kept) > KEPT:
            del self._kept[next(iter(self._kept))]
        return recording


def pays(system: System) -> bool:
    """Whether recording a system's steps is worthwhile: on CUDA, for a reused system or many steps."""
    return system.spacing.is_cuda and (system.recorded.lasting or system.expected >= WORTH)


@wp.func
def two_loops(
    products: wp.array(dtype=Any, ndim=3),
    g: wp.int32,
    out: wp.array(dtype=Any, ndim=2),
    inverse: Any,
    weight: Any,
    amount: Any,
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
        projected = gamma * products[g, n + i, 3 * n + 1]
        for j in range(n):
            projected = projected - gamma * weight[j] * products[g, n + i, 2 * n + j]
        for j in range(i):
            projected = projected + amount[j] * products[g, n + i, j]
        amount[i] = weight[i] - inverse[i] * projected
    for i in range(n):
        out[g, i] = amount[i]
        out[g, n + i] = inverse.dtype(0.0)
        out[g, 2 * n + i] = -gamma * weight[i]
    out[g, 3 * n] = inverse.dtype(0.0)
    out[g, 3 * n + 1] = gamma


def _overload(scalar: type) -> wp.Kernel:
    """The coefficients of the L-BFGS direction from the vectors' scalar products, one thread per garment."""
    each = wp.types.vector(length=SECANTS, dtype=scalar)

    @wp.kernel(**ALONE)
    def combine(first: wp.int32, products: wp.array(dtype=scalar, ndim=3), out: wp.array(dtype=scalar, ndim=2)):
        g = first + wp.tid()
        n = wp.static(SECANTS)
        inverse, weight, amount = each(), each(), each()
        for i in range(n):
            curvature = products[g, i, n + i]
            floor = scalar(1.0e-8) * wp.sqrt(products[g, i, i] * products[g, n + i, n + i])
            if curvature > floor and products[g, n + i, 2 * n + i] > scalar(0.0):
                inverse[i] = scalar(1.0) / curvature
        two_loops(products, g, out, inverse, weight, amount)

    return combine


_KERNEL = {torch.float32: _overload(wp.float32), torch.float64: _overload(wp.float64)}
