"""Pictures: what is drawn where, in which colour, and in which order."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="previews read stages with usd-core")
pytest.importorskip("PIL", reason="previews are written with Pillow")

from PIL import Image, ImageSequence
from pxr import Sdf, Usd, UsdGeom, Vt

from physgraph_usd.errors import StageError, UsageError
from physgraph_usd.shot.page.preview import preview
from physgraph_usd.usd.read.meshes import DrawnStage, refined_in, shot_of

SIZE = (320, 160)


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def covered(picture: np.ndarray) -> np.ndarray:
    """Pixels of a saturated colour: neither studio, shadow nor label."""
    return np.ptp(picture.astype(int), axis=-1) > 25


def refined_layer(shot: Path, folder: Path, *, record: bool = True, lift: float = 0.0) -> Path:
    """A layer that moves and quarters the swatch, as refinement would."""
    stage = Usd.Stage.Open(str(shot))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/SwatchShot/Swatch"))
    layer = Sdf.Layer.CreateNew(str(folder / "fine.usda"))
    layer.timeCodesPerSecond = 24
    if record:
        layer.customLayerData = {"physgraph": {"shot": str(shot)}}
    fine = Usd.Stage.Open(layer)
    over = UsdGeom.Mesh(fine.OverridePrim(mesh.GetPath()))
    for time in mesh.GetPointsAttr().GetTimeSamples():
        points = np.asarray(mesh.GetPointsAttr().Get(time)) + np.array([0, lift, 0], np.float32)
        over.GetPrim().CreateAttribute("points", Sdf.ValueTypeNames.Point3fArray).Set(
            Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points)), time
        )
    layer.Save()
    return Path(layer.realPath)


def test_coarse_stands_beside_fine(sample: Callable[[str], Path], tmp_path: Path) -> None:
    layer = refined_layer(sample("swatch"), tmp_path, lift=0.05)
    assert refined_in(layer) == ("/SwatchShot/Swatch",)
    shown = shot_of(layer)
    assert shown is not None
    assert shown.samefile(sample("swatch"))
    picture = pixels(preview(layer, tmp_path / "a.png", size=SIZE))
    assert picture.shape == (160, 320, 3)
    left, right = covered(picture[:, :160]), covered(picture[:, 160:])
    assert left.sum() > 1500
    assert right.sum() == pytest.approx(left.sum(), rel=0.1)
    assert np.nonzero(right)[0].mean() < np.nonzero(left)[0].mean() - 8, "the fine side hangs 5 cm higher"


def test_same_picture_in_every_unit_axis_and_winding(sample: Callable[[str], Path], tmp_path: Path) -> None:
    names = ("swatch", "swatch_cm", "swatch_zup", "swatch_lefthanded")
    pictures = [pixels(preview(sample(name), tmp_path / f"{name}.png", size=SIZE)) for name in names]
    for other in pictures[1:]:
        assert np.abs(other - pictures[0]).mean() < 0.5


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
@pytest.mark.parametrize("scale", [1.0, -1.0])
def test_quads_are_drawn_as_renderers_cut_them(tmp_path: Path, orientation: str, scale: float) -> None:
    shot = tmp_path / "kite.usda"
    stage = Usd.Stage.CreateNew(str(shot))
    mesh = UsdGeom.Mesh.Define(stage, "/Kite")
    points = np.array([[0, 0, 0], [1, 0, 0.2], [3, 3, 0], [0, 1, 0.2]], np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateOrientationAttr(orientation)
    UsdGeom.XformCommonAPI(mesh).SetScale((scale, 1.0, 1.0))
    stage.Save()
    (drawn,) = DrawnStage(shot).meshes(None)
    mirrored = (orientation == "leftHanded") != (scale < 0)
    assert drawn.triangles.tolist() == ([[0, 3, 2], [0, 2, 1]] if mirrored else [[0, 1, 2], [0, 2, 3]])


def test_skinned_mesh_moves(sample: Callable[[str], Path]) -> None:
    stage = DrawnStage(sample("tshirt"))
    times = stage.times(stage.garments())
    assert len(times) == 36
    stage.bake(times)
    first, last = (next(m for m in stage.meshes(t) if m.path.endswith("Shirt")) for t in (times[0], times[-1]))
    assert np.abs(first.points - last.points).max() > 0.1


def test_loop_has_one_frame_per_time_at_the_shots_speed(sample: Callable[[str], Path], tmp_path: Path) -> None:
    out = preview(sample("swatch"), tmp_path / "a.gif", times=[1.0, 8.0, 16.0, 24.0], size=SIZE)
    with Image.open(out) as loop:
        assert sum(1 for _ in ImageSequence.Iterator(loop)) == 4
        assert loop.info["loop"] == 0
        assert loop.info["duration"] == pytest.approx(1000 * 8 / 24, abs=10)
    assert out.stat().st_size < 100_000


def test_wrong_requests_are_named(sample: Callable[[str], Path], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot draw 'a.tiff'; known suffixes: .png, .gif"):
        preview(sample("swatch"), tmp_path / "a.tiff")
    with pytest.raises(UsageError, match="one time code, not 2"):
        preview(sample("swatch"), tmp_path / "a.png", times=[1.0, 2.0])
    with pytest.raises(UsageError, match="has no cloth at time code 999, only at time codes 1 to "):
        preview(sample("swatch"), tmp_path / "a.png", times=[999.0])
    with pytest.raises(StageError, match=r"no such file: .*absent\.usdc"):
        preview(tmp_path / "absent.usdc", tmp_path / "a.png")
