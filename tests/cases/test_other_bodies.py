"""Bodies that are not a mesh in its place, each by its right value on a small stage of its own."""

from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layers import errors, open_over, world_metres
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from shots import fine, refine
from stages import GARMENT_API, add_mesh, add_sheet, new_stage, said, save, vec3
from test_bodies_as_drawn import BODY, RADIUS, SKIRT, add, add_moving, capped, floor, skirt_stage, tube

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.usd.mesh.bind import closest
from physgraph_usd.usd.read.reader import open_shot

BALLS, PROTOTYPE = "/World/balls", "/World/balls/protos/ball"
SMALL = 0.05


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    return skirt_stage(tmp_path / "shot.usda", 0.02)


def instancer(
    stage: Usd.Stage, places: ArrayLike, path: str = BALLS, *, radius: float = SMALL
) -> UsdGeom.PointInstancer:
    """Balls at some places; the prototype's own place is the origin."""
    made = UsdGeom.PointInstancer.Define(stage, path)
    ball = UsdGeom.Sphere.Define(stage, f"{path}/protos/ball")
    ball.CreateRadiusAttr(radius)
    made.CreatePrototypesRel().SetTargets([ball.GetPath()])
    made.CreatePositionsAttr(vec3(np.asarray(places)))
    made.CreateProtoIndicesAttr([0] * len(np.asarray(places)))
    return made


def posed(stage: Usd.Stage, *colliders: str, time: float = 1.0, garment: str = SKIRT) -> tuple[list[Any], str]:
    """Points of each collider at a time code [m], or None, and warnings."""
    with closing(open_shot(save(stage), garments=[garment], colliders=colliders)) as shot:
        poses = shot.frame(time).colliders
        return [None if pose is None else pose.points for pose in poses], said(shot)


def middles(points: np.ndarray, count: int) -> np.ndarray:
    """Middle of each of some balls with as many points, shape (count, 3)."""
    split = points.reshape(count, -1, 3)
    return 0.5 * (split.min(axis=1) + split.max(axis=1))


