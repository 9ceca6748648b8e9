"""Patches stepped together: a system differentiable by torch, and the starts and least energies of each patch.

All patches of a batch are garments of one group, so forces, metric and network each run once for all of them, and each
patch's energy is known. A `Twin` unrolls the steps from a start that differs by noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...solver.forces.base import ForceModule
from ...solver.integrate.base import Carry, Integrator, Shortened, Solver, System
from .patches import Patch, group_of
from .rounds import Round, system_of

NOISE = 1e-3
"""Root mean square of what a twin's start differs by, in local edge lengths: well above float32's rounding."""
NUDGE = 1e-2
"""Displacement of the difference of forces behind a Hessian product, in local edge lengths."""


class JointSystem(System):
    """A system with gradients that knows the energy of each garment.

    Attributes:
        owner: Garment of each vertex, shape (V,).
        through: Whether gradients flow through forces.
        energies: Energy of each garment [J] at each evaluation, in their order.
    """

    def __init__(self, system: System, *, through_forces: bool) -> None:
        """Take over a system with a level.

        Args:
            through_forces: Let gradients flow through forces into the positions they were evaluated at; else only
                through displacements.
        """
        level = system.level
        assert level is not None
        super().__init__(system.field, system.metric, free=system.free, spacing=system.spacing, level=level)
        self.owner, self.garments = level.vertex_garment.long(), len(level.spans)
        self.through = through_forces
        self.energies: list[Tensor] = []

    def evaluated(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """Energy [J] without gradients, and force [N] with gradients."""
        self.evaluations += 1
        energies, force = cast(tuple[Tensor, Tensor], _EnergyForce.apply(x, self))
        self.energies.append(energies)
        force = force if self.through else force.detach()
        return energies.detach().sum(), force * self.free

    def apply_metric_inverse(
        self, force: Float[Tensor, "vertices 3"], solver: Solver | None = None
    ) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m], with gradients unless a different solver replaces H0^-1."""
        if solver is not None:
            return super().apply_metric_inverse(force, solver)
        return cast(Tensor, _MetricSolve.apply(force, self, False))

    def apply_short_inverse(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m], shorter where the metric has a shorter answer, with gradients."""
        return cast(Tensor, _MetricSolve.apply(force, self, True))


class _EnergyForce(torch.autograd.Function):
    """Energies and force; an energy's derivative is -F, the force's a difference of forces."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, system: JointSystem) -> tuple[Tensor, Tensor]:
        energies, force = cast(ForceModule, system.field).energy_and_force_each(x.contiguous(), system.garments)
        ctx.save_for_backward(x, force)
        ctx.system = system
        return energies, force

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:  # type: ignore[override]
        x, force = ctx.saved_tensors
        by_energy, by_force = gradients
        system: JointSystem = ctx.system
        gradient = -force * by_energy.to(force)[system.owner].unsqueeze(1)
        if not system.through:
            return gradient, None
        size = by_force.square().sum(dim=1).sqrt() / system.spacing
        largest = torch.zeros(system.garments, dtype=size.dtype, device=size.device)
        largest = largest.scatter_reduce(0, system.owner, size, "amax").clamp_min(1e-30)[system.owner].unsqueeze(1)
        nudge = NUDGE / largest * by_force
        ahead, back = (system.field.energy_and_force((x + sign * nudge).contiguous())[1] for sign in (1.0, -1.0))
        return gradient + (ahead - back) * (largest / (2.0 * NUDGE)), None


class _MetricSolve(torch.autograd.Function):
    """H0^-1 F [m], or the short solve's result; both operators are symmetric, and equal to their transposes."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, system: JointSystem, short: bool) -> Tensor:
        ctx.system, ctx.short = system, short
        return _solved(system, force, short=short)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return _solved(ctx.system, gradients[0].contiguous(), short=ctx.short), None, None


def _solved(system: JointSystem, force: Tensor, *, short: bool) -> Tensor:
    if short and isinstance(system.metric, Shortened):
        system.metric_solves += 1
        return system.metric.short(force) * system.free
    return System.apply_metric_inverse(system, force)


def unrolled(integrator: Integrator, system: System, carry: Carry, steps: int) -> Carry:
    """The carry after a number of steps."""
    for _ in range(steps):
        carry = integrator.step(system, carry)
    return carry


def detached(carry: Any) -> Any:
    """A copy of the carry, detached from the gradient graph."""
    if isinstance(carry, Tensor):
        return carry.detach()
    if isinstance(carry, tuple):
        return tuple(detached(item) for item in carry)
    if is_dataclass(carry) and not isinstance(carry, type):
        return replace(carry, **{f.name: detached(getattr(carry, f.name)) for f in fields(carry)})
    return carry


class Twin:
    """A second descent, whose start differs by noise from another's."""

    def __init__(self, integrator: Integrator, system: JointSystem, x: Float[Tensor, "vertices 3"]) -> None:
        """Start near x [m]."""
        self._integrator, self._system = integrator, system
        drawn = torch.randn(x.shape, dtype=x.dtype, device=x.device) / 3.0**0.5
        self._carry = integrator.start(system, x + NOISE * system.spacing.unsqueeze(1) * drawn * system.free)
        self._before = torch.ones(system.garments, dtype=x.dtype, device=x.device)

    def unroll(self, steps: int, *, other: Float[Tensor, "vertices 3"]) -> None:
        """Make a number of steps; ``other`` holds the first descent's positions before the same steps [m]."""
        self._carry = detached(self._carry)
        self._before = self._apart(other).detach()
        self._carry = unrolled(self._integrator, self._system, self._carry, steps)

    def growth(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " garments"]:
        """How many times as far as before those steps the two are apart in each garment, the other being at x [m]."""
        return self._apart(x) / self._before

    def _apart(self, x: Tensor) -> Float[Tensor, " garments"]:
        """Root mean square distance to x in each garment, in local edge lengths."""
        system = self._system
        square = (self._carry.x - x).square().sum(dim=1) / system.spacing.square()  # V
        total, count = (
            square.new_zeros(system.garments).index_add_(0, system.owner, values)
            for values in (square, torch.ones_like(square))
        )
        return (total / count + 1e-12).sqrt()


