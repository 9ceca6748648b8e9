"""What hangs on a garment follows its refined cloth: buttons, piping, points, render meshes, and trims of trims."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from layers import errors, open_over, world_metres
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from shots import CLOTH, EDGE, cloth_shot, only, refine, run
from stages import add_mesh, add_sheet, add_skeleton, bind_skin, new_stage, sheet_faces, sheet_points, vec3

from physgraph_usd.errors import AbsentError, GarmentError, SchemaError
from physgraph_usd.lab.samples import trims
from physgraph_usd.lab.samples.shapes import ellipsoid
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.shot.stitch import stitch
from physgraph_usd.solver.mesh.subdivide import smooth, subdivide
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.rigid import best_motion
from physgraph_usd.studio.session import TuneSession
from physgraph_usd.usd.mesh.bind import closest
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.read.targets import TARGETS
from physgraph_usd.usd.write.sample_stage import write_stage
from physgraph_usd.usd.write.tag import tag

BUTTON, PIPING, BEADS = "/World/button", "/World/piping", "/World/beads"
SIZE = (6, 4)
LATE = 4.0


def bind(stage: Usd.Stage, *paths: str, to: str = CLOTH) -> None:
    stage.GetPrimAtPath(to).CreateRelationship(TARGETS).SetTargets([Sdf.Path(path) for path in paths])


def beside(stage: Usd.Stage, path: str, middle: ArrayLike, *, radius: float = 0.1) -> UsdGeom.Mesh:
    """A closed ball beside the sheet, in its units."""
    solid = ellipsoid(np.full(3, radius), np.asarray(middle, float), (8, 6))
    faces = np.split(solid.indices, np.cumsum(solid.counts)[:-1])
    return add_mesh(stage, path, solid.points, faces, schema=None)


def on_sheet(x: float, y: float, above: float = 0.0) -> np.ndarray:
    """A place on the sheet's default points, whose vertices lie at whole numbers."""
    points = sheet_points(None, SIZE).reshape(SIZE[1] + 1, SIZE[0] + 1, 3)
    return points[int(y), int(x)] + np.array([0.0, 0.0, above])


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """A waving sheet with a button, a curve along one side and a few points, which stand still."""
    path = cloth_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(path))
    beside(stage, BUTTON, on_sheet(3, 2, 0.12))
    curve = UsdGeom.BasisCurves.Define(stage, PIPING)
    curve.CreatePointsAttr(vec3(sheet_points(None, SIZE)[: SIZE[0] + 1] + np.array([0, 0, 0.02], np.float32)))
    curve.CreateCurveVertexCountsAttr([SIZE[0] + 1])
    curve.CreateTypeAttr("linear")
    curve.CreateWidthsAttr([0.04])
    UsdGeom.Points.Define(stage, BEADS).CreatePointsAttr(vec3(sheet_points(None, SIZE)[8:11]))
    bind(stage, BUTTON, PIPING, BEADS)
    stage.Save()
    return path


def cloth_at(stage: Usd.Stage, time: float, path: str = CLOTH) -> tuple[np.ndarray, np.ndarray]:
    """Points [m] and triangles of the refined cloth."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    counts, indices = mesh.GetFaceVertexCountsAttr().Get(time), mesh.GetFaceVertexIndicesAttr().Get(time)
    points = world_metres(stage, path, time)
    return points, PolygonMesh(np.asarray(counts), np.asarray(indices), len(points)).triangulate(points).triangles


def distances(stage: Usd.Stage, path: str, time: float) -> np.ndarray:
    """Distance of a prim's points from the refined cloth [m]."""
    return closest(world_metres(stage, path, time), *cloth_at(stage, time)).distance


