"""Two solutions of the same frames become one, without a jump and without cloth through cloth."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from shots import cloth_shot

from physgraph_usd.shot.chunks import frames_in_order, join
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import ShotSolver
from physgraph_usd.solver.scene import GarmentResult, Result
from physgraph_usd.usd.read.reader import open_shot


def result(time: float, height: float, *, kept: bool = False) -> Result:
    """A triangle at a height."""
    points = np.array([[0.0, 0.0, height], [1.0, 0.0, height], [0.0, 1.0, height]])
    return Result(time, (GarmentResult(points, reused=kept),))


def read(index: int, seam: int | None) -> Result:
    """A cloth at rest at zero, which another process has at a height in the first three frames, and goes on there."""
    return result(float(index), 0.0 if seam is None and index < 3 else 1.0, kept=True)


class Passing:
    """Finds nothing to object to, or says what crosses."""

    def __init__(self, why: str = "") -> None:
        self.why = why

    def __call__(self, time: object, near: Any, far: Any, wanted: Any) -> tuple[list[np.ndarray | None], str]:
        return wanted, self.why


def heights(found: list[Result]) -> list[float]:
    """Of each frame."""
    return [float(np.asarray(each.garments[0].points)[0, 2]) for each in found]


def test_cloth_that_would_cross_jumps_and_is_told_of():
    joints = [
        join([(read(k, None), read(k, 3)) for k in range(3)], lambda: Passing("</a> would have 3 edges through cloth"))
    ]
    found = list(frames_in_order(read, range(5), {3: 0}, join=lambda *_: joints[0].frames))
    assert [each.garments[0].reused for each in found] == [True, True, True, False, True]
    assert heights(found) == [0.0, 0.0, 0.0, 1.0, 1.0]
    (said,) = joints[0].warnings
    assert "after time code 2" in said
    assert "3 edges through cloth" in said


def test_folds_that_change_sides_stop_before_they_cross(tmp_path: Path):
    """Half way between a half that lies over the other one, and under it, they would pass through each other."""
    with closing(open_shot(str(cloth_shot(tmp_path / "shot.usdc", times=(1.0,), size=(4, 3))))) as opened:
        move = ShotSolver(opened.path, [0], RefineOptions(), opened=opened).mover()
        flat = opened.frame(1.0).garments[0].points * [1.0, 1.0, 0.0]
        middle = flat.mean(axis=0)
        turned = np.flatnonzero(flat[:, 0] > middle[0] + 0.01)

        def folded(height: float) -> np.ndarray:
            points = flat.copy()
            points[turned, 0] = middle[0] - 0.9 * (flat[turned, 0] - middle[0])
            points[turned, 2] = height + 0.2 * (flat[turned, 1] - middle[1])
            return points

        for near, far, wanted in ((0.02, -0.02, 0.0004), (-0.02, 0.02, -0.0004)):
            (points,), why = move(1.0, [folded(near)], [folded(far)], [folded(wanted)])
            assert why == ""
            assert points is not None
            assert np.abs(points - folded(wanted)).max() > 0.001
        (points,), why = move(1.0, [folded(0.02)], [folded(0.03)], [folded(0.025)])
        assert why == ""
        assert points is not None
        assert np.allclose(points, folded(0.025), atol=1e-6)
