"""Secants of past steps, and the resulting L-BFGS direction (Nocedal 1980).

| symbol | here | meaning |
|---|---|---|
| s_i, y_i | ``move``, ``yields`` | differences of positions and of negative forces |
| z_i | ``image`` | H0^-1 y_i, a difference of preconditioned forces: no extra solve |
| rho_i | 1 / ``curvature`` | 1 / s_i.y_i |
| gamma | s.y / y.z of the newest secant | scales H0^-1 to the latest curvature |

Scalar products are numbers for cloth solved as one problem, or tensors: one per garment, at each vertex of the garment.
Tensors keep garments independent, avoid waiting for a number, and let gradients flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .base import Carry

SECANTS = 5
"""Secants kept."""
Dot = Callable[[Tensor, Tensor], Any]
"""The scalar product of two fields: a float, or a tensor of one number per garment, at each vertex of the garment."""


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
class Memory:
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

    def after(self, carry: Carry, move: Tensor, force: Tensor, image: Tensor, *, dot: Dot) -> Memory:
        """The memory after a displacement [m] from a carry with this memory; force [N] and image [m] are at the end."""
        assert carry.preconditioned is not None
        newest = Secant(move, carry.force - force, carry.preconditioned - image, dot)
        images = (carry.preconditioned, self.images[0])
        return Memory(carry.force, images, (*self.secants, newest)[-SECANTS:], self.step + 1)


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


def _plus(field: Tensor, weight: Any, other: Tensor) -> Tensor:
    """A field plus a multiple of another; in place for numbers."""
    return torch.addcmul(field, weight, other) if isinstance(weight, Tensor) else field.add_(other, alpha=weight)


def _scaled(image: Tensor, newest: Secant) -> Tensor:
    """An image times gamma; gamma is 1 if the newest secant has no effect."""
    size, good = newest.dot(newest.yields, newest.image), newest.curvature < math.inf
    if not isinstance(size, Tensor):
        return image.mul_(newest.curvature / size if good else 1.0)
    return image * torch.where(good, torch.where(good, newest.curvature, 1.0) / torch.where(good, size, 1.0), 1.0)