class TestInstances:
    PLACES = np.array([[0.1, 0.05, 0.0], [-0.1, 0.15, 0.0]])

    @pytest.mark.parametrize("named", [BALLS, PROTOTYPE, "/World", "/World/balls/*"])
    def test_instances_are_felt_and_the_prototype_s_own_place_is_not(self, stage: Usd.Stage, named: str):
        instancer(stage, self.PLACES)
        (points,), warnings = posed(stage, named)
        assert np.allclose(middles(points, 2), self.PLACES, atol=1e-6)
        away = np.linalg.norm(points.reshape(2, -1, 3) - self.PLACES[:, None], axis=2)
        assert away.min() > 0.99 * SMALL
        assert away.max() < 1.0001 * SMALL
        assert not warnings

    def test_cloth_rests_on_every_instance(self, tmp_path: Path):
        made, places = new_stage(tmp_path / "shot.usda"), np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
        cells, faces = floor(0.045, 0.16, 8)
        both = np.concatenate([cells, cells + np.array([0.4, 0.0, 0.0])])
        add_moving(made, SKIRT, (both, [*faces, *([k + len(cells) for k in face] for face in faces)]), both)
        instancer(made, places)
        shot, out = Path(save(made)), tmp_path / "fine.usdc"
        refine(shot, out, garments=[SKIRT], colliders=[BALLS], level=1, steps=40)
        x = fine(shot, out, 1.0, prim=SKIRT)
        assert min(np.linalg.norm(x - place, axis=1).min() for place in places) > SMALL + 1e-3

    def test_turned_scaled_moving_and_nested_instances_are_where_usd_puts_them(self, stage: Usd.Stage):
        """An instancer of an instancer, whose prototype is moved, below a transform."""
        UsdGeom.Xform.Define(stage, "/World/set")
        inner = instancer(stage, [[0.01, 0.0, 0.0], [0.0, 0.02, 0.0]], "/World/set/inner", radius=0.01)
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World/set/inner/protos/ball")).SetTranslate((0.0, 0.0, 0.005))
        inner.CreateScalesAttr([(2, 2, 2), (1, 1, 3)])
        outer = UsdGeom.PointInstancer.Define(stage, "/World/set/outer")
        outer.CreatePrototypesRel().SetTargets([inner.GetPath()])
        outer.CreateProtoIndicesAttr([0, 0])
        for time in (1.0, 2.0):
            outer.CreatePositionsAttr().Set(vec3(np.array([[0.1, 0.02 * time, 0.0], [-0.1, 0.1, 0.0]])), time)
        outer.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0), Gf.Quath(0, 0, 0, 1)])
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World/set")).SetTranslate((0.0, 0.05, 0.0))
        (points,), _ = posed(stage, "/World/set/outer", time=2.0)
        box = UsdGeom.BBoxCache(2.0, [UsdGeom.Tokens.default_]).ComputeWorldBound(outer.GetPrim())
        found = box.ComputeAlignedRange()
        assert np.allclose(points.min(axis=0), np.array(found.GetMin()), atol=2e-4)
        assert np.allclose(points.max(axis=0), np.array(found.GetMax()), atol=2e-4)
        ends = np.array([[0.11, 0.09, 0.01], [0.1, 0.11, 0.015], [-0.11, 0.15, 0.01], [-0.1, 0.13, 0.015]])
        assert np.allclose(middles(points, 4), ends, atol=1e-5)

    def test_instances_of_an_instanced_set_stand_where_the_set_does(self, stage: Usd.Stage):
        stage.CreateClassPrim("/Set")
        rocks = instancer(stage, self.PLACES - [0.5, 0.0, 0.0], "/Set/rocks")
        rocks.GetPrim().SetSpecifier(Sdf.SpecifierDef)
        copy = UsdGeom.Xform.Define(stage, "/World/set")
        copy.GetPrim().GetReferences().AddInternalReference("/Set")
        copy.GetPrim().SetInstanceable(True)
        UsdGeom.XformCommonAPI(copy).SetTranslate((0.5, 0.0, 0.0))
        (points,), _ = posed(stage, "/World/set")
        assert np.allclose(middles(points, 2), self.PLACES, atol=1e-6)

    @pytest.mark.parametrize("hide", ["ids", "inactive", "scale", "prototype"])
    def test_hidden_instances_are_not_felt(self, stage: Usd.Stage, hide: str):
        made = instancer(stage, self.PLACES)
        if hide == "ids":
            made.CreateIdsAttr(Vt.Int64Array([7, 8]))
            made.CreateInvisibleIdsAttr(Vt.Int64Array([7]))
        elif hide == "inactive":
            made.DeactivateId(0)
        elif hide == "scale":
            made.CreateScalesAttr([(0, 0, 0), (1, 1, 1)])
        else:
            other = UsdGeom.Sphere.Define(stage, f"{BALLS}/protos/other")
            UsdGeom.Imageable(other).MakeInvisible()
            made.GetPrototypesRel().AddTarget(other.GetPath())
            made.GetProtoIndicesAttr().Set([1, 0])
        (points,), _ = posed(stage, BALLS)
        assert np.allclose(middles(points, 1), self.PLACES[1:], atol=1e-6)

    def test_far_instances_are_left_out_and_so_are_shapes_that_are_not_read(self, stage: Usd.Stage):
        made = instancer(stage, [*self.PLACES, [50.0, 0.0, 0.0]])
        UsdGeom.BasisCurves.Define(stage, f"{BALLS}/protos/hair")
        made.GetPrototypesRel().AddTarget(f"{BALLS}/protos/hair")
        (points,), warnings = posed(stage, BALLS)
        assert np.allclose(middles(points, 2), self.PLACES, atol=1e-6)
        assert f"<{BALLS}>: instances of <{BALLS}/protos/hair> are left out: a BasisCurves" in warnings

    def test_arrays_that_do_not_fit_are_named(self, stage: Usd.Stage):
        instancer(stage, self.PLACES).GetProtoIndicesAttr().Set([0, 0, 0])
        assert posed(stage, BALLS)[0] == [None]
        assert (
            f"<{BALLS}> at time code 1: this collider is left out here: arrays of <{BALLS}> do not"
            in posed(stage, BALLS)[1]
        )

    def test_a_dressed_prototype_meets_its_body_in_its_own_place(self, tmp_path: Path):
        made = new_stage(tmp_path / "shot.usda")
        crowd = UsdGeom.PointInstancer.Define(made, "/World/crowd")
        crowd.CreatePrototypesRel().SetTargets(["/World/crowd/one"])
        crowd.CreatePositionsAttr([(1, 0, 0)])
        crowd.CreateProtoIndicesAttr([0])
        add(made, "/World/crowd/one/coat", tube(1.04 * RADIUS, 0.0, 0.2)).GetPrim().AddAppliedSchema(GARMENT_API)
        add(made, "/World/crowd/one/body", capped(RADIUS, -0.1, 0.3))
        (points,), _ = posed(made, "/World/crowd/one/body", garment="/World/crowd/one/coat")
        assert np.allclose(points.mean(axis=0)[[0, 2]], 0.0, atol=1e-6)