def _joined(positions: Sequence[Sequence[np.ndarray]], device: str) -> list[Tensor]:
    """Positions of each patch at each level [m] as one tensor a level."""
    return [torch.as_tensor(np.concatenate(arrays), device=device) for arrays in zip(*positions, strict=True)]


class Bundle:
    """Patches of equally many levels under the same gravity, on one device.

    Attributes:
        systems: A system per level, cage first.
        least: Least energy known of each patch at each level [J], shape (levels, patches), float64.
    """

    def __init__(self, patches: Sequence[Patch], *, device: str, through_forces: bool) -> None:
        """Build the group of patches that have the same number of levels and the same gravity."""
        garments = [patch.garment for patch in patches]
        group = group_of(garments, patches[0].gravity, patches[0].level, device=device)
        systems, _ = group.systems([patch.frame for patch in patches])
        self.systems = [JointSystem(system, through_forces=through_forces) for system in systems]
        self._from_below = [level.from_below for level in group.levels]
        self._solved = _joined([patch.solved for patch in patches], device)
        self._begin(_joined([patch.raw for patch in patches], device), [patch.least for patch in patches])

    def _begin(self, raw: list[Tensor], least: Sequence[Sequence[float]]) -> None:
        """Take the first starts [m], a tensor a level, and the least energies [J] of each patch at each level."""
        self._raw, self._ends = raw, [x.clone() for x in raw]
        self.least = torch.tensor(least, dtype=torch.float64, device=raw[0].device).T.contiguous()
        self._known = torch.zeros(self.least.shape, dtype=torch.bool, device=raw[0].device)

    def begin(self, index: int, dice: Callable[[], Float[Tensor, " patches"]], *, config: Any) -> Tensor:
        """A start of each patch at a level [m]: the upsampled cage, a solved level below, or an earlier end.

        Args:
            dice: Gives a number between 0 and 1 for each patch.
            config: A `TrainConfig`, for its ``raw``, ``middle`` and ``own``.
        """
        owner = self.systems[index].owner
        first, second = dice(), dice()
        x = self._raw[index]
        below = self._from_below[index]
        if below is not None:
            mine = (self._known[index - 1] & (second < config.own))[self.systems[index - 1].owner]
            lower = torch.where(mine.unsqueeze(1), self._ends[index - 1], self._solved[index - 1])
            x = torch.where((first >= config.raw)[owner].unsqueeze(1), below.apply(lower), x)
        again = (first > 1.0 - config.middle) & self._known[index]
        return torch.where(again[owner].unsqueeze(1), self._ends[index], x)

    def learn(self, index: int, energies: Float[Tensor, "steps patches"]) -> None:
        """Lower each patch's least known energy to the least of new energies [J]."""
        reached = torch.nan_to_num(energies.double(), nan=torch.inf).amin(dim=0)
        self.least[index] = torch.minimum(self.least[index], reached)

    def keep(self, index: int, x: Float[Tensor, "vertices 3"], better: Bool[Tensor, " patches"]) -> None:
        """Store the ends of patches that went downhill, as starts for later."""
        owner = self.systems[index].owner
        self._ends[index] = torch.where(better[owner].unsqueeze(1), x, self._ends[index])
        self._known[index] |= better

    def state(self) -> dict[str, Any]:
        """Values changed by training, for a checkpoint."""
        return {"kept": self._ends, "known": self._known, "least": self.least}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the values from `state`."""
        self._ends, self._known, self.least = state["kept"], state["known"], state["least"]


class RoundBundle(Bundle):
    """Rounds of equally many levels under the same gravity, on one device: one level, the finest."""

    def __init__(self, rounds: Sequence[Round], *, device: str, through_forces: bool) -> None:
        """Build the system of all rounds."""
        self.systems = [JointSystem(system_of(rounds, device=device), through_forces=through_forces)]
        self._from_below = [None]
        self._begin(_joined([[round_.x] for round_ in rounds], device), [[round_.least] for round_ in rounds])


Case = TypeVar("Case", Patch, Round)


def deal(cases: Sequence[Case], size: int) -> list[list[Case]]:
    """Group patches or rounds of equal level and gravity, in order, into batches of a largest size."""
    piles: dict[tuple[int, bool], list[Case]] = {}
    for case in cases:
        piles.setdefault((case.level, bool(case.gravity.any())), []).append(case)
    return [pile[k : k + size] for pile in piles.values() for k in range(0, len(pile), size)]