def test_a_button_stays_a_button_and_curves_and_points_lie_on_the_cloth(shot: Path, tmp_path: Path):
    out = tmp_path / "out.usda"
    refine(shot, out)
    stage = open_over(shot, out)
    first, later = (world_metres(stage, BUTTON, time) for time in (1.0, LATE))
    motion = best_motion(first, later)
    assert np.linalg.norm(motion(first) - later, axis=1).max() < 1e-6
    assert np.linalg.norm(later - first, axis=1).min() > 0.1 * EDGE
    for time in (1.0, LATE):
        assert distances(stage, BUTTON, time).min() < 0.1 * EDGE
        assert distances(stage, PIPING, time).max() < 0.08 * EDGE
        assert distances(stage, BEADS, time).max() < 0.08 * EDGE
    assert not errors(out, shot)


def test_the_layer_holds_what_moves_and_nothing_else_of_a_target(shot: Path, tmp_path: Path):
    out = tmp_path / "out.usda"
    refine(shot, out)
    layer = Sdf.Layer.FindOrOpen(str(out))
    assert {name for path in (BUTTON, PIPING, BEADS) for name in layer.GetPrimAtPath(path).properties.keys()} == {
        "points",
        "extent",
    }
    assert layer.customLayerData["physgraph"]["bound"] == [BUTTON, PIPING, BEADS]
    stage = open_over(shot, out)
    curve = UsdGeom.BasisCurves(stage.GetPrimAtPath(PIPING))
    extent, points = (np.array(each.Get(LATE)) for each in (curve.GetExtentAttr(), curve.GetPointsAttr()))
    np.testing.assert_allclose(extent, [points.min(axis=0) - 0.02, points.max(axis=0) + 0.02], atol=1e-6)


def test_tag_names_what_follows_each_garment_beside_what_it_names_itself(shot: Path, tmp_path: Path):
    stage = Usd.Stage.Open(str(shot))
    bind(stage, BEADS)
    stage.Save()
    out = tag(shot, tmp_path / "tagged.usda", garments=[CLOTH], bind=["button", PIPING])
    tagged = Usd.Stage.Open(str(out))
    named = tagged.GetPrimAtPath(CLOTH).GetRelationship(TARGETS).GetTargets()
    assert sorted(map(str, named)) == [BEADS, BUTTON, PIPING]
    with closing(open_shot(str(out))) as opened:
        assert sorted(str(target.path) for target in opened.targets) == [BEADS, BUTTON, PIPING]


def test_a_tuned_layer_keeps_what_the_command_bound(shot: Path, tmp_path: Path):
    stage = Usd.Stage.Open(str(shot))
    stage.GetPrimAtPath(CLOTH).RemoveProperty(TARGETS)
    stage.Save()
    with closing(TuneSession(shot, garments=[CLOTH], bind=[BUTTON], out=tmp_path / "tuned.usda")) as session:
        session.set_value(CLOTH, "bendStiffness", 1e-5)
        assert f"--bind {BUTTON}" in session.command
        saved = session.save()
    with closing(open_shot(str(saved))) as opened:
        assert [str(target.path) for target in opened.targets] == [BUTTON]


