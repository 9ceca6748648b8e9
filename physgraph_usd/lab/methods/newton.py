"""Truncated Newton: the reference that polishes Phi*. Meant for float64.

Solves H d = F by conjugate gradients preconditioned by the metric; H v is a difference of forces,
(F(x) - F(x + h v)) / h: the reference needs no more of the physics than the rest.
Negative curvature ends the inner loop (Nocedal and Wright, Numerical Optimization, algorithm 7.1).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ...solver.integrate.base import Carry, System
from ...solver.integrate.quasi_newton import backtrack


class Newton:
    """Line-search Newton-CG."""

    name = "newton"

    def __init__(self, *, inner_steps: int = 60) -> None:
        """Bound the inner conjugate-gradient loop."""
        self._inner_steps = inner_steps

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x."""
        energy, force = system.energy_and_force(x)
        return Carry(x, energy, force, system.apply_metric_inverse(force), self.name)

    def step(self, system: System, carry: Carry) -> Carry:
        """One Newton step with a backtracking line search; the energy never rises."""
        direction = self._direction(system, carry)
        move = backtrack(system, carry, direction, float((carry.force * direction).sum()))
        if move is None:
            return carry.moved_by("stayed")
        x, energy, force = move
        return Carry(x, energy, force, system.apply_metric_inverse(force), self.name)

    def _direction(self, system: System, carry: Carry) -> Tensor:
        residual = carry.force
        image = system.apply_metric_inverse(residual)
        search = image
        total = torch.zeros_like(residual)
        energy = float((residual * image).sum())
        target = energy * min(0.25, math.sqrt(energy) if energy < 1 else 0.25)
        for _ in range(self._inner_steps):
            product = _hessian_product(system, carry, search)
            curvature = float((search * product).sum())
            if not curvature > 0:
                return total if bool(total.any()) else search
            length = energy / curvature
            total = total + length * search
            residual = residual - length * product
            image = system.apply_metric_inverse(residual)
            following = float((residual * image).sum())
            if following <= target * 0.01:
                break
            search = image + (following / energy) * search
            energy = following
        return total


def _hessian_product(system: System, carry: Carry, v: Tensor) -> Tensor:
    """H v by a forward difference of the force; the step is a thousandth of a permille of an edge."""
    largest = float((v.square().sum(dim=1).sqrt() / system.spacing).max())
    if largest == 0:
        return torch.zeros_like(v)
    h = (1e-6 if v.dtype == torch.float64 else 1e-3) / largest
    return (carry.force - system.energy_and_force(carry.x + h * v)[1]) / h
