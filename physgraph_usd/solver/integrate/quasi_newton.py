"""Quasi-Newton: L-BFGS (Nocedal 1980) with the metric's inverse as first guess of the inverse Hessian.

A step costs one metric solve and, if the first trial is accepted, one force evaluation.

H0 describes the rest shape. A collapsed triangle is up to 10^5 times as stiff, so H0^-1 F goes much too far there and a
line search shortens the steps of the whole garment to nothing. After such a step the metric is stiffened to the present
state (`Preconditioner.stiffened`), which shortens moves at collapsed triangles only. Stiffening lasts for as many steps
as there are secants, because an opening triangle would otherwise remain slow.

| symbol | here | meaning |
|---|---|---|
| s_i, y_i | ``move``, ``yields`` | differences of positions and of negative forces |
| z_i | ``image`` | H0^-1 y_i, a difference of preconditioned forces: no extra solve |
| rho_i | 1 / ``curvature`` | 1 / s_i.y_i |
| gamma | s.y / y.z of the newest secant | scales H0^-1 to the latest curvature |

Scalar products are numbers, of all cloth, or tensors: one per garment, at each vertex of the garment. Tensors let
gradients flow. `secants` has the same direction by coefficients, for steps without gradients.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .base import Carry, Solver, System

ARMIJO = 1e-4
MAX_BACKTRACKS = 12
SHORTENED = 0.01
"""Fraction of the full length below which a shortened step drops the secants and stiffens the metric."""
TURN_COSINE = math.cos(math.radians(45.0))
"""Cosine of the largest turn of a triangle after a failed step: the angle between two neighbours then changes by at
most a quarter turn, and no triangle is turned over."""
CUTS = 8
"""Most halvings of a vertex's move, down to under half a percent."""
SECANTS = 5
"""Secants kept."""
Dot = Callable[[Tensor, Tensor], Any]
"""The scalar product of two fields: a float, or a tensor of one number per garment, at each vertex of the garment."""


def truncated(
    system: System, x: Float[Tensor, "vertices 3"], move: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "vertices 3"] | None:
    """A move [m] shortened at the corners of triangles turning by more than `TURN_COSINE`; None if no triangle does.

    The moves of the corners are halved until no triangle turns too far. Shortening affects neighbouring triangles, so
    all triangles are examined again.

    Args:
        x: Start of the move [m].
        move: Displacement [m].
    """
    level = system.level
    if level is None or not len(level.triangles):
        return None
    before, corners = level.normals(x), level.triangles.long()
    part = torch.ones_like(x[:, :1])
    for _ in range(CUTS):
        after = level.normals(x + part * move)
        turned = (before * after).sum(dim=1) < TURN_COSINE * before.norm(dim=1) * after.norm(dim=1)
        if not bool(turned.any()):
            break
        part[torch.unique(corners[turned])] *= 0.5
    return part * move if bool((part < 1.0).any()) else None


