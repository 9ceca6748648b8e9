"""Rigid parts of garments: buttons, pullers and rivets, moving with the cloth below."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from scipy.spatial import cKDTree

from ..level import PIN_MARGIN, Level
from ..rigid import best_motion
from ..scene import Garment

LEAST = 12
"""Fewest cloth vertices followed by a part."""


class RigidParts:
    """The rigid parts of a level, each with the vertices of the cloth below."""

    def __init__(self, level: Level, garments: Sequence[Garment]) -> None:
        """Find the cloth around each part's centre, within the part's radius plus an edge."""
        self._parts: list[tuple[np.ndarray, np.ndarray]] = []
        rest, spacing = level.rest.double().cpu().numpy(), float(level.spacing.mean())
        cloth = (level.vertex_area > 0).cpu().numpy()
        for garment, span in zip(garments, level.spans, strict=True):
            under = np.flatnonzero(cloth[span]) + span.start
            if garment.rigid is None or not len(under):
                continue
            tree = cKDTree(rest[under])
            for members in parts_of(level, garment.rigid, span):
                if not (level.pin[members] < 1.0 - PIN_MARGIN).all():
                    continue  # Pinned parts stay on the cage.
                middle = rest[members].mean(axis=0)
                radius = float(np.linalg.norm(rest[members] - middle, axis=1).max())
                near = tree.query(middle, k=min(LEAST, len(under)))[1].reshape(-1)
                around = np.asarray(tree.query_ball_point(middle, radius + spacing), np.int64)
                self._parts.append((members, under[np.union1d(near, around).astype(np.int64)]))

    def place(
        self, out: Float[np.ndarray, "vertices 3"], from_coarse: sp.csr_matrix, coarse: Float[np.ndarray, "coarse 3"]
    ) -> None:
        """Move the parts from their positions on the upsampled cage to the cloth [m]; ``out`` is modified in place.

        Each part follows the best rigid motion of the cloth below, and then moves away from the cloth until no vertex
        below is nearer to the part than on the cage.
        """
        for members, under in self._parts:
            base, cage = from_coarse[under] @ coarse, from_coarse[members] @ coarse
            motion = best_motion(base, out[under])
            part, before, after = motion(cage), motion(base), out[under]
            away = _normal(before, part)
            out[members] = part + max(0.0, float(((after - before) @ away).max())) * away


def _normal(cloth: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Unit normal of the plane that fits cloth best, on the side of a part, shape (3,)."""
    normal = np.linalg.svd(cloth - cloth.mean(axis=0))[2][2]
    return normal if float((part.mean(axis=0) - cloth.mean(axis=0)) @ normal) >= 0.0 else -normal


def parts_of(level: Level, rigid: np.ndarray, span: slice) -> list[np.ndarray]:
    """Vertices of each rigid part at a level, given the parts' numbers at the garment's cage vertices."""
    numbers = np.zeros(level.from_coarse.shape[1])
    columns = np.unique(level.from_coarse[span].indices)
    numbers[columns.min() : columns.min() + len(rigid)] = rigid
    own = np.asarray(level.from_coarse[span] @ numbers).ravel().round().astype(np.int64)
    return [np.flatnonzero(own == number) + span.start for number in range(int(rigid.max()) + 1)]
