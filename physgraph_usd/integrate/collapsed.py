"""What a descent does where triangles have collapsed: there cloth is much stiffer than at rest, and easily turned over.

The angle at an edge changes by the height of a triangle over it. Where an animation squeezes a triangle to a thousandth
of its area, bending is up to a million times as stiff as the metric says, and a move of a thousandth of an edge turns
the triangle over. A handful of such vertices would shorten every step of a whole garment to nothing. So

- the metric is held back at vertices that are stiffer than at rest (`stiffened`): R H0^-1 R, R^2 = min(1, c D0 / D);
- a step that fails is first cut back where it turns triangles, and nowhere else (`truncated`).

| symbol | here | meaning |
|---|---|---|
| H0 | ``system.metric`` | the metric of the rest shape |
| D0, D | ``rest_diagonal``, ``diagonal(x)`` | diagonals of the Hessian at rest and now [N/m] |
| c | `STIFFER` | how many times as stiff a vertex may be before it is held back |

Both know no force by name, so they serve every integrator.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .base import Layered, Preconditioner, System

STIFFER = 3.0
"""c. From 2 to 10 frames with collapsed triangles settle alike (benchmarks/cold_frames.py --stiffer)."""
TURN = math.cos(math.radians(45.0))
"""Cosine of the angle by which a triangle's normal may turn in a step that failed: two neighbours then change the angle
between them by a quarter turn at most, so that none is turned over."""
CUTS = 8
"""Most times that a vertex's move is halved; what is left of it then is under half a percent."""


class StiffenedMetric:
    """A metric held back where cloth is stiffer than at rest: R H0^-1 R.

    Attributes:
        scale: R, shape (V, 1).
    """

    def __init__(self, metric: Preconditioner, scale: Float[Tensor, "vertices 1"]) -> None:
        """Scale a metric from both sides, so that it stays symmetric and positive definite."""
        self._metric, self.scale = metric, scale
        self._smooth = metric.smooth if isinstance(metric, Layered) else metric.solve

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """Of H0 [N/m]."""
        return self._metric.diagonal

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """R H0^-1 R F [m]."""
        return self._metric.solve(force * self.scale) * self.scale

    def smooth(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """The same of a metric's smooth part [m]."""
        return self._smooth(force * self.scale) * self.scale


def stiffened(system: System, x: Float[Tensor, "vertices 3"]) -> System:
    """The same problem with its metric held back where cloth at x [m] is stiffer than at rest; itself where none is.

    A vertex is that much stiffer only beside a triangle that is lower than at rest by the root of `STIFFER`, so the
    diagonal, which costs two evaluations, is asked for only where one has lost that part of its area.
    """
    level = system.level
    if level is None or not len(level.triangles):
        return system
    smallest = (0.5 * level.normals(x).norm(dim=1) / level.triangle_area).min()
    if float(smallest) > STIFFER**-0.5:
        return system
    scale = (STIFFER * system.rest_diagonal / system.diagonal(x)).clamp_max(1.0).sqrt().unsqueeze(1)
    return system.with_metric(StiffenedMetric(system.metric, scale)) if bool((scale < 1.0).any()) else system


def truncated(
    system: System, x: Float[Tensor, "vertices 3"], move: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "vertices 3"] | None:
    """A move [m] cut back at the corners of triangles that it would turn by more than `TURN`; None without any.

    The corners of such triangles are halved until none is left. What is cut turns others, so they are looked at anew.

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
        cut = torch.zeros_like(part, dtype=torch.bool)
        cut[corners[turned].reshape(-1)] = True
        part = torch.where(cut, 0.5 * part, part)
    return part * move if bool((part < 1.0).any()) else None
