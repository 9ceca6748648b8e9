"""Contact alone, without subdivision and wrinkles: cloth inside a body comes out, and all other cloth stays."""

from pathlib import Path

import numpy as np
from layers import world_metres
from pxr import Gf, Usd, UsdGeom
from shots import CLOTH, EDGE, cloth_shot, fine, refine
from stages import COLLIDER_API

ONLY_CONTACT = {"level": 0, "steps": 24, "overrides": ("refine:detail=0",)}
TIMES = (1.0, 2.0)
RADIUS = 0.06
"""Of a ball in the middle of the sheet [m]."""
REACH = EDGE
"""Distance from the ball beyond which no vertex shares a face with cloth inside it [m]."""


def shot_with_ball(path: Path) -> tuple[Path, np.ndarray]:
    """A waving sheet of 5 cm squares through the middle of a ball, and the middle [m]."""
    shot = cloth_shot(path, times=TIMES, size=(12, 12))
    stage = Usd.Stage.Open(str(shot))
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Get(1.0), float)
    middle = points.mean(axis=0) + np.array([0.1, 0.2, 0.1])
    ball = UsdGeom.Sphere.Define(stage, "/World/ball")
    ball.GetRadiusAttr().Set(RADIUS / EDGE)
    UsdGeom.XformCommonAPI(ball).SetTranslate(Gf.Vec3d(*middle.tolist()))
    ball.GetPrim().AddAppliedSchema(COLLIDER_API)
    stage.Save()
    return shot, EDGE * middle


def test_cloth_leaves_the_body_and_all_other_cloth_stays(tmp_path: Path) -> None:
    shot, middle = shot_with_ball(tmp_path / "shot.usda")
    out = tmp_path / "out.usdc"
    report = refine(shot, out, **ONLY_CONTACT)
    assert report.exit_code == 0
    for time in TIMES:
        cage, found = world_metres(Usd.Stage.Open(str(shot)), CLOTH, time), fine(shot, out, time)
        before, after = (np.linalg.norm(each - middle, axis=1) - RADIUS for each in (cage, found))
        moved = np.linalg.norm(found - cage, axis=1)
        assert before.min() < -0.01, "the cage is inside the ball"
        assert after.min() > -1e-4
        assert moved[before > REACH].max() < 1e-6
        assert moved[before < 0].min() > 1e-3
