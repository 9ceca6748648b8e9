"""Small inputs that were solved for minutes: each is refused by name, or solved, at once."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt
from shots import cloth_shot, refine
from stages import GARMENT_API, new_stage, save, vec3

from physgraph_usd.errors import GarmentError, PhysGraphError, StageError
from physgraph_usd.shot.refine import inspect_shot

WEAK = ("physgraph:guide:stiffness=1e-30",)


def polygon(path: Path, *faces: np.ndarray) -> Path:
    """A garment of one round, or of several on the same points."""
    stage = new_stage(path)
    mesh = UsdGeom.Mesh.Define(stage, "/World/cloth")
    angle = np.linspace(0.0, 2.0 * np.pi, len(faces[0]), endpoint=False)
    mesh.CreatePointsAttr(vec3(np.stack([np.cos(angle), np.sin(angle), 0.05 * np.sin(3.0 * angle)], axis=1)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([len(face) for face in faces]))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.concatenate(faces).astype(np.int32)))
    mesh.GetPrim().AddAppliedSchema(GARMENT_API)
    return Path(save(stage))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_is_no_shot(tmp_path: Path):
    os.mkfifo(tmp_path / "s.usda")
    for read in (inspect_shot, lambda shot: refine(shot, tmp_path / "fine.usdc")):
        with pytest.raises(StageError, match="is no file: it is a pipe"):
            read(tmp_path / "s.usda")


@pytest.mark.parametrize(
    ("faces", "said"),
    [
        ([np.arange(6000)], "face 0 has 6,000 corners; 1,000 are the most"),
        ([np.arange(500), np.arange(500)[::-1]], "faces 0 and 1 have the same 500 corners"),
    ],
)
def test_a_face_that_no_solve_ends_on_is_refused(tmp_path: Path, faces: list[np.ndarray], said: str):
    with pytest.raises(GarmentError, match=said):
        refine(polygon(tmp_path / "s.usda", *faces), tmp_path / "fine.usdc")


def test_a_face_of_many_corners_is_not(tmp_path: Path):
    assert refine(polygon(tmp_path / "s.usda", np.arange(48)), tmp_path / "fine.usdc").exit_code == 0


def test_a_vertex_that_single_precision_cannot_hold_with_its_cloth_fails_its_frame(tmp_path: Path):
    shot = cloth_shot(tmp_path / "s.usda", times=(1.0, 2.0, 3.0))
    stage = Usd.Stage.Open(str(shot))
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath("/World/cloth")).GetPointsAttr()
    points = np.array(attribute.Get(2.0))
    points[20] = 1e9, 0.0, 0.0
    attribute.Set(vec3(points), 2.0)
    stage.Save()
    report = refine(shot, tmp_path / "fine.usdc")
    assert list(report.failed) == ["2"]
    assert "point 20 is 4.85714e+07 m from the garment's middle" in report.failed["2"]


@pytest.mark.parametrize("options", [{"overrides": WEAK}, {"overrides": ("physgraph:guide:stiffness=0",)}])
def test_a_guide_that_lets_the_garment_fall_is_refused(tmp_path: Path, options: dict[str, tuple[str, ...]]):
    with pytest.raises(PhysGraphError, match="nothing holds it up but a guide of"):
        refine(cloth_shot(tmp_path / "s.usda"), tmp_path / "fine.usdc", **options)


SOFT = ("stretchStiffness=1e-3", "physgraph:guide:stiffness=0")
HEAVY = ("density=1e5",)


@pytest.mark.parametrize("overrides", [SOFT, HEAVY])
def test_cloth_on_a_body_that_cannot_carry_its_weight_is_refused(tmp_path: Path, overrides: tuple[str, ...]):
    shot = cloth_shot(tmp_path / "s.usda")
    stage = Usd.Stage.Open(str(shot))
    UsdGeom.Sphere.Define(stage, "/World/ball")
    stage.Save()
    with pytest.raises(PhysGraphError, match=r"N/m cannot carry its weight of .* N/m\^2: where it hangs it would be"):
        refine(shot, tmp_path / "fine.usdc", overrides=overrides, colliders=("/World/ball",))


def test_a_rest_frame_shrunk_to_nothing_fails_those_that_are_not(tmp_path: Path):
    shot = cloth_shot(tmp_path / "s.usda", times=(1.0, 2.0, 3.0), size=(7, 7), broken={1.0: 1e-6})
    report = refine(shot, tmp_path / "fine.usdc", rest_frame=1.0)
    assert list(report.failed) == ["2", "3"]
    assert "those of its rest shape, to which cloth shrinks, of 5.05e-08 m" in report.failed["2"]
