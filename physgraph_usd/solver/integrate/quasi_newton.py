"""Quasi-Newton: L-BFGS (`secants`) whose first guess of the inverse Hessian is the metric's.

A step costs one metric solve and, when the first trial is accepted, one force evaluation.

H0 is of the rest shape. A collapsed triangle is up to 10^5 times as stiff, so that H0^-1 F goes much too far there and
a line search shortens the steps of the whole garment to nothing. After such a step the metric is made as stiff as the
present state is (`Preconditioner.stiffened`), which shortens moves there and nowhere else; for as many steps as there
are secants, since a triangle that opens would stay as slow as it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from .base import Carry, Solver, System
from .secants import Secant, dot, secant_direction

ARMIJO = 1e-4
MAX_BACKTRACKS = 12
SHORTENED = 0.01
"""Fraction of its length to which a step is shortened from which on secants are dropped and the metric is stiffened."""
TURN = math.cos(math.radians(45.0))
"""Cosine of the angle by which a triangle may turn in a step that failed: the angle between two neighbours then
changes by a quarter turn at most, so that none is turned over."""
CUTS = 8
"""Most times that a vertex's move is halved; what is left of it then is under half a percent."""


def truncated(
    system: System, x: Float[Tensor, "vertices 3"], move: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "vertices 3"] | None:
    """A move [m] cut back at the corners of triangles that it would turn by more than `TURN`; None without any.

    The corners of such triangles are halved until none is left. What is cut turns others, so all are examined again.

    Args:
        system: The level.
        x: Where the move starts [m].
        move: Displacement [m].
    """
    level = system.level
    if level is None or not len(level.triangles):
        return None
    before, corners = level.normals(x), level.triangles.long()
    part = torch.ones_like(x[:, :1])
    for _ in range(CUTS):
        after = level.normals(x + part * move)
        turned = (before * after).sum(dim=1) < TURN * before.norm(dim=1) * after.norm(dim=1)
        if not bool(turned.any()):
            break
        part[torch.unique(corners[turned])] *= 0.5
    return part * move if bool((part < 1.0).any()) else None


class QuasiNewton:
    """L-BFGS on a metric or, for comparison, on the diagonal.

    Attributes:
        name: "quasi-newton" or "lbfgs".
    """

    def __init__(self, *, history: int = 5, use_metric: bool = True) -> None:
        """Choose the memory and the first guess.

        Args:
            history: Number of secants kept.
            use_metric: False scales by the Hessian's diagonal at the start instead of H0.
        """
        self.name = "quasi-newton" if use_metric else "lbfgs"
        self._history, self._use_metric = history, use_metric

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x with an empty memory."""
        energy, force = system.energy_and_force(x)
        inverse = None if self._use_metric else self._present(system, x)
        return self._begin(system, x, energy, force, inverse=inverse)

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate x anew under forces that changed a little; the secants are kept."""
        memory: _Memory = carry.memory
        energy, force = system.energy_and_force(carry.x)
        memory = replace(memory, image=self._image(system, memory.inverse, force))
        return self._carry(carry.x, energy, force, memory)

    def step(self, system: System, carry: Carry) -> Carry:
        """One secant step with a backtracking line search; the energy never rises by more than rounding.

        A step that had to be shortened much drops the secants: they misled it, and its own is mostly rounding. Where
        the next one has to be, too, the metric misled both, and the one after uses the present state's stiffness.
        """
        memory = self._softened(system, carry) if carry.memory.stiff >= self._history else carry.memory
        direction = secant_direction(carry.force, memory.image, memory.secants)
        slope = dot(carry.force, direction)
        if not slope > 0:
            direction, slope = memory.image, dot(carry.force, memory.image)
        found = backtrack(system, carry, direction, slope, by_force=True)
        if found is None:
            return self._forget(system, carry)
        x, energy, force = found
        move = x - carry.x
        if dot(move, move) < SHORTENED**2 * dot(direction, direction):
            again = memory.shortened and not memory.stiff
            inverse = self._present(system, x) if again or not self._use_metric else None
            begun = self._begin(system, x, energy, force, inverse=inverse)
            return replace(begun, memory=replace(begun.memory, shortened=True))
        image = self._image(system, memory.inverse, force)
        secants, newest = memory.secants, Secant(move, carry.force - force, memory.image - image)
        if newest.curvature < math.inf:
            secants = (*secants, newest)[-self._history :]
        return self._carry(x, energy, force, _Memory(secants, memory.inverse, image, memory.stiff + bool(memory.stiff)))

    def _begin(self, system: System, x: Tensor, energy: float, force: Tensor, *, inverse: Solver | None) -> Carry:
        stiff = int(inverse is not None and self._use_metric)
        return self._carry(x, energy, force, _Memory((), inverse, self._image(system, inverse, force), stiff))

    def _softened(self, system: System, carry: Carry) -> _Memory:
        """The memory of a carry with the metric at rest in place of one that was stiffened."""
        memory: _Memory = carry.memory
        secants = tuple(replace(each, image=system.apply_metric_inverse(each.yields)) for each in memory.secants)
        return _Memory(secants, None, system.apply_metric_inverse(carry.force))

    def _carry(self, x: Tensor, energy: float, force: Tensor, memory: _Memory) -> Carry:
        return Carry(x, energy, force, memory.image if self._use_metric else None, self.name, memory)

    def _present(self, system: System, x: Tensor) -> Solver:
        """A guess of the inverse Hessian by the present state's stiffness."""
        stiffness = system.diagonal(x)
        return system.metric.stiffened(stiffness) if self._use_metric else (1.0 / stiffness.unsqueeze(1)).mul

    def _image(self, system: System, inverse: Solver | None, force: Tensor) -> Tensor:
        return system.apply_metric_inverse(force, inverse) if inverse is None or self._use_metric else inverse(force)

    def _forget(self, system: System, carry: Carry) -> Carry:
        """No secant step lowers the energy: drop the secants; without any, try one step on the diagonal, then stay."""
        memory: _Memory = carry.memory
        if memory.secants:
            inverse = self._present(system, carry.x)
            return self._begin(system, carry.x, carry.energy, carry.force, inverse=inverse)
        direction = carry.force / system.diagonal(carry.x).unsqueeze(1)
        found = backtrack(system, carry, direction, dot(carry.force, direction))
        if found is None:
            return carry.moved_by("stayed")
        x, energy, force = found
        return self._begin(system, x, energy, force, inverse=self._present(system, x))