class QuasiNewton:
    """L-BFGS on a metric."""

    name = "quasi-newton"

    def __init__(self, *, history: int = SECANTS) -> None:
        """Choose the memory: the number of secants kept."""
        self._history = history

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x with an empty memory."""
        energy, force = system.energy_and_force(x)
        return self._begin(system, x, energy, force, inverse=None)

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate x again after a small change of the forces; the secants are kept."""
        memory: _Memory = carry.memory
        energy, force = system.energy_and_force(carry.x)
        memory = replace(memory, image=system.apply_metric_inverse(force, memory.inverse))
        return self._carry(carry.x, energy, force, memory)

    def step(self, system: System, carry: Carry) -> Carry:
        """One secant step with a backtracking line search; the energy never rises by more than rounding.

        A strongly shortened step drops the secants, which were misleading, and gives no secant itself, being mostly
        rounding. If the next step is also strongly shortened, the metric misled both, and the following step uses the
        present state's stiffness.
        """
        memory = self._softened(system, carry) if carry.memory.stiff >= self._history else carry.memory
        direction = secant_direction(carry.force, memory.image, memory.secants)
        slope = dot(carry.force, direction)
        if not slope > 0:
            direction, slope = memory.image, dot(carry.force, memory.image)
        reached = backtrack(system, carry, direction, slope, by_force=True)
        if reached is None:
            return self._forget(system, carry)
        x, energy, force = reached
        move = x - carry.x
        if dot(move, move) < SHORTENED**2 * dot(direction, direction):
            again = memory.shortened and not memory.stiff
            inverse = self._present(system, x) if again else None
            restarted = self._begin(system, x, energy, force, inverse=inverse)
            return replace(restarted, memory=replace(restarted.memory, shortened=True))
        image = system.apply_metric_inverse(force, memory.inverse)
        secants, newest = memory.secants, Secant(move, carry.force - force, memory.image - image)
        if newest.curvature < math.inf:
            secants = (*secants, newest)[-self._history :]
        return self._carry(x, energy, force, _Memory(secants, memory.inverse, image, memory.stiff + bool(memory.stiff)))

    def _begin(self, system: System, x: Tensor, energy: float, force: Tensor, *, inverse: Solver | None) -> Carry:
        image = system.apply_metric_inverse(force, inverse)
        return self._carry(x, energy, force, _Memory((), inverse, image, int(inverse is not None)))

    def _softened(self, system: System, carry: Carry) -> _Memory:
        """The memory of a carry, with the stiffened metric replaced by the rest metric."""
        memory: _Memory = carry.memory
        secants = tuple(replace(secant, image=system.apply_metric_inverse(secant.yields)) for secant in memory.secants)
        return _Memory(secants, None, system.apply_metric_inverse(carry.force))

    def _carry(self, x: Tensor, energy: float, force: Tensor, memory: _Memory) -> Carry:
        return Carry(x, energy, force, memory.image, self.name, memory)

    def _present(self, system: System, x: Tensor) -> Solver:
        """A guess of the inverse Hessian from the present state's stiffness."""
        return system.metric.stiffened(system.diagonal(x))

    def _forget(self, system: System, carry: Carry) -> Carry:
        """After a failed secant step, drop the secants; without secants, try one step on the diagonal, then stay."""
        memory: _Memory = carry.memory
        if memory.secants:
            inverse = self._present(system, carry.x)
            return self._begin(system, carry.x, carry.energy, carry.force, inverse=inverse)
        direction = carry.force / system.diagonal(carry.x).unsqueeze(1)
        reached = backtrack(system, carry, direction, dot(carry.force, direction))
        if reached is None:
            return carry.moved_by("stayed")
        x, energy, force = reached
        return self._begin(system, x, energy, force, inverse=self._present(system, x))


@dataclass(frozen=True, eq=False)
class _Memory:
    """The memory of previous steps.

    Attributes:
        secants: Secants, oldest first.
        inverse: First guess of the inverse Hessian; None for H0^-1.
        image: The guess applied to the present force.
        shortened: Whether the memory begins with a strongly shortened step.
        stiff: Number of steps since the metric was stiffened, from 1 on; 0 if not stiffened.
    """

    secants: tuple[Secant, ...]
    inverse: Solver | None
    image: Tensor
    stiff: int = 0
    shortened: bool = False


def _is_enough(
    before: Carry, energy: float, slope: float, end: Callable[[], float] | None, *, length: float = 1.0
) -> bool:
    """Whether a step lowers the energy enough.

    Args:
        before: Start of the step.
        energy: Energy at the end [J].
        slope: force . direction at the start [J].
        end: force . direction at the end, to accept a step by the force; or None.
        length: Length of the step relative to the direction.
    """
    if energy <= before.energy - ARMIJO * length * slope:
        return True
    rounding = torch.finfo(before.x.dtype).eps * abs(before.energy)
    return end is not None and energy <= before.energy + rounding and end() >= (2.0 * ARMIJO - 1.0) * slope