@pytest.mark.parametrize("placed", ["turned", "mirrored", "scaled"])
def test_the_same_trim_below_another_transform_goes_to_the_same_place(shot: Path, tmp_path: Path, placed: str):
    refine(shot, tmp_path / "plain.usda")
    expected = world_metres(open_over(shot, tmp_path / "plain.usda"), BUTTON, LATE)
    stage = Usd.Stage.Open(str(shot))
    matrix = {
        "turned": Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 2, 3), 70)),
        "mirrored": Gf.Matrix4d().SetScale(Gf.Vec3d(-1, 1, 1)),
        "scaled": Gf.Matrix4d().SetScale(Gf.Vec3d(0.01, 2.0, 30.0)),
    }[placed]
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(BUTTON))
    points = np.asarray(mesh.GetPointsAttr().Get()) @ np.linalg.inv(np.array(matrix))[:3, :3]
    mesh.AddTransformOp().Set(matrix)
    mesh.GetPointsAttr().Set(vec3(points))
    stage.Save()
    refine(shot, tmp_path / "out.usda")
    found = world_metres(open_over(shot, tmp_path / "out.usda"), BUTTON, LATE)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_normals_turn_with_their_points_per_corner_too(shot: Path, tmp_path: Path):
    stage = Usd.Stage.Open(str(shot))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(BUTTON))
    points, corners = np.asarray(mesh.GetPointsAttr().Get()), np.asarray(mesh.GetFaceVertexIndicesAttr().Get())
    outward = points - points.mean(axis=0)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    normals = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "faceVarying")
    normals.Set(vec3(outward))
    normals.SetIndices(Vt.IntArray.FromNumpy(corners))
    UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Set(Sdf.ValueBlock(), 6.0)
    stage.Save()
    refine(shot, tmp_path / "out.usda")
    over = open_over(shot, tmp_path / "out.usda")
    moved = np.asarray(UsdGeom.Mesh(over.GetPrimAtPath(BUTTON)).GetPointsAttr().Get(LATE))
    turn = best_motion(points.astype(float), moved.astype(float)).turn
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "out.usda"))
    kinds = [type(layer.QueryTimeSample(f"{BUTTON}.primvars:normals", time)) for time in (LATE, 6.0)]
    assert kinds == [Vt.Vec3fArray, Sdf.ValueBlock]
    found = UsdGeom.PrimvarsAPI(over.GetPrimAtPath(BUTTON)).GetPrimvar("normals").ComputeFlattened(LATE)
    np.testing.assert_allclose(np.asarray(found), (outward @ turn.T)[corners], atol=1e-5)


def test_what_moves_on_its_own_follows_the_cloth_or_adds_the_wrinkle(tmp_path: Path):
    """With ``detail`` the target's own motion stays, and only refined less smoothly subdivided cloth is added."""
    path = cloth_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh.Define(stage, "/World/patch")
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    corners = [SIZE[0] + 2, SIZE[0] + 3, 2 * SIZE[0] + 4, 2 * SIZE[0] + 3]
    for time in (1.0, LATE):
        mesh.CreatePointsAttr().Set(vec3(sheet_points(time, SIZE)[corners] + np.array([0, 0, 0.01], np.float32)), time)
    bind(stage, "/World/patch")
    stage.Save()
    refine(path, tmp_path / "follow.usda")
    stage.GetPrimAtPath("/World/patch").CreateAttribute("physgraph:bind:mode", Sdf.ValueTypeNames.Token).Set("detail")
    stage.Save()
    refine(path, tmp_path / "detail.usda")
    own = world_metres(Usd.Stage.Open(str(path)), "/World/patch", LATE)
    follow, detail = (
        world_metres(open_over(path, tmp_path / f"{mode}.usda"), "/World/patch", LATE) for mode in ("follow", "detail")
    )
    cage = PolygonMesh(*sheet_faces("quads", SIZE), len(sheet_points(None, SIZE)))
    before = EDGE * (smooth(cage, subdivide(cage)) @ sheet_points(LATE, SIZE).astype(float))
    fine, _ = cloth_at(open_over(path, tmp_path / "detail.usda"), LATE)
    wrinkle = (fine - before)[corners]
    assert np.linalg.norm(wrinkle, axis=1).max() > 0.02 * EDGE
    np.testing.assert_allclose(detail - own, wrinkle, atol=0.02 * EDGE)
    assert np.linalg.norm(follow - fine[corners], axis=1).max() < 0.1 * EDGE


def test_a_trim_of_a_trim_follows_it(shot: Path, tmp_path: Path):
    stage = Usd.Stage.Open(str(shot))
    beside(stage, "/World/stitch", on_sheet(3, 2, 0.25), radius=0.02)
    bind(stage, "/World/stitch", to=BUTTON)
    stage.Save()
    refine(shot, tmp_path / "out.usda")
    over = open_over(shot, tmp_path / "out.usda")
    for time in (1.0, LATE):
        middles = [world_metres(over, each, time).mean(axis=0) for each in (BUTTON, "/World/stitch")]
        assert np.linalg.norm(middles[1] - middles[0]) == pytest.approx(0.13 * EDGE, rel=0.02)