@dataclass(frozen=True, eq=False)
class _Memory:
    """The memory of the steps made.

    Attributes:
        secants: Secants, oldest first.
        inverse: First guess of the inverse Hessian; None for H0^-1.
        image: That of the present force.
        shortened: Whether it begins with a step that had to be shortened much.
        stiff: Number of the step since the metric was stiffened, from 1 on; 0 where it was not.
    """

    secants: tuple[Secant, ...]
    inverse: Solver | None
    image: Tensor
    stiff: int = 0
    shortened: bool = False


def backtrack(
    system: System, carry: Carry, direction: Float[Tensor, "vertices 3"], slope: float, *, by_force: bool = False
) -> tuple[Tensor, float, Tensor] | None:
    """Shorten a step until the energy falls enough (Armijo): first where it turns triangles, then everywhere.

    Everywhere by quadratic interpolation.

    Near rest the fall is lost in the energy's rounding, but not in the force's: there, by the force, a step is accepted
    that does not go past the least energy by farther than it started before it (Hager and Zhang 2005, the approximate
    Wolfe rule).

    Args:
        system: The system.
        carry: Where the step starts.
        direction: Displacement of the full step [m].
        slope: force . direction [J].
        by_force: Whether that rule is used too; the energy may then rise by its rounding.

    Returns:
        Positions, energy and force after the step, or None when no step lowers the energy.
    """
    if not slope > 0:
        return None
    length, level = 1.0, carry.energy + torch.finfo(carry.x.dtype).eps * abs(carry.energy)
    for trial in range(MAX_BACKTRACKS):
        x = carry.x + length * direction
        energy, force = system.energy_and_force(x)
        if energy <= carry.energy - ARMIJO * length * slope:
            return x, energy, force
        if by_force and energy <= level and dot(force, direction) >= (2.0 * ARMIJO - 1.0) * slope:
            return x, energy, force
        cut = truncated(system, carry.x, direction) if trial == 0 else None
        if cut is not None and (less := dot(carry.force, cut)) > 0:
            direction, slope = cut, less
            continue
        rise = energy - carry.energy + length * slope
        guess = 0.5 * length * slope * length / rise if rise > 0 else 0.5 * length
        length = min(max(guess, 0.1 * length), 0.5 * length)
    system.failed += MAX_BACKTRACKS
    return None
