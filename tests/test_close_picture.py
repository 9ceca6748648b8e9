"""The close picture of a place shows that place: the camera turns, and what hides it everywhere is left out."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from shots import CLOTH, EDGE, cloth_shot, fine, refine
from stages import add_mesh

pytest.importorskip("PIL", reason="pictures are drawn with Pillow")

from pxr import Sdf, Usd, UsdGeom, Vt

from physgraph_usd.shot.page.preview import Pictures
from physgraph_usd.shot.page.worst import CloseUp

SIZE = (320, 160)
SIDES = {"left": (0, -1), "right": (0, 1), "below": (1, -1), "above": (1, 1), "behind": (2, -1), "before": (2, 1)}
"""Axis and side of each board around the cloth."""


def drawn(
    folder: Path, boards: Sequence[str], *, color: tuple[float, float, float] | None = None, cloth: bool = False
) -> tuple[np.ndarray, str]:
    """The right panel of a close picture of the middle of a sheet, shape (H, W, 3), with boards a sheet's size away."""
    folder.mkdir()
    shot = cloth_shot(folder / "shot.usda", times=(1.0,))
    layer = folder / "fine.usdc"
    refine(shot, layer)
    points = fine(shot, layer, 1.0)
    middle, size = 0.5 * (points.min(axis=0) + points.max(axis=0)), float(np.ptp(points, axis=0).max())
    stage = Usd.Stage.Open(str(shot))
    for name in boards:
        axis, side = SIDES[name]
        u, v = (np.eye(3)[(axis + step) % 3] * 2.0 * size for step in (1, 2))
        corner = (
            middle + 2.0 * side * size * np.eye(3)[axis] if len(boards) > 1 else middle + side * size * np.eye(3)[axis]
        )
        quad = np.stack([corner - u - v, corner + u - v, corner + u + v, corner - u + v]) / EDGE
        add_mesh(stage, f"/World/{name}", quad, np.array([[0, 1, 2, 3]]), schema=None)
    if color is not None:
        primvar = UsdGeom.Gprim(stage.GetPrimAtPath(CLOTH)).CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
        primvar.Set(Vt.Vec3fArray([color]))
    stage.Save()
    if cloth:  # A mesh with points in the layer counts as refined cloth.
        with Sdf.ChangeBlock():
            over = Sdf.Layer.FindOrOpen(str(layer))
            for name in boards:
                prim = Sdf.CreatePrimInLayer(over, f"/World/{name}")
                there = stage.GetAttributeAtPath(f"/World/{name}.points").Get()
                Sdf.AttributeSpec(prim, "points", Sdf.ValueTypeNames.Point3fArray).default = there
        over.Save()
    vertex = int(np.linalg.norm(points - middle, axis=1).argmin())
    picture, words = Pictures(layer, shot, SIZE).draw_close(CloseUp(1.0, CLOTH, [vertex], "here"))
    return np.asarray(picture).astype(int)[:, SIZE[0] // 2 :], words


def warm(picture: np.ndarray) -> float:
    """Red relative to blue in the middle of a picture."""
    part = picture[60:100, 60:100].reshape(-1, 3).mean(axis=0)
    return float(part[0] / part[2])


def test_cloth_without_a_colour_is_warm_and_a_body_grey(tmp_path: Path):
    picture, words = drawn(tmp_path / "a", ())
    assert words == ""
    assert warm(picture) > 1.15
    painted, _ = drawn(tmp_path / "b", (), color=(0.1, 0.1, 0.8))
    assert warm(painted) < 0.5


@pytest.mark.parametrize("board", SIDES)
def test_the_camera_turns_away_from_a_board_before_the_place(tmp_path: Path, board: str):
    picture, words = drawn(tmp_path / "a", [board])
    assert words == ""
    assert warm(picture) > 1.15


def test_boards_all_around_are_left_out_and_named(tmp_path: Path):
    picture, words = drawn(tmp_path / "a", [*SIDES])
    assert words.startswith("without </World/")
    assert words.endswith(", which would hide it")
    assert warm(picture) > 1.15


def test_cloth_all_around_is_cut_open(tmp_path: Path):
    """The place is in the middle of a bag of cloth: the boards around are garments too."""
    picture, words = drawn(tmp_path / "a", [*SIDES], cloth=True)
    assert words == "cut open before it"
    assert warm(picture) > 1.15
    assert picture[60:100, 60:100].mean() > 60.0
