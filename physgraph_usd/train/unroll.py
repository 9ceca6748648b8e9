"""Many patches stepped as one, with gradients through forces and metric solves.

The network runs once for all patches of a batch; forces and metrics stay each patch's own, so patches of different
meshes, levels and fabrics mix freely and each one's energy is known.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..integrate.base import System

NUDGE = 1e-2
"""Displacement of the difference of forces behind a Hessian product, in local edge lengths."""


@dataclass(frozen=True, eq=False)
class JointMesh:
    """What integrators read of a level, for several meshes side by side; a `Surface`."""

    spans: tuple[slice, ...]
    rest: Tensor
    triangles: Tensor
    edges: Tensor
    rest_length: Tensor
    vertex_garment: Tensor
    lanes: int = 1


class JointField:
    """The forces of several systems."""

    def __init__(self, parts: Sequence[System], spans: Sequence[slice]) -> None:
        """Keep the parts."""
        self._parts, self._spans = parts, spans

    def each(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " patches"], Float[Tensor, "vertices 3"]]:
        """Energy of each part [J] and the force [N]."""
        pairs = [
            part.field.energy_and_force(x[span].contiguous())
            for part, span in zip(self._parts, self._spans, strict=True)
        ]
        return torch.stack([energy for energy, _ in pairs]), torch.cat([force for _, force in pairs])

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """Total energy [J] and force [N]."""
        energies, force = self.each(x)
        return energies.sum(), force

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's Hessian block [N/m]."""
        return torch.cat([p.field.diagonal(x[s].contiguous()) for p, s in zip(self._parts, self._spans, strict=True)])


class JointMetric:
    """The metrics of several systems."""

    def __init__(self, parts: Sequence[System], spans: Sequence[slice]) -> None:
        """Keep the parts."""
        self._parts, self._spans = parts, spans

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """Diagonals of all H0 [N/m]."""
        return torch.cat([part.metric.diagonal for part in self._parts])

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]."""
        return torch.cat([p.metric.solve(force[s].contiguous()) for p, s in zip(self._parts, self._spans, strict=True)])


class JointSystem(System):
    """Several systems as one that torch can differentiate.

    Attributes:
        owner: Patch of each vertex, shape (V,).
        energies: Energy of each patch [J] at each evaluation, in their order.
    """

    def __init__(self, parts: Sequence[System], *, through_forces: bool) -> None:
        """Join systems.

        Args:
            parts: The systems; each has a level.
            through_forces: Let gradients flow through forces into the positions they were evaluated at; else only
                through displacements (A19).
        """
        counts = [len(part.spacing) for part in parts]
        first = np.concatenate([[0], np.cumsum(counts)]).astype(int)
        spans = [slice(int(a), int(b)) for a, b in itertools.pairwise(first)]
        mesh = _join(parts, spans)
        super().__init__(
            JointField(parts, spans),
            JointMetric(parts, spans),
            free=torch.cat([part.free for part in parts]),
            spacing=torch.cat([part.spacing for part in parts]),
            level=mesh,
        )
        self.owner: Int[Tensor, " vertices"] = mesh.vertex_garment
        self.spans = spans
        self._through = through_forces
        self.energies: list[Tensor] = []

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[float, Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N], with gradients."""
        self.evaluations += 1
        energies, force = cast(tuple[Tensor, Tensor], _EnergyForce.apply(x, self))
        self.energies.append(energies)
        force = force if self._through else force.detach()
        return float(energies.detach().sum()), force * self.free

    def apply_metric_inverse(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m], with gradients."""
        return cast(Tensor, _MetricSolve.apply(force, self))

    @property
    def through(self) -> bool:
        """Whether gradients flow through forces."""
        return self._through


class _EnergyForce(torch.autograd.Function):
    """Energies and force; an energy's derivative is -F, the force's a difference of forces."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, system: JointSystem) -> tuple[Tensor, Tensor]:
        energies, force = cast(JointField, system.field).each(x)
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
        largest = torch.zeros(len(system.spans), dtype=size.dtype, device=size.device)
        largest = largest.scatter_reduce(0, system.owner, size, "amax").clamp_min(1e-30)[system.owner].unsqueeze(1)
        nudge = NUDGE / largest * by_force
        there, back = (cast(JointField, system.field).each(x + sign * nudge)[1] for sign in (1.0, -1.0))
        return gradient + (there - back) * (largest / (2.0 * NUDGE)), None


class _MetricSolve(torch.autograd.Function):
    """H0^-1 F; H0 is symmetric, so it is its own transpose."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, system: JointSystem) -> Tensor:
        ctx.system = system
        return System.apply_metric_inverse(system, force)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:  # type: ignore[override]
        return System.apply_metric_inverse(ctx.system, gradients[0].contiguous()), None


def _join(parts: Sequence[System], spans: Sequence[slice]) -> JointMesh:
    levels = [part.level for part in parts if part.level is not None]
    numbers = [torch.full((len(part.spacing),), k, device=part.spacing.device) for k, part in enumerate(parts)]
    return JointMesh(
        spans=tuple(spans),
        rest=torch.cat([level.rest for level in levels]),
        triangles=torch.cat([level.triangles + s.start for level, s in zip(levels, spans, strict=True)]),
        edges=torch.cat([level.edges + s.start for level, s in zip(levels, spans, strict=True)]),
        rest_length=torch.cat([level.rest_length for level in levels]),
        vertex_garment=torch.cat(numbers),
    )
