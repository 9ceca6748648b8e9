"""Secants of several garments at once, and their L-BFGS direction; gradients flow through.

As `quasi_newton` has them, but each garment by itself and without waiting for a number: whether a pair counts is in
its own 1 / s.y, which is 0 where it does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from .network import Graph
from .quasi_newton import Pair, pair_of, two_loop


@dataclass(frozen=True, eq=False)
class Secant:
    """A difference of positions, of negative forces, of their images under H0^-1, and 1 / s.y of each garment or 0."""

    move: Tensor
    yields: Tensor
    image: Tensor
    inverse: Tensor


def secant_direction(
    force: Float[Tensor, "vertices 3"],
    image: Float[Tensor, "vertices 3"],
    pairs: tuple[Secant, ...],
    *,
    graph: Graph,
) -> Float[Tensor, "vertices 3"]:
    """The L-BFGS direction [m], as in `quasi_newton`, for each garment by itself.

    Args:
        force: [N].
        image: H0^-1 F [m].
        pairs: Secants, oldest first.
        graph: Which vertex belongs to which garment.
    """
    if pairs and graph.garments == 1 and not (force.is_cuda or force.requires_grad) and float(pairs[-1].inverse) > 0:
        known = ((pair, float(pair.inverse)) for pair in pairs)
        good = tuple(Pair(pair.move, pair.yields, pair.image, 1.0 / each) for pair, each in known if each > 0)
        return two_loop(force, image, good)
    weights = []
    for pair in reversed(pairs):
        weight = pair.inverse * _dots(pair.move, force, graph)
        force = torch.addcmul(force, weight, pair.yields, value=-1.0)
        image = torch.addcmul(image, weight, pair.image, value=-1.0)
        weights.append(weight)
    if pairs:
        newest = pairs[-1]
        own = newest.inverse > 0
        size = _dots(newest.yields, newest.image, graph)
        image = image * torch.where(own, 1.0 / torch.where(own, newest.inverse * size, 1.0), 1.0)
    for pair, weight in zip(pairs, reversed(weights), strict=True):
        image = torch.addcmul(image, weight - pair.inverse * _dots(pair.yields, image, graph), pair.move)
    return image


def secant_of(move: Tensor, yields: Tensor, image: Tensor, *, graph: Graph) -> Secant:
    """A secant that counts where its curvature is safely positive."""
    if graph.garments == 1 and not (move.is_cuda or move.requires_grad):
        pair = pair_of(move, yields, image)
        return Secant(move, yields, image, move.new_full((1, 1), 0.0 if pair is None else 1.0 / pair.curvature))
    curvature = _dots(move, yields, graph)
    floor = 1e-8 * (_dots(move, move, graph) * _dots(yields, yields, graph)).sqrt()
    good = (curvature > floor) & (_dots(yields, image, graph) > 0)
    return Secant(move, yields, image, torch.where(good, 1.0 / torch.where(good, curvature, 1.0), 0.0))


def _dots(a: Tensor, b: Tensor, graph: Graph) -> Tensor:
    """Scalar products of each garment, at each of its vertices."""
    if graph.garments == 1:
        return torch.dot(a.reshape(-1), b.reshape(-1)).reshape(1, 1)
    return graph.total((a * b).sum(dim=1, keepdim=True))[graph.owner]
