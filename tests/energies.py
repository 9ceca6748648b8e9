"""Energies and forces of terms, and finite differences of energies."""

from collections.abc import Sequence

import torch
from torch import Tensor

from physgraph_usd.solver.forces.base import Force


def evaluate(force: Force, x: Tensor) -> tuple[float, Tensor]:
    out = torch.zeros_like(x)
    energy = force.add_force(x, out)
    return float(energy), out


def difference_force(force: Force, x: Tensor, step: float, *, vertices: Sequence[int] | None = None) -> Tensor:
    """Minus the energy's gradient by central differences of sixth order, zero at vertices not asked for."""
    out = torch.zeros_like(x)
    for v in range(len(x)) if vertices is None else vertices:
        for axis in range(3):
            for weight, shift in ((45, 1), (-9, 2), (1, 3)):
                for sign in (1, -1):
                    moved = x.clone()
                    moved[v, axis] += sign * shift * step
                    out[v, axis] -= sign * weight / (60 * step) * evaluate(force, moved)[0]
    return out


def apart(found: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest expected entry."""
    return float((found - expected).abs().max() / expected.abs().max().clamp_min(1e-300))