class TestTapered:
    @pytest.mark.parametrize(("kind", "ends"), [("Cylinder_1", 0.1), ("Capsule_1", 0.1)])
    def test_radii_at_both_ends_are_felt(self, stage: Usd.Stage, kind: str, ends: float):
        prim = stage.DefinePrim(BODY, kind)
        for name, value in (("radiusTop", 0.02), ("radiusBottom", 0.06), ("height", 2 * ends)):
            prim.GetAttribute(name).Set(value)
        prim.GetAttribute("axis").Set("Y")
        (points,), _ = posed(stage, BODY)
        radius, y = np.hypot(points[:, 0], points[:, 2]), points[:, 1]
        assert radius[np.isclose(y, ends)].max() == pytest.approx(0.02)
        assert radius[np.isclose(y, -ends)].max() == pytest.approx(0.06)
        caps = (0.02, 0.06) if kind == "Capsule_1" else (0.0, 0.0)
        assert [y.max(), y.min()] == pytest.approx([ends + caps[0], -ends - caps[1]])

    def test_an_end_of_radius_0_is_a_tip(self, stage: Usd.Stage):
        prim = stage.DefinePrim(BODY, "Cylinder_1")
        prim.GetAttribute("radiusTop").Set(0.0)
        (cylinder,), _ = posed(stage, BODY)
        stage.RemovePrim(BODY)
        UsdGeom.Cone.Define(stage, BODY)
        (cone,), _ = posed(stage, BODY)
        assert np.array_equal(cylinder, cone)


def nurbs(stage: Usd.Stage, path: str, height: float) -> None:
    patch = UsdGeom.NurbsPatch.Define(stage, path)
    points, _ = floor(height, 0.5, 3)
    patch.CreatePointsAttr(vec3(points))
    for make in (patch.CreateUVertexCountAttr, patch.CreateVVertexCountAttr):
        make(4)
    for make in (patch.CreateUOrderAttr, patch.CreateVOrderAttr):
        make(4)
    for make in (patch.CreateUKnotsAttr, patch.CreateVKnotsAttr):
        make([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0])


def hanging(stage: Usd.Stage, path: str, height: float) -> None:
    curves = UsdGeom.BasisCurves.Define(stage, path)
    curves.CreateCurveVertexCountsAttr([4])
    curves.CreatePointsAttr(vec3(np.array([[x, height, 0.0] for x in (-0.2, -0.1, 0.1, 0.2)])))


