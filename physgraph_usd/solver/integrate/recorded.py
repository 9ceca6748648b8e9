"""`physgraph` on CUDA: a step recorded once as a graph of kernels and replayed.

A step of some hundred small kernels costs a GPU a tenth of a millisecond and Python several: replayed, only the first
is left. A graph reads and writes buffers that stay where they are, so a carry is copied in before it and out after.
"""

from __future__ import annotations

import functools
import gc
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .base import Carry, System
from .secants import Dot, Secant, secant_of

SECANTS = 5
"""Secants kept."""
MOST_GARMENTS = 8
"""Garments solved together beyond which steps are not recorded: each has scalar products of its own."""
PAST = 6
"""Fields of a carry before its secants: x, force, its image, the force before, the two images before."""


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
        """The memory after a displacement [m] from a carry with this one to where force [N] and image [m] are."""
        assert carry.preconditioned is not None
        newest = secant_of(move, carry.force - force, carry.preconditioned - image, dot=dot)
        images = (carry.preconditioned, self.images[0])
        return Memory(carry.force, images, (*self.secants, newest)[-SECANTS:], self.step + 1)


class Recording:
    """The steps of one system on CUDA."""

    def __init__(self, system: System, propose: Callable[[Carry], Tensor], dot: Dot) -> None:
        """Make the buffers.

        Args:
            system: The system.
            propose: Gives the next displacement [m].
            dot: The scalar product, which waits for no number.
        """
        self._system, self._propose, self._dot = system, propose, dot
        like = {"dtype": system.spacing.dtype, "device": system.spacing.device}
        self._fields = torch.zeros((PAST + 3 * SECANTS, len(system.spacing), 3), **like)
        shape = dot(self._fields[0], self._fields[0]).shape
        self._curvatures = torch.full((SECANTS, *shape), math.inf, **like)
        nothing = torch.zeros_like(self._fields[0])
        self._unused = (Secant(nothing, nothing, nothing, self._curvatures[0].clone()),)
        self._step = torch.zeros((), device=like["device"])
        self._fields_after, self._curvatures_after = self._fields.clone(), self._curvatures.clone()
        self._known_after = torch.zeros(2, dtype=torch.float64, device=like["device"])
        self._graph: torch.cuda.CUDAGraph | None = None
        self._loaded = False

    def step(self, carry: Carry) -> Carry:
        """One step."""
        memory: Memory = carry.memory
        assert carry.preconditioned is not None
        secants = self._unused * (SECANTS - len(memory.secants)) + memory.secants
        fields = [carry.x, carry.force, carry.preconditioned, memory.force, *memory.images]
        fields += [field for each in secants for field in (each.move, each.yields, each.image)]
        torch.stack(fields, out=self._fields)
        torch.stack([each.curvature for each in secants], out=self._curvatures)
        self._step.fill_(memory.step)
        self._run()
        self._system.evaluations += 1
        after = _carry_of(self._fields_after.clone(), self._curvatures_after.clone(), memory.step + 1)
        energy, remaining = self._known_after.tolist()  # One wait for both.
        return replace(after, energy=energy, remaining=remaining)

    def _run(self) -> None:
        """The first step as it is, which loads every kernel; the second is recorded; all others are replayed."""
        if not self._loaded or not self._fields.is_cuda:
            self._loaded = True
            self._advance()
            return
        if self._graph is None:
            graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side), uncollected():
                graph.capture_begin(pool=_anchor(self._fields.device).pool(), capture_error_mode="relaxed")
                self._advance()
                graph.capture_end()
            torch.cuda.current_stream().wait_stream(side)
            self._graph = graph
            self._system.metric_solves -= 1  # recording is no solve
        self._graph.replay()
        self._system.metric_solves += 1

    def _advance(self) -> None:
        """The kernels of a step: those of a step that is not recorded, between buffers."""
        system, before = self._system, _carry_of(self._fields, self._curvatures, self._step)
        move = self._propose(before)
        x = before.x + move
        energy, force = system.field.energy_and_force(x)
        force = force * system.free
        image = system.apply_smooth_inverse(force)
        memory = before.memory.after(before, move, force, image, dot=self._dot)
        fields = [x, force, image, memory.force, *memory.images]
        fields += [field for each in memory.secants for field in (each.move, each.yields, each.image)]
        torch.stack(fields, out=self._fields_after)
        torch.stack([each.curvature for each in memory.secants], out=self._curvatures_after)
        self._known_after.copy_(torch.stack([energy.double(), system.relative_move(image)]))


def _carry_of(fields: Tensor, curvatures: Tensor, step: int | Tensor) -> Carry:
    """The carry whose fields and curvatures lie in buffers; its energy is not known."""
    x, force, image, force_before, *images = fields[:PAST]
    moves, yields, images_of_yields = (fields[PAST + part :: 3] for part in range(3))
    secants = tuple(map(Secant, moves, yields, images_of_yields, curvatures))
    memory = Memory(force_before, (images[0], images[1]), secants, step)
    return Carry(x, math.nan, force, image, "physgraph", memory)


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
