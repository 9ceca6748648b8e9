"""S24, S26: cloth that starts crossed or stacked, beyond the rows of the table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from brute import between
from cloth import Answer, base_of
from folds import EDGE, Cloth, frame_with, named, refiner_with, sewn, square
from scenes import sleeve
from sheets import garment_of
from test_tangles import cornered, dented

from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.mesh.topology import PolygonMesh

THICK = 1e-3
"""Thickness of the fabric [m]."""
WEIGHTLESS = np.zeros(3)


def faces_of(cloth: Cloth, level: int = 1) -> np.ndarray:
    """Triangles of the fine cloth."""
    chain = refine_garments([garment_of(*cloth)], [level])[0]
    mesh: PolygonMesh = chain[-1].mesh if chain else cloth[0]
    return mesh.triangulate().triangles.astype(np.int64)


def told(answer: Answer, which: str, name: str = "crossings") -> int:
    """What the report says of cloth through cloth."""
    return answer.telemetry[0]["contact"]["cloth"][which][name]


def counted(answer: Answer, *cloths: Cloth) -> int:
    """Edges of either garment through faces of the other, by brute force."""
    return between(answer.points, [faces_of(cloth) for cloth in cloths])


def crossed(kind: str) -> tuple[list[Cloth], list[np.ndarray]]:
    """Two sheets that start through one another."""
    cloths = [square(12, edge=0.5 * EDGE), square(10, edge=0.5 * EDGE)]
    lower, upper = (cloth[1] for cloth in cloths)
    upper = upper + np.array([0.0037, 0.0, 0.0051])
    tilted = upper + np.outer(0.3 * upper[:, 0] + 0.11 * upper[:, 2], [0.0, 1.0, 0.0])
    return cloths, [lower, {"dented": dented(upper), "cornered": cornered(upper), "tilted": tilted}[kind]]


class TestCrossed:
    """S24."""

    def test_s24_crossings_never_rise(self):
        """Against the input, in every frame, and told as they are."""
        cloths, cages = crossed("tilted")
        garments = [named(cloth, name) for cloth, name in zip(cloths, "AB", strict=True)]
        one = refiner_with(garments, times=(0.0, 1.0))
        for time in (0.0, 1.0):
            answer = one.solve(frame_with([cage + 1e-4 * time for cage in cages], time=time))
            assert told(answer, "after") <= told(answer, "before")
            between_garments = "between_garments"
            assert told(answer, "after", between_garments) <= told(answer, "before", between_garments)
            assert told(answer, "after", between_garments) == counted(answer, *cloths)


def tube_of_cloth() -> Cloth:
    """An open upright tube, as a sleeve."""
    mesh, points = sleeve(8, 5, edge=EDGE)
    return mesh, points[:, [1, 2, 0]] + np.array([0.002, 0.13 * EDGE, 0.003])


class TestStacked:
    """S26."""

    @pytest.mark.parametrize("gap", [0.5, 0.1])
    def test_s26_ten_layers_nearer_than_they_are_thick_stay(self, gap: float):
        """R is the thickness; the layers rest at half of it and, below the least offset, at a tenth."""
        cloth = square(4)
        cages = [cloth[1] + np.array([0.0, gap * THICK * layer, 0.0]) for layer in range(10)]
        garments = [named(cloth, f"L{layer}") for layer in range(10)]
        answer = refiner_with(garments, gravity=WEIGHTLESS, steps=50).solve(frame_with(cages))
        drift = [
            np.abs(points - base_of(cloth[0], cage, 1)).max() for points, cage in zip(answer.points, cages, strict=True)
        ]
        assert len(answer.telemetry[0]["together"]) == 10
        assert max(drift) < (0.1 if gap == 0.5 else 2.0) * THICK


def halves() -> tuple[list[Cloth], list[np.ndarray], np.ndarray, np.ndarray]:
    """A sheet cut in two along x = 0: cloths, cages, and fine vertices of the seam on either side, in order."""
    left = square(4)
    cloths = [(left[0], left[1] + np.array([-0.1, 0.0, 0.0])), (left[0], left[1] + np.array([0.1, 0.0, 0.0]))]
    fine = [base_of(*cloth, 1) for cloth in cloths]
    seams = [np.flatnonzero(np.abs(points[:, 0]) < 1e-9) for points in fine]
    seams = [which[np.argsort(points[which, 2])] for which, points in zip(seams, fine, strict=True)]
    return cloths, [cloth[1] for cloth in cloths], seams[0], seams[1]


def seam_gap(gravity: np.ndarray, squeeze: float, **options: Any) -> float:
    """How far the seam of two halves opens at most [m]."""
    cloths, cages, left, right = halves()
    garments = [named(cloth, name) for cloth, name in zip(cloths, "AB", strict=True)]
    cages = [cage * np.array([1.0 - squeeze, 1.0, 1.0]) for cage in cages]
    answer = refiner_with(sewn(garments, *cages), gravity=gravity, **options).solve(frame_with(cages))
    return float(np.linalg.norm(answer.points[0][left] - answer.points[1][right], axis=1).max())
