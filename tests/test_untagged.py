"""Meshes that cloth touches and that nothing names as colliders are named, and taken by ``auto``."""

import shlex
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from bodies import box
from pxr import Usd, UsdGeom
from shots import refine
from stages import COLLIDER_API, GARMENT_API, add_mesh, add_sheet, author, new_stage, save, vec3

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.studio.session import TuneSession

UNDER = box((6.0, 3.0, 2.6))[0] + [2.0, 1.5, -1.7]
"""Under the sheet, which comes down to -0.3 units: 10 mm where a unit is 10 cm."""


def add_box(stage: Usd.Stage, path: str = "/World/body", points: np.ndarray = UNDER) -> UsdGeom.Mesh:
    """A box without a mark."""
    return add_mesh(stage, path, points, box()[1], schema=None, scheme="none")


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    """A sheet of 40 by 30 cm."""
    stage = new_stage(tmp_path / "shot.usda", metres=0.1)
    add_sheet(stage)
    return stage


def test_it_is_named_with_what_to_type(stage: Usd.Stage, tmp_path: Path):
    add_box(stage)
    shot = save(stage)
    found = inspect_shot(shot)
    warning = next(said for said in found["warnings"] if "does not feel" in said)
    assert "</World/body> (" in warning
    assert warning.endswith("give --collider auto, or by name --collider /World/body")
    assert found["command"].endswith("--collider /World/body")
    assert warning in refine(Path(shot), tmp_path / "a.usdc", dry_run=True).warnings
    with closing(TuneSession(shot)) as session:
        assert session.warning == warning


def test_animated_cloth_without_a_body_is_a_garment(tmp_path: Path):
    stage = new_stage(tmp_path / "shot.usda", metres=0.1)
    add_sheet(stage, times=(1.0, 2.0))
    add_sheet(stage, "/World/backdrop", times=()).AddTranslateOp().Set((0.0, 0.0, -9.0))
    for name in ("cloth", "backdrop"):
        stage.GetPrimAtPath(f"/World/{name}").RemoveAppliedSchema(GARMENT_API)
    found = inspect_shot(save(stage))
    assert shlex.split(found["command"])[-2:] == ["--garment", "/World/cloth"]
    assert "/World/backdrop" not in found["command"]
    assert found["exit_code"] == 0


def test_names_and_motion_say_what_is_cloth(tmp_path: Path):
    """Closed clothes on a body that was cut off under them, and a hat that moves with its transform."""
    stage = new_stage(tmp_path / "shot.usda", metres=0.1)
    around = box((4.0, 3.0, 0.4))[0] + [2.0, 1.5, 0.0]
    clothes = add_box(stage, "/World/hero/clothes", around)
    for time in (1.0, 2.0):
        clothes.GetPointsAttr().Set(vec3(around + np.array([0.0, 0.0, 0.02 * time])), time)
    add_sheet(stage, "/World/hero/body", tagged=False)
    hat = add_sheet(stage, "/World/hero/hat", times=(), tagged=False)
    move = hat.AddTranslateOp()
    for time in (1.0, 2.0):
        move.Set((0.0, 0.0, 0.1 * time), time)
    command = shlex.split(inspect_shot(save(stage))["command"])
    assert [command[k + 1] for k, word in enumerate(command) if word == "--garment"] == ["/World/hero/clothes"]
    assert "/World/hero/body" in [command[k + 1] for k, word in enumerate(command) if word == "--collider"]


def test_auto_takes_it_and_what_is_marked(stage: Usd.Stage, tmp_path: Path):
    add_box(stage)
    add_box(stage, "/World/marked", UNDER + np.array([8.0, 0.0, 0.0])).GetPrim().AddAppliedSchema(COLLIDER_API)
    report = refine(Path(save(stage)), tmp_path / "a.usdc", colliders=["auto"], level=0, frames=(1.0, 1.0))
    assert report.garments[0]["colliders"] == ["/World/body", "/World/marked"]
    assert report.options["colliders"] == ["auto"]
    assert list(report.frames[0]["garments"][0]["contact"]["bodies"]) == ["/World/body"]
    assert not any("does not feel" in said for said in report.warnings)


def away(stage: Usd.Stage) -> None:
    add_box(stage, points=UNDER - np.array([0.0, 0.0, 1.0]))


def sky(stage: Usd.Stage) -> None:
    add_box(stage, points=box((180.0, 180.0, 180.0))[0])


def switched_off(stage: Usd.Stage) -> None:
    prim = add_box(stage).GetPrim()
    prim.AddAppliedSchema(COLLIDER_API)
    author(prim, "physgraph:collider:enabled", False, kind="bool")


def invisible(stage: Usd.Stage) -> None:
    add_box(stage).CreateVisibilityAttr("invisible")


def copy_of_a_collider(stage: Usd.Stage) -> None:
    add_box(stage).GetPrim().AddAppliedSchema(COLLIDER_API)
    add_box(stage, "/World/copy")


CASES = [away, sky, switched_off, invisible, copy_of_a_collider]


@pytest.mark.parametrize("add", CASES, ids=lambda add: add.__name__)
def test_what_cloth_does_not_lie_on_is_not_named(stage: Usd.Stage, add):
    add(stage)
    found = inspect_shot(save(stage))
    assert not any("does not feel" in said for said in found["warnings"])
    assert "--collider" not in found["command"]
