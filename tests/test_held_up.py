"""Cloth that is held up where it crosses is not strained by what the rest of it does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, Vt
from shots import refine

NAMES = ("wide", "thin", "alike")


def tubes(file: Path) -> Path:
    """Closed tubes of 2 cm, a wide one and two thin ones at one place inside it that cross its caps."""
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    for name, half, rings in zip(NAMES, (0.5, 0.05, 0.05), (10, 3, 3), strict=True):
        points = [[half * a, height, half * b] for height in np.linspace(0.0, 2.0, rings) for a, b in corners]
        sides = [
            [4 * r + k, 4 * r + (k + 1) % 4, 4 * r + 4 + (k + 1) % 4, 4 * r + 4 + k]
            for r in range(rings - 1)
            for k in range(4)
        ]
        faces = [*sides, [0, 1, 2, 3], [4 * rings - 1, 4 * rings - 2, 4 * rings - 3, 4 * rings - 4]]
        mesh = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        mesh.CreateFaceVertexCountsAttr([4] * len(faces))
        mesh.CreateFaceVertexIndicesAttr(np.ravel(faces).tolist())
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.array(points, np.float32)), 1.0)
    stage.Save()
    return file


def test_tubes_that_cross_keep_their_length_in_few_steps(tmp_path: Path):
    """Two steps a level do not settle them; the wide one grew by 0.4 of its length, the thin ones shrank by 0.7.

    They are 2 m long. With the shot and three jitters of 1e-7 m they end between 1.89 and 2.47 m.
    """
    few = {"level": 1, "steps": 2, "integrator": "quasi-newton"}
    report = refine(tubes(tmp_path / "shot.usda"), tmp_path / "fine.usdc", garments=["/World/*"], **few)
    assert report.unsettled
    stage = Usd.Stage.Open(str(tmp_path / "fine.usdc"))
    for name in NAMES:
        points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}")).GetPointsAttr().Get(1.0))
        assert 1.8 < np.ptp(points, axis=0).max() < 2.6, name