def test_a_trim_inside_an_instance_follows_the_cloth_of_that_instance(shot: Path, tmp_path: Path):
    crowd = tmp_path / "crowd.usda"
    stage = Usd.Stage.CreateNew(str(crowd))
    UsdGeom.SetStageMetersPerUnit(stage, EDGE)
    UsdGeom.SetStageUpAxis(stage, "Y")
    for number in (0, 1):
        prim = UsdGeom.Xform.Define(stage, f"/crowd{number}")
        prim.AddTranslateOp().Set(Gf.Vec3d(20.0 * number, 0.0, 0.0))
        prim.GetPrim().GetReferences().AddReference(str(shot), "/World")
        prim.GetPrim().SetInstanceable(True)
    stage.Save()
    refine(crowd, tmp_path / "out.usda")
    over = open_over(crowd, tmp_path / "out.usda")
    places = [world_metres(over, f"/crowd{number}/button", LATE) for number in (0, 1)]
    np.testing.assert_allclose(places[1] - places[0], np.tile([20.0 * EDGE, 0.0, 0.0], (len(places[0]), 1)), atol=1e-5)
    assert np.linalg.norm(places[0] - world_metres(over, "/crowd0/button", 1.0), axis=1).min() > 0.1 * EDGE


def test_a_skinned_trim_is_not_skinned_twice(tmp_path: Path):
    rig, shot = "/World/rig", tmp_path / "shot.usda"
    stage = new_stage(shot, metres=EDGE)
    add_skeleton(stage, rig, (1.0, LATE))
    for name in ("cloth", "patch"):
        mesh = add_sheet(stage, f"{rig}/{name}", times=(), tagged=name == "cloth")
        bind_skin(mesh, rig, joints=[int(x > 2) for x in sheet_points()[:, 0]])
    bind(stage, f"{rig}/patch", to=f"{rig}/cloth")
    stage.Save()
    refine(shot, tmp_path / "out.usdc")
    over = open_over(shot, tmp_path / "out.usdc")
    before = world_metres(over, f"{rig}/patch", LATE)
    assert np.abs(before - EDGE * sheet_points()).max() > EDGE
    UsdSkel.BakeSkinning(UsdSkel.Root(over.GetPrimAtPath(rig)), Gf.Interval(1.0, LATE))
    np.testing.assert_array_equal(world_metres(over, f"{rig}/patch", LATE), before)
    assert closest(before, *cloth_at(over, LATE, f"{rig}/cloth")).distance.max() < 0.1 * EDGE


def test_chunks_processes_and_a_part_of_the_shot_place_targets_alike(shot: Path, tmp_path: Path):
    spans = (1.0, 3.0), (4.0, 6.0)
    for number, span in enumerate(spans):
        refine(shot, tmp_path / f"part{number}", frames=span, preroll=0, temporal="off")
    stitch([tmp_path / "part1", tmp_path / "part0"], tmp_path / "joined.usda")
    refine(shot, tmp_path / "two.usda", workers=2, temporal="off")
    refine(shot, tmp_path / "late.usda", frames=spans[1], temporal="off")
    layers = [Sdf.Layer.FindOrOpen(str(tmp_path / f"{name}.usda")) for name in ("joined", "two", "late")]
    for path in (BUTTON, PIPING, BEADS):
        first, *others = (layer.QueryTimeSample(Sdf.Path(f"{path}.points"), LATE) for layer in layers)
        assert all(first == other for other in others)


def test_targets_have_velocities_where_cloth_has_and_are_blocked_with_it(shot: Path, tmp_path: Path):
    stage = Usd.Stage.Open(str(shot))
    UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Set(Sdf.ValueBlock(), 6.0)
    stage.Save()
    refine(shot, tmp_path / "out.usda", velocities=True)
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "out.usda"))
    before, now, after = (np.asarray(layer.QueryTimeSample(f"{BUTTON}.points", time)) for time in (3.0, LATE, 5.0))
    velocity = np.asarray(layer.QueryTimeSample(f"{BUTTON}.velocities", LATE))
    np.testing.assert_allclose(velocity, (after - before) * 24.0 / 2.0, atol=1e-3)
    assert np.abs(now - before).max() > 0.01
    for name in ("points", "velocities", "extent"):
        assert isinstance(layer.QueryTimeSample(f"{BUTTON}.{name}", 6.0), Sdf.ValueBlock)


