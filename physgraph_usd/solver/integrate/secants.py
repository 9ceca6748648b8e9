"""Secants of past steps, and the L-BFGS direction that they give (Nocedal 1980).

| symbol | here | meaning |
|---|---|---|
| s_i, y_i | ``move``, ``yields`` | differences of positions and of negative forces |
| z_i | ``image`` | H0^-1 y_i, a difference of preconditioned forces: no extra solve |
| rho_i | 1 / ``curvature`` | 1 / s_i.y_i |
| gamma | s.y / y.z of the newest secant | scales H0^-1 to the curvature last seen |

Scalar products are numbers for cloth that is one problem, or tensors: one for each garment, shown at its vertices, so
that garments do not mix, nobody waits for a number and gradients flow through.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

Dot = Callable[[Tensor, Tensor], Any]
"""The scalar product of two fields: a float, or a tensor of one number a garment, shown at each of its vertices."""


@dataclass(frozen=True, eq=False)
class Secant:
    """A difference of positions, of negative forces, of their images under H0^-1, and s.y.

    The curvature s.y is infinite where it is not safely positive: the secant then changes nothing.
    """

    move: Tensor
    yields: Tensor
    image: Tensor
    curvature: Any


def dot(a: Tensor, b: Tensor) -> float:
    """The scalar product of two fields as one number."""
    return float(torch.dot(a.reshape(-1), b.reshape(-1)))


def secant_of(move: Tensor, yields: Tensor, image: Tensor, *, dot: Dot = dot) -> Secant:
    """A secant with its curvature."""
    curvature = dot(move, yields)
    floor = 1e-8 * (dot(move, move) * dot(yields, yields)) ** 0.5
    size = dot(yields, image)
    if isinstance(curvature, Tensor):
        return Secant(move, yields, image, torch.where((curvature > floor) & (size > 0), curvature, math.inf))
    return Secant(move, yields, image, curvature if curvature > floor and size > 0 else math.inf)


def secant_direction(
    force: Float[Tensor, "vertices 3"],
    preconditioned: Float[Tensor, "vertices 3"],
    secants: Sequence[Secant],
    *,
    dot: Dot = dot,
) -> Float[Tensor, "vertices 3"]:
    """The L-BFGS direction [m].

    The two-loop recursion needs H0^-1 (F - sum alpha_i y_i) = H0^-1 F - sum alpha_i z_i, and so no solve.

    Args:
        force: F [N].
        preconditioned: H0^-1 F [m].
        secants: Oldest first.
        dot: The scalar product.
    """
    if not secants:
        return preconditioned
    weights, residual, image = [], force.clone(), preconditioned.clone()
    for secant in reversed(secants):
        weight = dot(secant.move, residual) / secant.curvature
        residual, image = _plus(residual, -weight, secant.yields), _plus(image, -weight, secant.image)
        weights.append(weight)
    image = _scaled(image, secants[-1], dot)
    for secant, weight in zip(secants, reversed(weights), strict=True):
        image = _plus(image, weight - dot(secant.yields, image) / secant.curvature, secant.move)
    return image


def _plus(field: Tensor, weight: Any, other: Tensor) -> Tensor:
    """A field and a multiple of another; in place for numbers."""
    return torch.addcmul(field, weight, other) if isinstance(weight, Tensor) else field.add_(other, alpha=weight)


def _scaled(image: Tensor, newest: Secant, dot: Dot) -> Tensor:
    """An image times gamma, which is 1 where the newest secant changes nothing."""
    size = dot(newest.yields, newest.image)
    if not isinstance(size, Tensor):
        return image.mul_(newest.curvature / size if newest.curvature < math.inf else 1.0)
    good = newest.curvature < math.inf
    return image * torch.where(good, torch.where(good, newest.curvature, 1.0) / torch.where(good, size, 1.0), 1.0)