class TestTetrahedra:
    """A TetMesh is its surface."""

    @staticmethod
    def flesh(stage: Usd.Stage, *, surface: bool) -> tuple[UsdGeom.TetMesh, np.ndarray]:
        """A closed tube filled with tetrahedra to its middle, with its surface authored or not, and its points."""
        points, faces = capped(RADIUS, -0.1, 0.3)
        triangles = np.array([[face[0], *pair] for face in faces for pair in pairwise(face[1:])])
        tets = np.column_stack([triangles, np.full(len(triangles), len(points))])
        mesh = UsdGeom.TetMesh.Define(stage, BODY)
        mesh.CreatePointsAttr(vec3(np.vstack([points, [[0.0, 0.1, 0.0]]])))
        mesh.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(tets.astype(np.int32)))
        if surface:
            mesh.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(triangles.astype(np.int32)))
        return mesh, points

    @pytest.mark.parametrize("surface", [True, False])
    def test_cloth_rests_on_their_surface(self, stage: Usd.Stage, surface: bool, tmp_path: Path):
        """The skirt is pressed into a body of 1.06 times its usual radius."""
        mesh, _ = self.flesh(stage, surface=surface)
        UsdGeom.XformCommonAPI(mesh).SetScale((1.06, 1.0, 1.06))
        assert inspect_shot(save(stage), garments=[SKIRT])["candidates"][BODY].startswith("taken")
        shot = Path(save(stage))
        refine(shot, tmp_path / "fine.usdc", garments=[SKIRT], colliders=[BODY])
        points = fine(shot, tmp_path / "fine.usdc", 2.0, prim=SKIRT)
        assert np.hypot(points[:, 0], points[:, 2]).min() > 1.06 * RADIUS * np.cos(np.pi / 16)

    def test_their_points_move(self, stage: Usd.Stage):
        mesh, points = self.flesh(stage, surface=False)
        moved = np.vstack([points, [[0.0, 0.1, 0.0]]]) + np.array([0.0, 0.02, 0.0])
        mesh.GetPointsAttr().Set(vec3(moved), 2.0)
        (found,), said_of_it = posed(stage, BODY, time=2.0)
        assert np.allclose(found, moved, atol=1e-6)
        assert "not read" not in said_of_it

    def test_tetrahedra_beyond_the_points_are_named(self, stage: Usd.Stage):
        mesh, _ = self.flesh(stage, surface=False)
        mesh.GetTetVertexIndicesAttr().Set([Gf.Vec4i(0, 1, 2, 900)])
        assert posed(stage, BODY)[0] == [None]
        assert f"<{BODY}> at time code 1: this collider is left out here: its points and faces" in posed(stage, BODY)[1]


class TestUnread:
    """Shapes that USD draws and that are not read."""

    @pytest.mark.parametrize(("add_shape", "kind"), [(nurbs, "NurbsPatch"), (hanging, "BasisCurves")])
    def test_they_are_named_with_a_remedy_wherever_cloth_may_touch_them(self, stage: Usd.Stage, add_shape, kind: str):
        add_shape(stage, BODY, 0.1)
        add_shape(stage, "/World/far", 3.0)
        found = inspect_shot(save(stage), garments=[SKIRT], colliders=["auto"])
        (warning,) = [line for line in found["warnings"] if "not read" in line]
        assert f"<{BODY}> ({kind}) may touch cloth and is not read; convert it to a Mesh" in warning
        assert found["candidates"] == {BODY: "left: its shape is not read: convert it to a Mesh"}
        assert (
            f"<{BODY}>: a {kind} is no collider that cloth can rest on: convert it to a Mesh" in posed(stage, BODY)[1]
        )