def backtrack(
    system: System, carry: Carry, direction: Float[Tensor, "vertices 3"], slope: float, *, by_force: bool = False
) -> tuple[Tensor, float, Tensor] | None:
    """Shorten a step until the energy falls enough (Armijo): first at turned triangles, then everywhere.

    Shortening everywhere uses quadratic interpolation.

    Near rest the decrease is lost in the energy's rounding, but not in the force's. There a step is accepted by the
    force if it overshoots the minimum by no more than the distance covered before (Hager and Zhang 2005, the
    approximate Wolfe rule).

    Args:
        carry: Start of the step.
        direction: Displacement of the full step [m].
        slope: force . direction [J].
        by_force: Whether to use the approximate Wolfe rule too; the energy may then rise by rounding.

    Returns:
        Positions, energy and force after the step, or None if no step lowers the energy.
    """
    if not slope > 0:
        return None
    length = 1.0
    for trial in range(MAX_BACKTRACKS):
        x = carry.x + length * direction
        energy, force = system.energy_and_force(x)
        end = partial(dot, force, direction) if by_force else None
        if _is_enough(carry, energy, slope, end, length=length):
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


def dot(a: Tensor, b: Tensor) -> float:
    """The scalar product of two fields as a number."""
    return float(torch.dot(a.reshape(-1), b.reshape(-1)))


@dataclass(frozen=True, eq=False)
class Secant:
    """Differences of positions, of negative forces, of their images under H0^-1, and the scalar product to use."""

    move: Tensor
    yields: Tensor
    image: Tensor
    dot: Dot = dot

    @cached_property
    def curvature(self) -> Any:
        """s.y, infinite if not safely positive: the secant then has no effect."""
        dot = self.dot
        curvature, size = dot(self.move, self.yields), dot(self.yields, self.image)
        floor = 1e-8 * (dot(self.move, self.move) * dot(self.yields, self.yields)) ** 0.5
        if isinstance(curvature, Tensor):
            return torch.where((curvature > floor) & (size > 0), curvature, math.inf)
        return curvature if curvature > floor and size > 0 else math.inf


@dataclass(frozen=True, eq=False)
class StepHistory:
    """The past of a step.

    Attributes:
        force: Force one step ago [N].
        images: H0^-1 F one and two steps ago [m].
        secants: The last `SECANTS`, oldest first.
        step: Number of steps made.
    """

    force: Tensor
    images: tuple[Tensor, Tensor]
    secants: tuple[Secant, ...] = ()
    step: int = 0

    def after(self, carry: Carry, newest: Secant) -> StepHistory:
        """The memory after a step from a carry with this memory."""
        assert carry.preconditioned is not None
        images = (carry.preconditioned, self.images[0])
        return StepHistory(carry.force, images, (*self.secants, newest)[-SECANTS:], self.step + 1)


def secant_direction(
    force: Float[Tensor, "vertices 3"], preconditioned: Float[Tensor, "vertices 3"], secants: Sequence[Secant]
) -> Float[Tensor, "vertices 3"]:
    """The L-BFGS direction [m].

    The two-loop recursion needs H0^-1 (F - sum alpha_i y_i) = H0^-1 F - sum alpha_i z_i, and thus no solve.

    Args:
        force: F [N].
        preconditioned: H0^-1 F [m].
        secants: Oldest first.
    """
    if not secants:
        return preconditioned
    weights, residual, image = [], force.clone(), preconditioned.clone()
    for secant in reversed(secants):
        weight = secant.dot(secant.move, residual) / secant.curvature
        residual, image = _plus(residual, -weight, secant.yields), _plus(image, -weight, secant.image)
        weights.append(weight)
    image = _scaled(image, secants[-1])
    for secant, weight in zip(secants, reversed(weights), strict=True):
        image = _plus(image, weight - secant.dot(secant.yields, image) / secant.curvature, secant.move)
    return image


def _plus(field: Tensor, weight: Any, step: Tensor) -> Tensor:
    """A field plus a multiple of another; in place for numbers."""
    return torch.addcmul(field, weight, step) if isinstance(weight, Tensor) else field.add_(step, alpha=weight)


def _scaled(image: Tensor, newest: Secant) -> Tensor:
    """An image times gamma; gamma is 1 if the newest secant has no effect."""
    size, good = newest.dot(newest.yields, newest.image), newest.curvature < math.inf
    if not isinstance(size, Tensor):
        return image.mul_(newest.curvature / size if good else 1.0)
    return image * torch.where(good, torch.where(good, newest.curvature, 1.0) / torch.where(good, size, 1.0), 1.0)
