"""Pictures: what is drawn where, in which colour, and in which order."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="previews read stages with usd-core")
pytest.importorskip("PIL", reason="previews are written with Pillow")

from PIL import Image, ImageSequence
from pxr import Sdf, Usd, UsdGeom, Vt

from physgraph_usd.errors import StageError, UsageError
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.page.drawing import Surface, draw, encode_color, fit_view
from physgraph_usd.shot.page.preview import preview
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.usd.read.meshes import DrawnStage, refined_in, shot_of

SIZE = (320, 160)


def square(side: float = 1.0, *, color: tuple[float, float, float] = (0.5, 0.1, 0.1), depth: float = 0.0) -> Surface:
    half = side / 2
    points = np.array([[-half, -half, depth], [half, -half, depth], [half, half, depth], [-half, half, depth]])
    return Surface(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.tile(color, (2, 1)))


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


def test_fitted_view_holds_every_point() -> None:
    points = np.random.default_rng(3).normal(size=(500, 3)) * [3.0, 1.0, 0.5] + [10.0, -4.0, 2.0]
    for azimuth, elevation in ((0.0, 0.0), (25.0, 10.0), (200.0, -30.0)):
        view = fit_view(points, 2.0, azimuth=azimuth, elevation=elevation)
        seen = (points - view.eye) @ view.axes.T
        across = np.abs(seen[:, 0] / seen[:, 2]) / view.tangent / 2.0
        up = np.abs(seen[:, 1] / seen[:, 2]) / view.tangent
        assert np.all(seen[:, 2] < 0)
        assert across.max() < 0.95
        assert up.max() < 0.95
        assert max(across.max(), up.max()) > 0.7, "the picture is filled"
        np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
        assert view.axes[1, 1] > 0, "up stays up"


def test_square_covers_the_pixels_that_geometry_says() -> None:
    surface = square(color=(0.02, 0.3, 0.02))
    view = fit_view(surface.points, 1.0, azimuth=0.0, elevation=0.0)
    picture = draw([surface], view, size=(100, 100), floor=-10.0)
    side = 100 * 0.5 / (view.eye[2] * view.tangent)
    assert covered(picture).sum() == pytest.approx(side**2, rel=0.06)


def test_nearer_surface_hides_the_farther() -> None:
    surfaces = [square(color=(0.5, 0.02, 0.02)), square(0.5, color=(0.02, 0.02, 0.5), depth=0.3)]
    view = fit_view(surfaces[0].points, 1.0, azimuth=0.0, elevation=0.0)
    for order in (surfaces, surfaces[::-1]):
        picture = draw(order, view, size=(60, 60), floor=-10.0)
        assert picture[30, 30, 2] > picture[30, 30, 0]
        assert picture[10, 10, 0] > picture[10, 10, 2]


def test_ground_is_darker_below_a_thing() -> None:
    surface = square(color=(0.5, 0.02, 0.02))
    view = fit_view(surface.points, 1.0, azimuth=0.0, elevation=20.0)
    near = draw([surface], view, size=(80, 80), floor=-0.52).astype(int)
    far = draw([surface], view, size=(80, 80), floor=-50.0).astype(int)
    assert (far - near)[60:].max() > 25
    assert abs(int((far - near)[:20].max())) <= 2


def test_a_sheet_has_light_on_the_side_that_is_seen() -> None:
    """Turned over in place, it is seen from its back: as bright but for the factor of backs, and never unlit."""
    front = square(color=(0.5, 0.5, 0.5))
    back = Surface(front.points, front.triangles[:, ::-1], front.colors)
    view = fit_view(front.points, 1.0, azimuth=0.0, elevation=0.0)
    bright, dim = (int(draw([each], view, size=(60, 60), floor=-10.0)[30, 30, 1]) for each in (front, back))
    assert 0.8 * bright < dim < bright


def test_a_shadow_falls_where_light_is_blocked() -> None:
    wall = square(color=(0.5, 0.5, 0.5))
    shade = square(0.3, color=(0.5, 0.5, 0.5), depth=0.15)
    view = fit_view(wall.points, 1.0, azimuth=0.0, elevation=0.0)
    away = -0.62 / 0.48 * 0.15 * 100 / 1.16  # Pixels that the shadow lies beside what casts it, to the right.
    split = finer(wall)
    open_, shaded = (draw(each, view, size=(100, 100), floor=-10.0).astype(int) for each in ([split], [split, shade]))
    darker = (open_ - shaded)[:, :, 1]
    assert darker[62, int(50 - away)] > 40
    assert darker[20, 20] <= 2


def finer(surface: Surface, times: int = 5) -> Surface:
    """A surface of quarters of its triangles."""
    points, triangles = surface.points, surface.triangles
    for _ in range(times):
        a, b, c = points[triangles].transpose(1, 0, 2)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        points, label = np.unique(corners.round(9), axis=0, return_inverse=True)
        triangles = label.reshape(-1, 3)
    return Surface(points, triangles, np.tile(surface.colors[:1], (len(triangles), 1)))


def test_nothing_to_draw_leaves_the_studio() -> None:
    view = fit_view(np.zeros((1, 3)), 1.0)
    picture = draw([], view, size=(8, 4), floor=0.0)
    assert picture.shape == (4, 8, 3)
    assert np.all(picture == encode_color((0.80, 0.80, 0.79)))


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


def test_shot_can_be_given(sample: Callable[[str], Path], tmp_path: Path) -> None:
    layer = refined_layer(sample("swatch"), tmp_path, record=False)
    assert shot_of(layer) is None
    picture = pixels(preview(layer, tmp_path / "a.png", shot=sample("swatch"), size=SIZE))
    assert covered(picture[:, :160]).sum() > 1500
    assert covered(picture[:, 160:]).sum() > 1500


def test_plain_shot_is_drawn_alone(sample: Callable[[str], Path], tmp_path: Path) -> None:
    picture = pixels(preview(sample("swatch"), tmp_path / "a.png", size=SIZE))
    columns = np.nonzero(covered(picture))[1]
    assert columns.mean() == pytest.approx(160, abs=12)


def test_same_picture_in_every_unit_axis_and_winding(sample: Callable[[str], Path], tmp_path: Path) -> None:
    names = ("swatch", "swatch_cm", "swatch_zup", "swatch_lefthanded")
    pictures = [pixels(preview(sample(name), tmp_path / f"{name}.png", size=SIZE)) for name in names]
    for other in pictures[1:]:
        assert np.abs(other - pictures[0]).mean() < 0.5


def test_subsets_have_their_materials_colours(sample: Callable[[str], Path], tmp_path: Path) -> None:
    stage = DrawnStage(sample("flag"))
    mesh = stage.meshes(1.0)[0]
    assert np.unique(mesh.colors, axis=0).shape == (2, 3)
    picture = pixels(preview(sample("flag"), tmp_path / "a.png", times=[1.0], size=SIZE))
    assert covered(picture).sum() > 1500


def test_skinned_mesh_moves(sample: Callable[[str], Path]) -> None:
    stage = DrawnStage(sample("tshirt"))
    times = stage.times(stage.garments())
    assert len(times) == 36
    stage.bake(times)
    first, last = (next(m for m in stage.meshes(t) if m.path.endswith("Shirt")) for t in (times[0], times[-1]))
    assert np.abs(first.points - last.points).max() > 0.1


def test_camera_looks_from_where_it_is_told(sample: Callable[[str], Path], tmp_path: Path) -> None:
    front, side = (
        covered(
            pixels(preview(sample("flag"), tmp_path / f"{angle:g}.png", size=SIZE, camera=(angle, 0.0), times=[1.0]))
        )
        for angle in (0.0, 85.0)
    )
    assert np.ptp(np.nonzero(front)[1]) > 1.5 * np.ptp(np.nonzero(side)[1])


def test_loop_has_one_frame_per_time_at_the_shots_speed(sample: Callable[[str], Path], tmp_path: Path) -> None:
    out = preview(sample("swatch"), tmp_path / "a.gif", times=[1.0, 8.0, 16.0, 24.0], size=SIZE)
    with Image.open(out) as loop:
        assert sum(1 for _ in ImageSequence.Iterator(loop)) == 4
        assert loop.info["loop"] == 0
        assert loop.info["duration"] == pytest.approx(1000 * 8 / 24, abs=10)
    assert out.stat().st_size < 100_000


def test_same_picture_every_time(sample: Callable[[str], Path], tmp_path: Path) -> None:
    first, second = (preview(sample("frozen"), tmp_path / f"{i}.png", size=SIZE).read_bytes() for i in range(2))
    assert first == second


def test_wrong_requests_are_named(sample: Callable[[str], Path], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot draw 'a.tiff'; known suffixes: .png, .gif"):
        preview(sample("swatch"), tmp_path / "a.tiff")
    with pytest.raises(UsageError, match="one time code, not 2"):
        preview(sample("swatch"), tmp_path / "a.png", times=[1.0, 2.0])
    with pytest.raises(StageError, match=r"no such file: .*absent\.usdc"):
        preview(tmp_path / "absent.usdc", tmp_path / "a.png")


def test_shot_of_untagged_meshes_without_default_points_is_drawn(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "bare.usda"))
    mesh = UsdGeom.Mesh.Define(stage, "/Sheet")
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreatePointsAttr().Set([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], 5.0)
    mesh.CreateDisplayColorAttr([(0.5, 0.02, 0.02)])
    stage.Save()
    picture = pixels(preview(tmp_path / "bare.usda", tmp_path / "a.png", size=SIZE))
    assert covered(picture).sum() > 1500


def test_stage_without_meshes_says_so(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "empty.usda"))
    UsdGeom.Xform.Define(stage, "/Nothing")
    stage.Save()
    with pytest.raises(StageError, match="shows no mesh"):
        preview(tmp_path / "empty.usda", tmp_path / "a.png")


def test_a_layer_of_some_frames_is_drawn_within_them(tmp_path: Path) -> None:
    shot = write_sample("swatch", tmp_path)
    layer = tmp_path / "some.usdc"
    refine_shot(shot, layer, RefineOptions(frames=(3, 5), level=1))
    stage = DrawnStage(shot, layer)
    assert stage.times(stage.garments()) == (3.0, 4.0, 5.0)
    assert max(DrawnStage(shot).times(())) > 5.0
