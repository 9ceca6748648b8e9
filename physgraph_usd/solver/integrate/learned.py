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
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...errors import SolveError
from ..level import Level
from .ahead import read
from .base import Carry, System
from .fused import Past, fused_physgraph
from .network import Physgraph
from .quasi_newton import SECANTS, Secant, StepHistory, secant_direction
from .secants import SecantProducts, Secants, rotated_fields, secant_products
from .vertex_frame import VertexFrame

NetworkT = TypeVar("NetworkT", bound=nn.Module)

MOST_GARMENTS = 8
"""Largest number of garments with scalar products summed per garment, in a fixed order."""
LONG_AGO = 8
"""Limit of the step count in a memory from another frame: networks are trained on descents of some 12 steps."""
LONGEST_STEP = 5.0
"""Longest move of a vertex in a step, in edge lengths."""


class LearnedMetric:
    """`physgraph`: a network chooses coefficients of a few vectors, vertex by vertex, for the step."""

    name = "physgraph"

    def __init__(self, network: Physgraph, *, fuse: bool = True) -> None:
        """Keep the network.

        Args:
            fuse: Use the kernels of `fused` and `secants` in single precision if no gradient is needed.
        """
        self._network = network
        self._fuse = fuse and not any(parameter.requires_grad for parameter in network.parameters())

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x with an empty memory; the network runs in the system's precision."""
        self._network = placed(self._network, system, x.dtype)
        none = torch.zeros_like(x)
        memory = _FusedHistory(none, (none, none), Secants.none(x, len(_spans(system)))) if self._fuses(x) else None
        return self._evaluated(system, x, memory or StepHistory(none, (none, none)))

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate the carry's positions after a small change of the forces; the memory is kept."""
        self._network = placed(self._network, system, carry.x.dtype)
        return self._evaluated(system, carry.x, carry.memory)

    def _evaluated(self, system: System, x: Tensor, memory: StepHistory | _FusedHistory) -> Carry:
        """The carry at x [m] with a given memory."""
        energy, force = system.evaluated(x)
        image = system.apply_short_inverse(force)
        if isinstance(memory, _FusedHistory):
            secants = _products_of(system).directed(memory.secants, force, image, is_new=False)
            memory = replace(memory, secants=secants)
        return read([self._unread(system, x, (energy, force, image), memory)])[0]

    def step(self, system: System, carry: Carry) -> Carry:
        """One step along the network's combination."""
        return read([self.ahead(system, carry)])[0]

    def most_ahead(self, carry: Carry) -> int:
        """Steps after which the carry's secants are still in the ring."""
        return carry.memory.secants.slots - SECANTS if isinstance(carry.memory, _FusedHistory) else 1

    def ahead(self, system: System, carry: Carry) -> Carry:
        """`step` without waiting for its numbers."""
        if not isinstance(carry.memory, _FusedHistory):
            move = self.propose(system, carry)
            return self._reached(system, carry, carry.x + move, move)
        move, x = self._by_kernel(system, carry)
        return self._reached(system, carry, x, move)

    def follow(self, system: System, carry: Carry, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x [m] and remember the displacement to x as a step of the network."""
        return read([self._reached(system, carry, x, x - carry.x)])[0]

    def _reached(self, system: System, carry: Carry, x: Tensor, move: Tensor) -> Carry:
        """The unread carry at x [m], a displacement away from the previous carry."""
        energy, force = system.evaluated(x)
        image = system.apply_short_inverse(force)
        assert carry.preconditioned is not None
        if isinstance(carry.memory, _FusedHistory):
            secants = carry.memory.secants.after(move, (carry.force, force), (carry.preconditioned, image))
            secants = _products_of(system).directed(secants, force, image, is_new=True)
            memory = carry.memory.after(carry, secants)
        else:
            yields, image_change = carry.force - force, carry.preconditioned - image
            secant = Secant(move, yields, image_change, partial(garment_dot, system.level))
            memory = carry.memory.after(carry, secant)
        return self._unread(system, x, (energy, force, image), memory)

    def _unread(self, system: System, x: Tensor, evaluated: tuple[Tensor, Tensor, Tensor], memory: Any) -> Carry:
        """An unread carry, given energy [J], force [N] and H0^-1 F [m] at x [m]."""
        energy, force, image = evaluated
        numbers = torch.stack([energy, system.relative_move(image.detach())])
        return Carry(x, math.nan, force, image, self.name, memory, unread=numbers)

    def propose(self, system: System, carry: Carry) -> Float[Tensor, "vertices 3"]:
        """The displacement of the next step [m]."""
        fused = isinstance(carry.memory, _FusedHistory)
        return self._by_kernel(system, carry)[0] if fused else self._combined(system, carry)

    def curvature(self, carry: Carry) -> Any:
        """The memory of a carry, if it has secants."""
        memory = carry.memory
        return memory if isinstance(memory, _FusedHistory) and memory.secants.count else None

    def transported(self, memory: Any, rotation: Float[Tensor, "vertices 3 3"]) -> Any:
        """The memory with all fields rotated at each vertex; rotations keep the scalar products."""
        fields = memory.secants.fields
        secants = replace(memory.secants, fields=rotated_fields(fields.flatten(0, 1), rotation).reshape(fields.shape))
        force, *images = rotated_fields(torch.stack([memory.force, *memory.images]), rotation)
        return _FusedHistory(force, (images[0], images[1]), secants, min(memory.step, LONG_AGO))

    def _fuses(self, x: Tensor) -> bool:
        """Whether the kernels make the steps from x."""
        return self._fuse and x.dtype == torch.float32

    def _by_kernel(self, system: System, carry: Carry) -> tuple[Tensor, Tensor]:
        """The displacement of the next step, and the positions after it [m], by the network as a kernel."""
        memory, level, spacing = carry.memory, system.level, system.spacing
        threads = 1 if level is None else level.threads
        fused = fused_physgraph(self._network, len(spacing), LONGEST_STEP, device=str(spacing.device), threads=threads)
        past = Past(
            memory.secants,
            force=carry.force,
            force1=memory.force,
            image=_of(carry.preconditioned),
            image1=memory.images[0],
            image2=memory.images[1],
            stiffness=system.rest_diagonal,
            spacing=spacing,
            reach=system.reach,
            garment=_no_garments(len(spacing), spacing.device) if level is None else level.vertex_garment,
            step=memory.step,
        )
        needs_mesh = any("." in name for name in self._network.config.vectors)
        return fused(past, carry.x, VertexFrame(level_of(level), carry.x) if needs_mesh else None)

    def _combined(self, system: System, carry: Carry) -> Tensor:
        """The network's combination of vectors [m]."""
        frame = cache(lambda: VertexFrame(level_of(system.level), carry.x))
        vector_of = partial(_vector, carry=carry, stiffness=system.rest_diagonal_columns)
        stacked = torch.stack(vectors_of(self._network.config.vectors, vector_of, frame=frame), dim=1)  # V N 3
        coefficients = self._network(stacked / system.spacing.reshape(-1, 1, 1), carry.memory.step)  # V N
        move = (coefficients.unsqueeze(2) * stacked).sum(dim=1)  # V 3
        return limited(move, system.spacing) * system.free


@dataclass(frozen=True, eq=False)
class _FusedHistory:
    """The past of a step, as `StepHistory`, with the secants as fields of one tensor."""

    force: Float[Tensor, "vertices 3"]
    images: tuple[Tensor, Tensor]
    secants: Secants
    step: int = 0

    def after(self, carry: Carry, secants: Secants) -> _FusedHistory:
        """The memory after a step from a carry with this memory."""
        return _FusedHistory(carry.force, (_of(carry.preconditioned), self.images[0]), secants, self.step + 1)


def _of(image: Tensor | None) -> Tensor:
    """H0^-1 F of a carry of this integrator [m]."""
    assert image is not None
    return image


def _spans(system: System) -> tuple[tuple[int, int], ...]:
    """Range of the vertices of each garment: start, and end (exclusive)."""
    if system.level is None:
        return ((0, len(system.spacing)),)
    return tuple((span.start, span.stop) for span in system.level.spans)


def _products_of(system: System) -> SecantProducts:
    """The launches for a system's garments."""
    threads = 1 if system.level is None else system.level.threads
    return secant_products(_spans(system), device=str(system.spacing.device), threads=threads)


@lru_cache(maxsize=4)
def _no_garments(count: int, device: torch.device) -> Tensor:
    """Garment numbers of a system without a level: zeros, int32, shape (V,)."""
    return torch.zeros(count, dtype=torch.int32, device=device)


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
    names: Sequence[str], vector_of: Callable[[str], Tensor], *, frame: Callable[[], VertexFrame]
) -> list[Tensor]:
    """The vectors of given names [m]; names with a dot are parts of whole vectors (`vertex_frame.PARTS`).

    Args:
        names: Names in `network.VECTORS`.
        vector_of: Gives a vector for a name without a dot.
        frame: Gives the surroundings of the vertices.
    """
    vectors: dict[str, Tensor] = {}
    for name in names:
        base, _, part = name.partition(".")
        if base not in vectors:
            vectors[base] = vector_of(base)
        if part:
            vectors[name] = frame().part(vectors[base], part)
    return [vectors[name] for name in names]


def garment_dot(level: Level | None, a: Tensor, b: Tensor) -> Tensor:
    """The scalar product of two fields in each garment, at each vertex of the garment; (1, 1) for a single garment."""
    if level is None or len(level.spans) == 1:
        return torch.dot(a.reshape(-1), b.reshape(-1)).reshape(1, 1)
    products, owner = (a * b).sum(dim=1, keepdim=True), level.vertex_garment.long()
    if len(level.spans) <= MOST_GARMENTS:  # In a fixed order.
        return torch.stack([products[span].sum(dim=0) for span in level.spans])[owner]
    return products.new_zeros(len(level.spans), 1).index_add_(0, owner, products)[owner]


def level_of(level: Level | None) -> Level:
    """The level of a system.

    Raises:
        SolveError: The system has no level.
    """
    if level is None:
        raise SolveError("this network needs a mesh, and the system has none")
    return level