class TestSearch:
    """What `auto` takes and `inspect` names."""

    @staticmethod
    def taken(stage: Usd.Stage) -> list[str]:
        found = inspect_shot(save(stage), garments=[SKIRT])
        return [path for path, why in found["candidates"].items() if why.startswith("taken")]

    def test_bodies_of_every_kind_are_found(self, stage: Usd.Stage):
        for kind in ("Sphere", "Capsule", "Cylinder_1", "Cone", "Cube"):
            prim = stage.DefinePrim(f"/World/{kind}", kind)
            UsdGeom.XformCommonAPI(prim).SetScale((0.05, 0.05, 0.05))
            UsdGeom.XformCommonAPI(prim).SetTranslate((0.14, 0.1, 0.0))
        instancer(stage, [[-0.14, 0.1, 0.0]])
        far = UsdGeom.Sphere.Define(stage, "/World/far")
        UsdGeom.XformCommonAPI(far).SetTranslate((5.0, 0.0, 0.0))
        found = {"/World/Sphere", "/World/Capsule", "/World/Cylinder_1", "/World/Cone", "/World/Cube", BALLS}
        assert {*self.taken(stage)} == found

    def test_a_hand_that_touches_in_one_of_many_frames_is_found(self, tmp_path: Path):
        made = new_stage(tmp_path / "shot.usda")
        points, faces = tube(1.04 * RADIUS, 0.0, 0.2)
        add_moving(made, SKIRT, (points, faces), *(points + np.array([0.0, 1e-4 * k, 0.0]) for k in range(40)))
        hand = UsdGeom.Sphere.Define(made, "/World/hand")
        hand.CreateRadiusAttr(0.03)
        for time in range(1, 41):
            UsdGeom.XformCommonAPI(hand).SetTranslate((0.3 if time != 23 else 0.14, 0.1, 0.0), time)
        (path,) = self.taken(made)
        assert path == "/World/hand"
        assert "time code 23" in inspect_shot(save(made), garments=[SKIRT])["candidates"][path]

    @pytest.mark.parametrize("far", [0.0, 5.0])
    def test_authored_extents_are_not_believed(self, stage: Usd.Stage, far: float):
        """A body whose extent is far off, or a far body whose extent is at the cloth."""
        body = add(stage, BODY, capped(RADIUS, -0.1, 0.3))
        UsdGeom.XformCommonAPI(body).SetTranslate((far, 0.0, 0.0))
        wrong = np.array([[7.0, 7.0, 7.0], [8.0, 8.0, 8.0]]) if far == 0.0 else np.array([[-6.0, -1, -1], [6.0, 1, 1]])
        body.CreateExtentAttr(vec3(wrong))
        assert self.taken(stage) == ([BODY] if far == 0.0 else [])


def test_cloth_between_two_bodies_that_overlap_is_pinched_as_between_parts_of_one(tmp_path: Path):
    """A trouser leg round a thigh that is 8 mm deep in a seat: what has no room is pinched, and no more than before."""
    made, radius, deep = new_stage(tmp_path / "shot.usda"), 0.08, 0.008
    points, faces = tube(radius + 0.003, -0.1, 0.1, around=16, rows=5)
    add_moving(made, SKIRT, (points[:, [1, 0, 2]], [face[::-1] for face in faces]), points[:, [1, 0, 2]])
    thigh = UsdGeom.Cylinder.Define(made, "/World/thigh")
    thigh.CreateRadiusAttr(radius)
    thigh.CreateHeightAttr(0.6)
    thigh.CreateAxisAttr("X")
    seat = UsdGeom.Cube.Define(made, "/World/seat")
    seat.CreateSizeAttr(1.0)
    UsdGeom.XformCommonAPI(seat).SetScale((0.5, 0.1, 0.5))
    UsdGeom.XformCommonAPI(seat).SetTranslate((0.0, deep - radius - 0.05, 0.0))
    report = refine(
        Path(save(made)), tmp_path / "a.usdc", garments=[SKIRT], colliders=["/World/thigh", "/World/seat"], steps=20
    )
    told = report.frames[0]["garments"][0]["contact"]["bodies"]
    before, after = ({name: each[side] for name, each in told.items()} for side in ("before", "after"))
    assert before["/World/seat"]["pinched"] > 5
    assert sum(each["inside"] for each in after.values()) == 0
    assert sum(each["pinched"] for each in after.values()) <= sum(
        each["pinched"] + each["inside"] for each in before.values()
    )