def test_validate_names_a_target_that_does_not_fit_its_mesh(shot: Path, tmp_path: Path):
    refine(shot, tmp_path / "out.usda")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "out.usda"))
    points = np.array(layer.QueryTimeSample(f"{BUTTON}.points", LATE))
    layer.SetTimeSample(f"{BUTTON}.points", LATE, vec3(points[:-3]))
    points[0] = np.nan
    layer.SetTimeSample(f"{BUTTON}.points", 5.0, vec3(points))
    layer.Save()
    found = "\n".join(errors(tmp_path / "out.usda", shot))
    assert f"{BUTTON}.faceVertexIndices" in found
    assert f"{BUTTON}.points" in found
    stage = Usd.Stage.Open(str(shot))
    stage.RemovePrim(BEADS)
    stage.Save()
    assert f"{BEADS}" in "\n".join(errors(tmp_path / "out.usda", shot))


def test_what_follows_is_no_body_though_it_is_tagged_as_one(shot: Path):
    stage = Usd.Stage.Open(str(shot))
    stage.GetPrimAtPath(BUTTON).AddAppliedSchema("PhysGraphColliderAPI")
    stage.Save()
    with closing(open_shot(shot)) as opened:
        assert opened.colliders == ()


def test_inspect_proposes_what_lies_on_the_cloth_and_moves_with_it(tmp_path: Path):
    path = cloth_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(path))
    mesh = beside(stage, BUTTON, on_sheet(3, 2, 0.03), radius=0.02)
    points, shift = np.asarray(mesh.GetPointsAttr().Get()), sheet_points(None, SIZE)
    for time in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
        row = 2 * (SIZE[0] + 1) + 3
        mesh.GetPointsAttr().Set(vec3(points + sheet_points(time, SIZE)[row] - shift[row]), time)
    stage.Save()
    assert f"--bind {BUTTON} carries it along" in run("inspect", path).output
    assert "carries" not in run("inspect", path, "--bind", BUTTON).output


def test_the_command_of_inspect_keeps_what_is_bound(shot: Path):
    stage = Usd.Stage.Open(str(shot))
    stage.GetPrimAtPath(CLOTH).RemoveProperty(TARGETS)
    beside(stage, "/World/body", (3.0, 2.0, -2.0), radius=2.0)
    stage.Save()
    given = {"bind": [BUTTON], "frames": (1.0, 2.5), "level": -1, "rest_frame": 1.0, "overrides": ["detail=2"]}
    _, found, words = inspect_shot(shot, **given)["command"].partition(" --frames ")
    assert found
    assert words == f"1:2.5 --collider /World/body --bind {BUTTON} --level auto --set detail=2 --rest 1"


def spread(stage: Usd.Stage) -> None:
    beside(stage, "/World/far", (3.0, 2.0, 9.0))
    bind(stage, "/World/far")


def twice(stage: Usd.Stage) -> None:
    bind(stage, BEADS, to=BUTTON)


def changing(stage: Usd.Stage) -> None:
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(BUTTON))
    points = np.asarray(mesh.GetPointsAttr().Get())
    mesh.GetPointsAttr().Set(vec3(points), 1.0)
    mesh.GetPointsAttr().Set(vec3(points[:-1]), 2.0)


def cloth_itself(stage: Usd.Stage) -> None:
    bind(stage, CLOTH, to=BUTTON)


def missing(stage: Usd.Stage) -> None:
    bind(stage, "/World/nothing")


