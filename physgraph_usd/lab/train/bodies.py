"""Something for patches to rest on: a wavy body close to the cloth, seen as a plane at each vertex.

The solver's rounds show an integrator the same: planes that stay, about parallel to the cloth, some of them pushing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...solver.contact.settings import ContactSettings
from ...solver.forces.base import ForceModule
from ...solver.forces.contact import Contact, Planes
from ...solver.integrate.base import System
from ...solver.integrate.metric import Metric
from ...solver.integrate.vertex_frame import VertexFrame
from ...solver.level import Level

HEIGHT = (-2.0, -0.9)
"""Powers of ten between which the waves' heights lie, in cage edges: a body comes through its cloth by so much."""
WAVES = (0.5, 3.0)
"""Waves along a patch."""


@dataclass(frozen=True, eq=False)
class Body:
    """A body beside one patch.

    Attributes:
        side: 1 where it lies behind the cloth's normals, -1 before them.
        wave: Wave vector [1/m], shape (3,).
        phase: [rad].
        height: How far it comes through the upsampled cage at most [m]; at least it stays as far away.
        stiffness: k_c [N/m^3].
    """

    side: float
    wave: np.ndarray
    phase: float
    height: float
    stiffness: float

    @staticmethod
    def random(rng: np.random.Generator, *, size: float, edge: float, stretch: float) -> Body:
        """A body for a patch of so large a size [m], with cage edges [m] and a stretch stiffness [N/m]."""
        direction = rng.normal(size=3)
        wave = 2.0 * np.pi * rng.uniform(*WAVES) / size * direction / np.linalg.norm(direction)
        stiffness = ContactSettings().stiffness * stretch / edge**2
        height = edge * 10.0 ** rng.uniform(*HEIGHT)
        return Body(float(rng.choice([-1.0, 1.0])), wave, float(rng.uniform(0.0, 2.0 * np.pi)), height, stiffness)

    def contact(self, level: Level, base: Float[Tensor, "vertices 3"], *, span: slice) -> Contact:
        """The force on the patch at a level.

        Args:
            level: The level.
            base: The upsampled cage [m].
            span: The patch's vertices.
        """
        normal = self.side * VertexFrame(level, base).normal[span]
        own = base[span]
        lift = self.height * torch.sin(own @ torch.as_tensor(self.wave).to(own) + self.phase)
        vertex = torch.arange(span.start, span.stop, dtype=torch.int32, device=base.device)
        planes = Planes(vertex, normal.contiguous(), (normal * own).sum(dim=1) + lift)
        return Contact(level, [planes], self.stiffness)


def with_bodies(
    systems: Sequence[System], levels: Sequence[Level], coarse: Float[Tensor, "coarse 3"], bodies: Sequence[Body | None]
) -> list[System]:
    """The same systems with what each patch rests on in their forces, and its stiffness in their metrics.

    Args:
        systems: One a level, without contact.
        levels: The levels.
        coarse: The cages [m].
        bodies: One a patch, or None.
    """
    if not any(bodies):
        return list(systems)
    out = []
    for system, level in zip(systems, levels, strict=True):
        base = level.base.apply(coarse)
        terms = [body.contact(level, base, span=span) for body, span in zip(bodies, level.spans, strict=True) if body]
        assert isinstance(system.field, ForceModule)
        assert isinstance(system.metric, Metric)
        stiff = 3.0 * torch.stack([term.diagonal(base) for term in terms]).sum(dim=0)
        field = ForceModule((*system.field.forces, *terms))
        out.append(System(field, system.metric.plus(stiff), free=level.free, spacing=level.spacing, level=level))
    return out
