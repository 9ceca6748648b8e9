"""Which way is down: as the stage says, as it was asked for, or as garments author it; and a stage that is wrong."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import box, tube
from pxr import Sdf, Usd, UsdGeom
from shots import refine
from stages import COLLIDER_API, GARMENT_API, add_mesh, author, new_stage, save

from physgraph_usd.errors import SchemaError
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.usd.read.meshes import DrawnStage, upright
from physgraph_usd.usd.read.reader import open_shot

PERSON = (0.4, 0.25, 1.7)
"""Sizes of a standing body whose height comes last [m]."""
SKIRT = tube(0.25, 0.6, around=12, rows=4)


def along(axis: str, points: np.ndarray) -> np.ndarray:
    """Points that stand along z, turned to stand along an axis."""
    return points if axis == "Z" else points @ upright(np.array([0.0, 0.0, 1.0])).T


def worn(path: Path, *, up: str, axis: str) -> str:
    """A stage of an up axis, with cloth round a body that stand along another, or the same."""
    stage = new_stage(path, up=up)
    for name, (points, faces), api in (("cloth", SKIRT, GARMENT_API), ("body", box(PERSON), COLLIDER_API)):
        add_mesh(stage, f"/World/{name}", along(axis, points), faces, schema=api)
    return save(stage)


def warned(shot: str, **options: Any) -> list[str]:
    return [each for each in inspect_shot(shot, level=0, **options)["warnings"] if "stand along" in each]


@pytest.mark.parametrize("axis", ["Y", "Z"])
@pytest.mark.parametrize("up", ["Y", "Z"])
def test_a_stage_across_its_bodies_is_told_with_an_option_that_mends_it(tmp_path: Path, up: str, axis: str):
    shot = worn(tmp_path / "s.usda", up=up, axis=axis)
    said = warned(shot)
    assert len(said) == (up != axis)
    for each in said:
        assert f"</World/body> inside it stand along {axis}, but gravity is 9.81 m/s^2 towards -{up}" in each
        assert f"give --gravity -{axis}" in each
    assert warned(shot, gravity=f"-{axis}") == warned(shot, gravity=f"-{up}") == []
    command = inspect_shot(shot, level=0)["command"]
    assert command.endswith(f" --gravity -{axis}") == (up != axis)
    assert " --level 0" in command


def across(shot: Path, folder: Path) -> str:
    """A stage that names the other up axis over a shot in metres."""
    root = Sdf.Layer.CreateNew(str(folder / "across.usda"))
    root.subLayerPaths.append(str(shot))
    right = Usd.Stage.Open(str(shot))
    over = Usd.Stage.Open(root)
    UsdGeom.SetStageUpAxis(over, {"Y": "Z", "Z": "Y"}[UsdGeom.GetStageUpAxis(right)])
    UsdGeom.SetStageMetersPerUnit(over, 1.0)
    over.SetTimeCodesPerSecond(right.GetTimeCodesPerSecond())
    root.Save()
    return root.realPath


def test_a_sample_on_a_stage_with_the_other_axis_is_told(sample: Callable[[str], Path], tmp_path: Path):
    assert warned(str(sample("skirt"))) == []
    (said,) = warned(across(sample("skirt"), tmp_path))
    assert "give --gravity -Y" in said


def test_garments_author_one_gravity_and_options_go_before(tmp_path: Path):
    shot = worn(tmp_path / "s.usda", up="Z", axis="Y")
    root = Sdf.Layer.FindOrOpen(shot)
    Sdf.AttributeSpec(root.GetPrimAtPath("/World"), "physgraph:gravity", Sdf.ValueTypeNames.Token).default = "-Y"
    root.Save()
    opened = open_shot(shot)
    np.testing.assert_allclose(opened.scene.gravity, [0.0, -9.81, 0.0])
    assert opened.gravity_source == "</World>.physgraph:gravity"
    assert warned(shot) == []
    np.testing.assert_allclose(open_shot(shot, gravity="X").scene.gravity, [9.81, 0.0, 0.0])


@pytest.mark.parametrize(("values", "message"), [(("down",), "must be one of X, Y"), (("-Y", "-Z"), "has one gravity")])
def test_gravity_that_is_none_or_two_is_refused(stage: Usd.Stage, values: tuple[str, ...], message: str):
    for index, value in enumerate(values):
        mesh = add_mesh(stage, f"/World/cloth{index}", np.eye(3), [[0, 1, 2]])
        author(mesh.GetPrim(), "physgraph:gravity", value, kind="token")
    with pytest.raises(SchemaError, match=message):
        open_shot(save(stage))


def test_pictures_stand_as_gravity_pulls(tmp_path: Path):
    shot, layer = worn(tmp_path / "s.usda", up="Z", axis="Y"), tmp_path / "fine.usdc"
    refine(Path(shot), layer, level=0, gravity="-Y")
    sizes = [
        np.ptp(stage.meshes(None)[0].points, axis=0)
        for stage in (DrawnStage(Path(shot), layer), DrawnStage(Path(shot)))
    ]
    assert sizes[0][1] == pytest.approx(0.6, abs=0.05)  # the skirt's length
    assert sizes[1][2] == pytest.approx(0.6, abs=0.05)
    for up in (*np.eye(3), *-np.eye(3), np.array([0.48, -0.6, 0.64])):
        np.testing.assert_allclose(upright(up) @ up, [0.0, 1.0, 0.0], atol=1e-12)
        assert np.linalg.det(upright(up)) == pytest.approx(1.0)