class TestStones:
    """An instancer that hangs on cloth."""

    STONES, CLOTH, OFF = "/World/stones", "/World/cloth", 0.02

    @pytest.fixture
    def shot(self, tmp_path: Path) -> Usd.Stage:
        """Stones on the sheet, one above each inner vertex, that move with its vertices."""
        made = new_stage(tmp_path / "stones.usda", metres=0.05)
        sheet = add_sheet(made, self.CLOTH, times=(1.0, 2.0), size=(6, 4))
        which = np.arange(35).reshape(5, 7)[1:-1, 1:-1].ravel()
        stones = instancer(made, np.zeros((len(which), 3)), self.STONES, radius=0.01)
        stones.GetPositionsAttr().Clear()
        for time in (1.0, 2.0):
            points = np.asarray(sheet.GetPointsAttr().Get(time))
            stones.GetPositionsAttr().Set(vec3(points[which] + [0.0, 0.0, self.OFF]), time)
        stones.CreateOrientationsfAttr([Gf.Quatf(1, 0, 0, 0)] * len(which))
        return made

    def test_positions_and_orientations_follow(self, shot: Usd.Stage, tmp_path: Path):
        path, out = Path(save(shot)), tmp_path / "fine.usdc"
        refine(path, out, bind=[self.STONES])
        assert errors(out) == []
        over = open_over(path, out)
        stones = UsdGeom.PointInstancer(over.GetPrimAtPath(self.STONES))
        cloth = UsdGeom.Mesh(over.GetPrimAtPath(self.CLOTH))
        faces = np.asarray(cloth.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
        triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        turns, away = [], []
        for time in (1.0, 2.0):
            surface = world_metres(over, self.CLOTH, time)
            found = closest(0.05 * np.asarray(stones.GetPositionsAttr().Get(time), float), surface, triangles)
            away.append(found.distance)
            a, b, c = surface[triangles[found.triangle]].swapaxes(0, 1)
            normal = np.cross(b - a, c - a)
            normal /= np.linalg.norm(normal, axis=1)[:, None]
            spins = stones.GetOrientationsfAttr().Get(time)
            turns.append((np.array([Gf.Rotation(Gf.Quatd(each)).TransformDir((0, 0, 1)) for each in spins]), normal))
        assert np.abs(away[1] - away[0]).max() < 3e-4
        # From the bind pose on, the stones turn as the cloth does.
        (first, normal), (last, later) = turns
        moved = np.einsum("nx,nx->n", normal, later)
        assert moved.min() < 0.99
        assert np.abs(np.einsum("nx,nx->n", first, last) - moved).max() < 0.05

    def test_inspect_proposes_to_bind_them(self, shot: Usd.Stage):
        found = inspect_shot(save(shot))
        assert any(f"--bind {self.STONES} carries it along" in note for note in found["notes"])
        assert not any("does not feel" in line for line in found["warnings"])

    def test_instances_that_change_in_number_are_refused(self, shot: Usd.Stage, tmp_path: Path):
        stones = UsdGeom.PointInstancer(shot.GetPrimAtPath(self.STONES))
        stones.GetPositionsAttr().Set([(1.0, 1.0, 0.0)], 2.0)
        with pytest.raises(Exception, match=r"/World/stones.*its topology changes"):
            refine(Path(save(shot)), tmp_path / "a.usdc", bind=[self.STONES])

    def test_stones_on_still_cloth_follow_by_default(self, tmp_path: Path):
        made = new_stage(tmp_path / "still.usda", metres=0.05)
        points = np.array([[x, y, 0.3 * np.sin(x)] for y in range(4) for x in range(5)], np.float32)
        faces = [[a, a + 1, a + 6, a + 5] for row in range(3) for a in range(5 * row, 5 * row + 4)]
        add_mesh(made, self.CLOTH, points, faces)
        instancer(made, points[6:9] + np.array([0.0, 0.0, 0.02]), self.STONES, radius=0.01)
        path, out = Path(save(made)), tmp_path / "fine.usdc"
        refine(path, out, bind=[self.STONES], steps=40)
        over = open_over(path, out)
        stones = UsdGeom.PointInstancer(over.GetPrimAtPath(self.STONES))
        moved = np.asarray(stones.GetPositionsAttr().Get()) - points[6:9] - [0.0, 0.0, 0.02]
        assert np.linalg.norm(moved, axis=1).max() > 1e-3
        assert len(stones.GetOrientationsAttr().Get()) == 3
