"""Gradient descent and Adam: the paper's own baselines, kept on the chart as such."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...solver.integrate.base import Carry, System


class GradientDescent:
    """x + rate F / max(diagonal): a fixed step in units of the stiffest vertex's response."""

    name = "gd"

    def __init__(self, rate: float = 0.5) -> None:
        """Keep the dimensionless rate; above 2/3 stiff springs overshoot."""
        self._rate = rate

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x and measure the stiffest vertex."""
        energy, force = system.energy_and_force(x)
        stiffest = float(system.diagonal(x).max()) if len(x) else 1.0
        return Carry(x, energy, force, mover=self.name, memory=self._rate / stiffest)

    def step(self, system: System, carry: Carry) -> Carry:
        """A step of fixed length."""
        x = carry.x + carry.memory * carry.force
        energy, force = system.energy_and_force(x)
        return Carry(x, energy, force, mover=self.name, memory=carry.memory)


@dataclass(frozen=True, eq=False)
class _Moments:
    first: Tensor
    second: Tensor
    count: int


class Adam:
    """Adam (Kingma and Ba 2015) on positions, its rate in local edge lengths."""

    name = "adam"

    def __init__(self, rate: float = 1e-2, *, decay: float = 0.9, decay_second: float = 0.999) -> None:
        """Keep the dimensionless rate and the decays of the moments."""
        self._rate, self._decay, self._decay_second = rate, decay, decay_second

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x with empty moments."""
        energy, force = system.energy_and_force(x)
        moments = _Moments(torch.zeros_like(x), torch.zeros_like(x), 0)
        return Carry(x, energy, force, mover=self.name, memory=moments)

    def step(self, system: System, carry: Carry) -> Carry:
        """An Adam update."""
        m: _Moments = carry.memory
        count = m.count + 1
        first = torch.lerp(carry.force, m.first, self._decay)
        second = torch.lerp(carry.force.square(), m.second, self._decay_second)
        root = (second / (1.0 - self._decay_second**count)).sqrt()
        direction = first / (1.0 - self._decay**count) / root.clamp_min(torch.finfo(root.dtype).tiny ** 0.5)
        x = carry.x + self._rate * system.spacing.unsqueeze(1) * direction * system.free
        energy, force = system.energy_and_force(x)
        return Carry(x, energy, force, mover=self.name, memory=_Moments(first, second, count))
