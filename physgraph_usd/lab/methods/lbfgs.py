"""L-BFGS without a metric: its first guess of the inverse Hessian is that of the Hessian's diagonal."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from ...solver.integrate.base import Carry, System
from ...solver.integrate.quasi_newton import SECANTS, SHORTENED, Secant, backtrack, dot, secant_direction


@dataclass(frozen=True, eq=False)
class _Memory:
    """Inverse of the diagonal where the memory began [m/N], shape (V, 1), and secants since then, oldest first."""

    inverse: Tensor
    secants: tuple[Secant, ...] = ()


class Lbfgs:
    """L-BFGS on the diagonal, with a backtracking line search."""

    name = "lbfgs"

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x [m] with an empty memory."""
        return self._begun(system, x, *system.energy_and_force(x))

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate the carry's positions under forces that changed a little; the secants are kept."""
        energy, force = system.energy_and_force(carry.x)
        return Carry(carry.x, energy, force, mover=self.name, memory=carry.memory)

    def step(self, system: System, carry: Carry) -> Carry:
        """One step; the energy never rises by more than rounding. A step cut to a hundredth empties the memory."""
        memory: _Memory = carry.memory
        image = memory.inverse * carry.force
        direction = secant_direction(carry.force, image, memory.secants)
        slope = dot(carry.force, direction)
        if not slope > 0:
            direction, slope = image, dot(carry.force, image)
        found = backtrack(system, carry, direction, slope, by_force=True)
        if found is None:
            return self._forget(system, carry)
        x, energy, force = found
        move = x - carry.x
        if dot(move, move) < SHORTENED**2 * dot(direction, direction):
            return self._begun(system, x, energy, force)
        newest = Secant(move, carry.force - force, image - memory.inverse * force)
        if newest.curvature < math.inf:
            memory = replace(memory, secants=(*memory.secants, newest)[-SECANTS:])
        return Carry(x, energy, force, mover=self.name, memory=memory)

    def _begun(self, system: System, x: Tensor, energy: float, force: Tensor) -> Carry:
        memory = _Memory(1.0 / system.diagonal(x).unsqueeze(1))
        return Carry(x, energy, force, mover=self.name, memory=memory)

    def _forget(self, system: System, carry: Carry) -> Carry:
        """Drop the secants where none lowers the energy; without any, one step on the present diagonal, else stay."""
        begun = self._begun(system, carry.x, carry.energy, carry.force)
        if carry.memory.secants:
            return begun
        direction = begun.memory.inverse * carry.force
        move = backtrack(system, carry, direction, dot(carry.force, direction))
        return carry.moved_by("stayed") if move is None else self._begun(system, *move)
