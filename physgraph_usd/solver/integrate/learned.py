"""The learned integrator: one force evaluation per step, no line search; the surrounding guard ensures safety.

| symbol | here | meaning |
|---|---|---|
| H0^-1 F | ``preconditioned`` | displacement of a linear cloth of the rest shape under F [m] |
| v_i | ``vectors`` | vectors for the network to combine, in local edge lengths |
| c_i | ``coefficients`` | output of the network |
| D | ``move`` | sum_i c_i v_i, no longer than `LONGEST_STEP` edges at any vertex |

The network sees a `System` only.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...errors import SolveError
from ..level import Level
from .base import Carry, System, root_sum
from .fused import FusedPhysgraph, fused_physgraph
from .network import Physgraph
from .quasi_newton import Secant, StepHistory, dot, secant_direction
from .vertex_frame import VertexFrame

NetworkT = TypeVar("NetworkT", bound=nn.Module)

MOST_GARMENTS = 8
"""Largest number of garments with scalar products summed per garment, in a fixed order."""
LONGEST_STEP = 5.0
"""Longest move of a vertex in a step, in edge lengths."""


class LearnedMetric:
    """`physgraph`: a network chooses coefficients of a few vectors, vertex by vertex, for the step."""

    name = "physgraph"

    def __init__(self, network: Physgraph, *, fuse: bool = True) -> None:
        """Keep the network.

        Args:
            fuse: Use the kernels of `fused` if no gradient is needed.
        """
        self._network = network
        self._trained = not any(parameter.requires_grad for parameter in network.parameters())
        self._fuse = fuse and self._trained

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x with an empty memory; the network runs in the system's precision."""
        self._network = placed(self._network, system, x.dtype)
        none = torch.zeros_like(x)
        return self._evaluated(system, x, StepHistory(none, (none, none)))

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate the carry's positions after a small change of the forces; the memory is kept."""
        return self._evaluated(system, carry.x, carry.memory)

    def _evaluated(self, system: System, x: Tensor, memory: StepHistory) -> Carry:
        """The carry at x [m] with a given memory."""
        energy, force = system.evaluated(x)
        image = system.apply_short_inverse(force)
        energy, remaining = torch.stack([energy, system.relative_move(image.detach())]).tolist()
        return Carry(x, energy, force, image, self.name, memory, remaining=remaining)

    def step(self, system: System, carry: Carry) -> Carry:
        """One step along the network's combination."""
        move = self.propose(system, carry)
        return self._reached(system, carry, carry.x + move, move)

    def follow(self, system: System, carry: Carry, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x [m] and remember the displacement to x as a step of the network."""
        return self._reached(system, carry, x, x - carry.x)

    def _reached(self, system: System, carry: Carry, x: Tensor, move: Tensor) -> Carry:
        """The carry at x [m], a displacement away from the previous carry."""
        energy, force = system.evaluated(x)
        image = system.apply_short_inverse(force)
        newest, remaining = self._secant(system, (carry.force, force, carry.preconditioned, image, move))
        energy, remaining = torch.stack([energy, remaining.detach()]).tolist()  # On a card one wait for both.
        return Carry(x, energy, force, image, self.name, carry.memory.after(carry, newest), remaining=remaining)

    def _secant(self, system: System, ends: tuple[Any, ...]) -> tuple[Secant, Tensor]:
        """The secant of a step, given F and H0^-1 F before and after, and the displacement; and the remaining move."""
        before, force, image_before, image, move = ends
        level = system.level
        if self._trained and not system.on_card:  # Waiting for numbers costs nothing.
            spans = level.spans if level is not None and len(level.spans) > 1 else ()
            return Secant(move, before - force, image_before - image, dot, spans), system.relative_move(image)
        product = partial(garment_dot, level)
        if not system.on_card or not self._trained or level is None:
            return Secant(move, before - force, image_before - image, product), system.relative_move(image)
        given = *ends, system.per_edge
        made = level.recordings.run("secant", lambda *each: _differences(level, *each), *given)
        yields, change, curvature, remaining = made
        return Secant(move, yields, change, product, known=curvature), remaining

    def propose(self, system: System, carry: Carry) -> Float[Tensor, "vertices 3"]:
        """The displacement of the next step [m]."""
        fused, memory, level = self._fused(system), carry.memory, system.level
        if fused is None:
            return self._combined(system, carry)
        if level is None or not system.on_card:
            bias, stiffness = fused.bias_at(memory.step), system.rest_diagonal_columns
            return _by_kernel(fused, level, carry, bias=bias, sizes=(stiffness, system.spacing, system.reach))
        now = carry.x, carry.force, carry.preconditioned, *_past(fused, system, memory)
        return level.recordings.run(fused, lambda *given: [_moved(fused, level, given)], *now)[0]

    def _fused(self, system: System) -> FusedPhysgraph | None:
        """The network as kernels, or None if not fused."""
        if not self._fuse or system.spacing.dtype != torch.float32:
            return None
        threads = 1 if system.level is None else system.level.threads
        spacing = system.spacing
        return fused_physgraph(self._network, len(spacing), LONGEST_STEP, device=str(spacing.device), threads=threads)

    def _combined(self, system: System, carry: Carry) -> Tensor:
        """The network's combination of vectors [m]."""
        frame = cache(lambda: VertexFrame(level_of(system.level), carry.x))
        whole = partial(_vector, carry=carry, stiffness=system.rest_diagonal_columns)
        stacked = torch.stack(vectors_of(self._network.config.vectors, whole, frame=frame), dim=1)  # V N 3
        coefficients = self._network(stacked / system.spacing.reshape(-1, 1, 1), carry.memory.step)  # V N
        move = (coefficients.unsqueeze(2) * stacked).sum(dim=1)  # V 3
        return limited(move, system.spacing) * system.free


def _past(fused: FusedPhysgraph, system: System, memory: StepHistory) -> list[Tensor]:
    """All that a step reads besides x, F and H0^-1 F: three sizes of vertices, the past, and four tensors a secant."""
    secants = [part for each in memory.secants for part in (each.move, each.yields, each.image, each.curvature)]
    sizes = system.rest_diagonal_columns, system.spacing, system.reach
    return [*sizes, fused.bias_at(memory.step), memory.force, *memory.images, *secants]


def _moved(fused: FusedPhysgraph, level: Level, given: Sequence[Tensor]) -> Tensor:
    """`_by_kernel` of tensors alone: x, F, H0^-1 F, and `_past`."""
    x, force, image, stiffness, spacing, reach, bias, before, first, second, *parts = given
    fields, product = zip(*[iter(parts)] * 4, strict=True), partial(garment_dot, level)
    secants = tuple(Secant(*each, dot=product, known=curvature) for *each, curvature in fields)
    carry = Carry(x, 0.0, force, image, memory=StepHistory(before, (first, second), secants))
    return _by_kernel(fused, level, carry, bias=bias, sizes=(stiffness, spacing, reach))


def _differences(
    level: Level,
    before: Tensor,
    force: Tensor,
    image_before: Tensor,
    image: Tensor,
    move: Tensor,
    per_edge: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of a step: differences of negative forces and of images, the secant's curvature, and the remaining move."""
    made = Secant(move, before - force, image_before - image, partial(garment_dot, level))
    return made.yields, made.image, made.curvature, root_sum(image * per_edge)


def _by_kernel(
    fused: FusedPhysgraph, level: Level | None, carry: Carry, *, bias: Tensor, sizes: tuple[Tensor, Tensor, Tensor]
) -> Tensor:
    """Displacement of the next step [m], by the network as a kernel.

    Args:
        carry: The state.
        bias: `FusedPhysgraph.bias_at` the number of steps made.
        sizes: Diagonal of H0 [N/m], in three columns; the spacing, and the spacing, 0 at fixed vertices [m].
    """

    def frame() -> VertexFrame:
        return VertexFrame(level_of(level), carry.x)

    stiffness, spacing, reach = sizes
    vectors = vectors_of(fused.bases, partial(_vector, carry=carry, stiffness=stiffness), frame=frame)
    return fused(vectors, spacing, reach, bias, frame=frame)


def _vector(name: str, *, carry: Carry, stiffness: Tensor) -> Tensor:
    """One of `network.WHOLE` [m]; zero if the history is too short."""
    memory: StepHistory = carry.memory
    if name == "secant":
        assert carry.preconditioned is not None
        return secant_direction(carry.force, carry.preconditioned, memory.secants)
    if name.startswith("diagonal"):
        return (memory.force if name == "diagonal1" else carry.force) / stiffness
    if name.startswith("metric"):
        image = (carry.preconditioned, *memory.images)[int(name.removeprefix("metric") or 0)]
        assert image is not None
        return image
    age = int(name.removeprefix("move"))
    return memory.secants[-age].move if age <= len(memory.secants) else torch.zeros_like(carry.x)


def placed(network: NetworkT, system: System, dtype: torch.dtype) -> NetworkT:
    """The network on the system's device and in a scalar type: the same object or a copy."""
    parameter, device = next(network.parameters()), system.spacing.device
    fits = (parameter.device, parameter.dtype) == (device, dtype)
    return network if fits else copy.deepcopy(network).to(device=device, dtype=dtype)


def limited(move: Float[Tensor, "vertices 3"], spacing: Float[Tensor, " vertices"]) -> Float[Tensor, "vertices 3"]:
    """The displacement, limited to `LONGEST_STEP` local edge lengths at each vertex."""
    size = move.square().sum(dim=1, keepdim=True).clamp_min(torch.finfo(move.dtype).tiny).sqrt()
    return move * (LONGEST_STEP * spacing.unsqueeze(1) / size).clamp_max(1.0)


def vectors_of(
    names: Sequence[str], whole: Callable[[str], Tensor], *, frame: Callable[[], VertexFrame]
) -> list[Tensor]:
    """The vectors of given names [m]; names with a dot are parts of whole vectors (`vertex_frame.PARTS`).

    Args:
        names: Names in `network.VECTORS`.
        whole: Gives a vector for a name without a dot.
        frame: Gives the surroundings of the vertices.
    """
    found: dict[str, Tensor] = {}
    for name in names:
        base, _, part = name.partition(".")
        if base not in found:
            found[base] = whole(base)
        if part:
            found[name] = frame().part(found[base], part)
    return [found[name] for name in names]


def garment_dot(level: Level | None, a: Tensor, b: Tensor) -> Tensor:
    """The scalar product of two fields in each garment, at each vertex of the garment; (1, 1) for a single garment."""
    if level is None or len(level.spans) == 1:
        return torch.dot(a.reshape(-1), b.reshape(-1)).reshape(1, 1)
    each, owner = (a * b).sum(dim=1, keepdim=True), level.vertex_garment.long()
    if len(level.spans) <= MOST_GARMENTS:  # In a fixed order.
        return torch.stack([each[span].sum(dim=0) for span in level.spans])[owner]
    return each.new_zeros(len(level.spans), 1).index_add_(0, owner, each)[owner]


def level_of(level: Level | None) -> Level:
    """The level of a system.

    Raises:
        SolveError: The system has no level.
    """
    if level is None:
        raise SolveError("this network needs a mesh, and the system has none")
    return level
