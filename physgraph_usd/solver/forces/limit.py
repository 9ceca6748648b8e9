"""Limits: how far cloth may be from its smoothly subdivided cage, in any direction and inwards.

    |x_v - s_v| <= r_v,    n_v . (s_v - x_v) <= b_v

| symbol | here | meaning |
|---|---|---|
| s_v | ``centre`` | the vertex on the smoothly subdivided cage [m] |
| n_v | ``normal`` | the cage's outward unit normal there; 0 without faces of some area, then without a backstop |
| r_v | ``radius`` | max distance, infinite for no limit [m] |
| b_v | ``backstop`` | backstop, infinite for no limit [m] |

Both sets are convex and contain s_v, so any position between a permitted position and s_v is permitted.

Springs begin at a fraction f of each limit l, and their stiffness grows with the distance u beyond:

    E = sum_v k_v / 3 w_v max(u_v, 0)^3,    w_v = (1 - f) l_v
    u_v = |x_v - s_v| - f l_v    or    u_v = n_v . (s_v - x_v) - f l_v

The springs of the max distance are soft: cloth that is held firmly within a small distance takes up its surplus length
in sharp ripples. What they leave is scaled down evenly at the end of a frame (`Limit.scaled`), so folds get shallower
and no sharper. The springs of the backstop act like contact, and what they leave is moved out to it (`in_front`).
"""

from __future__ import annotations

import copy

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.stencil import three_columns

SOFT = 0.5
"""Fraction f of a limit at which the springs begin."""
FIRMNESS = {"distance": 0.001, "backstop": 0.1}
"""k_v of each kind of limit, as a fraction of the stiffness of stretch at rest. Of the skirt's edges 10% are folded by
over 20 degrees without a limit, and at 3 mm 0.8, 1.8, 5.9, 10, 12 and 16% with 0, 0.0003, 0.001, 0.002, 0.003, 0.01."""
NARROWEST = 0.02
"""Least width w, relative to the local edge length."""
TOLERATED = 1e-3
"""Excess over a limit that is not corrected, relative to the level's mean edge length."""
MOST_TOLERATED = 1e-5
"""Largest excess that is not corrected [m]."""