def odd_mode(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(BUTTON).CreateAttribute("physgraph:bind:mode", Sdf.ValueTypeNames.Token).Set("glue")


def not_finite(stage: Usd.Stage) -> None:
    points = np.array(UsdGeom.Points(stage.GetPrimAtPath(BEADS)).GetPointsAttr().Get())
    points[1] = np.nan
    UsdGeom.Points(stage.GetPrimAtPath(BEADS)).GetPointsAttr().Set(vec3(points))


def empty(stage: Usd.Stage) -> None:
    UsdGeom.Points(stage.GetPrimAtPath(BEADS)).GetPointsAttr().Set(Vt.Vec3fArray())


@pytest.mark.parametrize(
    ("broken", "kind", "words"),
    [
        (not_finite, GarmentError, f"<{BEADS}> at time code 1: point 1 is not finite"),
        (empty, GarmentError, f"<{BEADS}>: has no points"),
        (spread, GarmentError, "</World/far>: lies up to"),
        (twice, GarmentError, f"<{BEADS}>: is bound to <{CLOTH}> and to <{BUTTON}>"),
        (changing, GarmentError, f"<{BUTTON}> at time code 2: its topology changes"),
        (cloth_itself, GarmentError, f"<{CLOTH}>: is a garment, and bound to <{BUTTON}>"),
        (missing, AbsentError, "no prim at </World/nothing>"),
        (odd_mode, SchemaError, f"<{BUTTON}>.physgraph:bind:mode is 'glue'"),
    ],
)
def test_what_cannot_follow_is_named_before_anything_is_written(
    shot: Path, tmp_path: Path, broken: object, kind: type[Exception], words: str
):
    stage = Usd.Stage.Open(str(shot))
    assert callable(broken)
    broken(stage)
    stage.Save()
    with pytest.raises(kind, match=words.replace("(", r"\(")):
        refine(shot, tmp_path / "out.usda")
    assert only(tmp_path, "shot.usda")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_sample_keeps_thickness_area_and_buttons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The T-shirt's render mesh stands still in the shot; the middle of its faces lies on the refined cloth."""
    monkeypatch.setattr(trims, "FINE", 2)
    shot = write_stage(trims.build(), tmp_path / "trims.usdc")
    alone = {"contact": "off", "self_contact": "off"}
    report = refine(shot, tmp_path / "out.usdc", level=2, frames=(12.0, 13.0), **alone)
    assert 0.5 < report.estimate["layer_mb"] / ((tmp_path / "out.usdc").stat().st_size / 1e6) < 2.0
    assert [(each["path"], each["rigid_parts"]) for each in report.garments[0]["bound"]] == [
        ("/TrimsShot/Render", 0),
        ("/TrimsShot/Buttons", 5),
        ("/TrimsShot/Piping", 0),
    ]
    stage = open_over(shot, tmp_path / "out.usdc")
    skin = np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath("/TrimsShot/Render")).GetPointsAttr().Get(13.0), float)
    outer, inner = np.split(skin, 2)
    apart = np.linalg.norm(outer - inner, axis=1) / trims.THICKNESS
    assert np.quantile(np.abs(apart - 1.0), 0.99) < 0.05
    faces = np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath("/TrimsShot/Render")).GetFaceVertexIndicesAttr().Get())
    sheet = faces.reshape(-1, 4)[(faces.reshape(-1, 4) < len(outer)).all(axis=1)]
    middle = 0.5 * (outer + inner)
    a, b, c, d = middle[sheet].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(c - a, d - b), axis=1).sum() / 2
    points, triangles = cloth_at(stage, 13.0, "/TrimsShot/Shirt")
    corners = points[triangles]
    cloth = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(cloth, rel=0.03)
    buttons = UsdGeom.Mesh(stage.GetPrimAtPath("/TrimsShot/Buttons")).GetPointsAttr()
    codes = Usd.TimeCode.Default(), Usd.TimeCode(13.0)
    before, after = (np.split(np.asarray(buttons.Get(code), float), trims.BUTTONS) for code in codes)
    for first, then in zip(before, after, strict=True):
        assert np.linalg.norm(best_motion(first, then)(first) - then, axis=1).max() < 1e-5