class Limit:
    """Limits of a level's cloth in a frame, with springs in front."""

    name = "limit"

    def __init__(
        self,
        level: Level,
        stiffness: Float[Tensor, " vertices"],
        *,
        centre: Float[Tensor, "vertices 3"],
        normal: Float[Tensor, "vertices 3"],
        radius: Float[Tensor, " vertices"] | None,
        backstop: Float[Tensor, " vertices"] | None,
    ) -> None:
        """Take the limits; None for cloth without limits of a kind.

        Args:
            stiffness: Diagonal of the Hessian of stretch at rest [N/m].
            centre: s [m].
            normal: n.
            radius: r [m].
            backstop: b [m].
        """
        self._level, self._tolerated = level, min(TOLERATED * float(level.spacing.mean()), MOST_TOLERATED)
        self._centre, self._normal, self._radius, self._backstop = centre, normal, radius, backstop
        narrowest, kinds = NARROWEST * level.spacing, list[Tensor]()
        for limit, part in zip((radius, backstop), FIRMNESS.values(), strict=True):
            if limit is not None:
                kinds += [SOFT * limit, part * stiffness / torch.maximum((1.0 - SOFT) * limit, narrowest)]
        self._springs = tuple(kinds)  # f l [m] and k / w [N/m^2] of each kind of limit.

    @property
    def aims(self) -> tuple[Tensor, ...]:
        """All that changes from frame to frame."""
        return self._centre, *((self._normal,) if self._backstop is not None else ()), *self._springs

    def aimed(self, *aims: Tensor) -> Limit:
        """The springs with other `aims`."""
        limit = copy.copy(self)
        limit._centre, *others = aims
        if self._backstop is not None:
            limit._normal, *others = others
        limit._springs = tuple(others)
        return limit

    def _lags(self, away: Float[Tensor, "vertices 3"]) -> list[tuple[Tensor, Tensor, Tensor]]:
        """For each kind of limit: distance [m], shape (V,), a vector along its gradient, and that vector's length."""
        lags = list[tuple[Tensor, Tensor, Tensor]]()
        if self._radius is not None:
            far = torch.linalg.vector_norm(away, dim=1)
            lags.append((far, away, far.clamp_min(torch.finfo(away.dtype).tiny)))
        if self._backstop is not None:
            deep = -torch.linalg.vecdot(away, self._normal)
            lags.append((deep, self._normal, torch.full_like(deep, -1.0)))
        return lags

    def _pushes(self, away: Float[Tensor, "vertices 3"]) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """For each kind of limit: u and k / w, and vector and length of `_lags`."""
        springs = zip(self._lags(away), self._springs[::2], self._springs[1::2], strict=True)
        return [((far - begin).clamp_min(0.0), rate, along, length) for (far, along, length), begin, rate in springs]

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        energy = x.new_zeros((), dtype=torch.float64)
        for beyond, rate, along, length in self._pushes(x - self._centre):
            push = rate * beyond * beyond
            force.addcmul_(three_columns(push / length), along, value=-1.0)
            energy = energy + torch.dot(push, beyond).double() / 3.0
        return energy

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each spring [J] at positions x [m], and the garment of its vertex."""
        pushes = self._pushes(x - self._centre)
        energies = [rate * beyond**3 / 3.0 for beyond, rate, _, _ in pushes]
        return torch.cat(energies), self._level.vertex_garment.repeat(len(pushes))

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """2/3 k u / w of each spring, without the turn of its direction [N/m]."""
        pushes = self._pushes(x - self._centre)
        return torch.stack([2.0 / 3.0 * rate * beyond for beyond, rate, _, _ in pushes]).sum(dim=0)

    def rest_springs(self) -> tuple[float, float]:
        """None: cloth at rest is at its centre."""
        return 0.0, 0.0

    def excess(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """Distance beyond the limits [m]; 0 at vertices that the solve does not move."""
        over = torch.zeros_like(x[:, 0])
        for (far, _, _), limit in zip(self._lags(x - self._centre), self._kinds, strict=True):
            over = torch.maximum(over, far - limit)
        return torch.where(self._level.free[:, 0], over, 0.0)

    def in_front(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions moved out to the backstop [m], x itself if none is behind."""
        if self._backstop is None:
            return x
        deep = -((x - self._centre) * self._normal).sum(dim=1) - self._backstop
        deep = torch.where(self._level.free[:, 0], deep.clamp_min(0.0), 0.0)
        return x + deep.unsqueeze(1) * self._normal if bool((deep > self._tolerated).any()) else x

    def scaled(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with the distance to the centre scaled down evenly around vertices too far [m], or x itself.

        The scale at a vertex of the cage is the least one needed by the vertices that depend on it, and is linear
        between: folds become shallower, and no sharper.
        """
        if self._radius is None:
            return x
        away, free, matrix = x - self._centre, self._level.free[:, 0], sp.csc_matrix(self._level.from_coarse)
        far = away.square().sum(dim=1).sqrt()
        if not bool((free & (far > self._radius + self._tolerated)).any()):
            return x
        needed = torch.where(free & (far > self._radius), self._radius / far, 1.0).double().cpu().numpy()
        least = np.minimum.reduceat(needed[matrix.indices], matrix.indptr[:-1])
        scale = torch.as_tensor(self._level.from_coarse @ least).to(x).unsqueeze(1)
        return torch.where(free.unsqueeze(1) & (scale < 1.0), self._centre + scale * away, x)

    def held(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions moved into the limits [m], x itself if none is beyond."""
        if not bool((self.excess(x) > self._tolerated).any()):
            return x
        away = x - self._centre
        if self._backstop is not None:
            deep = -(away * self._normal).sum(dim=1) - self._backstop
            away = away + deep.clamp_min(0.0).unsqueeze(1) * self._normal
        if self._radius is not None:
            far = away.square().sum(dim=1).sqrt().clamp_min(torch.finfo(x.dtype).tiny)
            away = away * (self._radius / far).clamp_max(1.0).unsqueeze(1)
        beyond = (self.excess(x) > 0.0).unsqueeze(1)
        return torch.where(beyond, self._centre + away, x)

    @property
    def _kinds(self) -> list[Tensor]:
        """The limits of each kind [m]."""
        return [limit for limit in (self._radius, self._backstop) if limit is not None]
