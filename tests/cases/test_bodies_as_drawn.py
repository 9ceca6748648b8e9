"""Cloth rests on the bodies that a renderer shows: each kind by its right value on a small stage of its own."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from meshes import mesh_of, quads_of
from pxr import Usd, UsdGeom
from shots import fine, refine
from stages import COLLIDER_API, add_mesh, author, new_stage, save, vec3

from physgraph_usd.errors import UsageError
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.colliders.mesh import MeshBody
from physgraph_usd.solver.colliders.pose import Pose
from physgraph_usd.solver.mesh.subdivide import ControlMesh
from physgraph_usd.usd.mesh.drawn import flatness
from physgraph_usd.usd.read.reader import open_shot

Faces = list[list[int]]
SKIRT, BODY = "/World/skirt", "/World/body"
RADIUS = 0.1


def tube(radius: float, low: float, high: float, *, around: int = 16, rows: int = 5) -> tuple[np.ndarray, Faces]:
    """An open tube of quads about y."""
    angle, heights = 2.0 * np.pi * np.arange(around) / around, np.linspace(low, high, rows)
    points = np.array([[radius * np.cos(a), y, radius * np.sin(a)] for y in heights for a in angle])
    return points, quads_of(around, rows, closed=True, turned=True).tolist()


def capped(radius: float, low: float, high: float) -> tuple[np.ndarray, Faces]:
    """A closed tube."""
    points, faces = tube(radius, low, high)
    return points, [*faces, [*range(16)], [*range(len(points) - 1, len(points) - 17, -1)]]


def floor(height: float, size: float = 1.0, cells: int = 4) -> tuple[np.ndarray, Faces]:
    """A level grid whose front is up."""
    ticks = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    points = np.array([[x, height, z] for z in ticks for x in ticks])
    return points, quads_of(cells + 1, cells + 1, turned=True).tolist()


def spline(count: int, *, parts: int) -> np.ndarray:
    """Weights of a closed cubic B-spline's control points at places between them, shape (count * parts, count)."""
    t = np.arange(parts) / parts
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=1) / 6.0
    rows = np.zeros((count, parts, count))
    for start in range(count):
        rows[start][:, (start + np.arange(-1, 3)) % count] = weights
    return rows.reshape(-1, count)


def add(stage: Usd.Stage, path: str, shape: tuple[np.ndarray, Faces], *, scheme: str = "none") -> UsdGeom.Mesh:
    """A mesh that stands still."""
    return add_mesh(stage, path, *shape, schema=None, scheme=scheme)


def add_moving(stage: Usd.Stage, path: str, shape: tuple[np.ndarray, Faces], *samples: np.ndarray) -> UsdGeom.Mesh:
    """A mesh with samples at time codes 1, 2, ..."""
    mesh = add(stage, path, shape)
    for time, points in enumerate(samples, 1):
        mesh.GetPointsAttr().Set(vec3(points), time)
    return mesh


def pressed(points: np.ndarray, by: float) -> np.ndarray:
    """A tube pressed in along x and out along z by a fraction."""
    return points * np.array([1.0 - by, 1.0, 1.0 + by])


def skirt_stage(path: Path, by: float) -> Usd.Stage:
    """A skirt that is 4 mm off a body of `RADIUS` in its first sample, and pressed in by a fraction in its second."""
    made = new_stage(path)
    points, faces = tube(1.04 * RADIUS, 0.0, 0.2, around=24, rows=6)
    add_moving(made, SKIRT, (points, faces), points, pressed(points, by))
    return made


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    """Pressed in, the skirt is 4 mm inside a body of `RADIUS`."""
    return skirt_stage(tmp_path / "shot.usda", 0.08)


def felt(stage: Usd.Stage, *colliders: str, time: float = 1.0, **options) -> tuple[list[str], list[Pose | None], str]:
    """Colliders of a shot, their poses, and its warnings."""
    with closing(open_shot(save(stage), garments=[SKIRT], colliders=colliders, **options)) as shot:
        poses = shot.frame(time).colliders
        return [each.path for each in shot.scene.colliders], list(poses), "\n".join(map(str, shot.warnings))


def refined(stage: Usd.Stage, folder: Path, *, level: int, time: float) -> np.ndarray:
    """Points of the skirt over `BODY` at a time code [m]."""
    shot, out = Path(save(stage)), folder / "fine.usdc"
    refine(shot, out, garments=[SKIRT], colliders=[BODY], level=level, frames=(time, time))
    return fine(shot, out, time, prim=SKIRT)


class TestPurpose:
    @pytest.fixture(autouse=True)
    def character(self, stage: Usd.Stage) -> None:
        for purpose, radius in (("render", 0.1), ("proxy", 0.13), ("guide", 0.16)):
            add(stage, f"/World/char/{purpose}", capped(radius, -0.1, 0.3)).CreatePurposeAttr(purpose)

    @pytest.mark.parametrize("named", ["/World/cha*", "auto"])
    def test_below_a_prim_what_a_final_render_shows_is_felt(self, stage: Usd.Stage, tmp_path: Path, named: str):
        report = refine(Path(save(stage)), tmp_path / "a.usdc", garments=[SKIRT], colliders=[named], dry_run=True)
        assert report.garments[0]["colliders"] == ["/World/char/render"]

    def test_a_proxy_is_felt_and_said_where_nothing_else_is_there(self, stage: Usd.Stage):
        stage.RemovePrim("/World/char/render")
        stage.RemovePrim("/World/char/guide")
        paths, _, warnings = felt(stage, "/World/char")
        assert paths == ["/World/char/proxy"]
        assert "</World/char/proxy>: no final render shows it, a proxy" in warnings


class TestSmoothBodies:
    """A torus of quads, each corner of which has four: its limit surface is a bicubic B-spline."""

    COUNT, SHAPE = (6, 5), (0.3, 0.1)

    def torus(self) -> tuple[np.ndarray, Faces]:
        u, v = np.meshgrid(*(2.0 * np.pi * np.arange(count) / count for count in self.COUNT), indexing="ij")
        ring = self.SHAPE[0] + self.SHAPE[1] * np.cos(v)
        points = np.stack([ring * np.cos(u), self.SHAPE[1] * np.sin(v), ring * np.sin(u)], axis=-1)
        ids = np.arange(u.size).reshape(self.COUNT)
        turns = [np.roll(ids, shift, axis=(0, 1)) for shift in ((0, 0), (-1, 0), (-1, -1), (0, -1))]
        return points.reshape(-1, 3), np.stack(turns, axis=-1).reshape(-1, 4).tolist()

    def test_a_body_is_felt_where_catmull_clark_draws_it(self, stage: Usd.Stage):
        cage, faces = self.torus()
        add(stage, BODY, (cage, faces), scheme="catmullClark")
        _, (pose,), warnings = felt(stage, BODY)
        assert pose is not None
        assert warnings == ""
        around, along = (spline(count, parts=8) for count in self.COUNT)
        drawn = np.einsum("ua,vb,abd->uvd", around, along, cage.reshape(*self.COUNT, 3)).reshape(-1, 3)
        (surface,) = MeshBody(device="cpu", threads=1).pose(pose)
        x = torch.as_tensor(drawn - surface.origin)
        away = surface.closest(x, torch.full_like(x[:, 0], np.inf)).distance.numpy()
        assert np.quantile(away, 0.95) < 2e-4  # A tenth of the contact offset.
        assert away.max() < 5e-4

    def test_creases_and_corners_stay(self, stage: Usd.Stage):
        """A tube with caps whose rims are creases for ever, and one of whose rims' points is a corner."""
        points, faces = capped(RADIUS, -0.1, 0.3)
        mesh = add(stage, BODY, (points, faces), scheme="catmullClark")
        rims = [[*range(16), 0], [*range(len(points) - 16, len(points)), len(points) - 16]]
        mesh.CreateCreaseIndicesAttr([*rims[0], *rims[1]])
        mesh.CreateCreaseLengthsAttr([17, 17])
        mesh.CreateCreaseSharpnessesAttr([10.0, 10.0])
        mesh.CreateCornerIndicesAttr([0])
        mesh.CreateCornerSharpnessesAttr([10.0])
        _, (pose,), _ = felt(stage, BODY)
        assert pose is not None
        used = pose.points[np.unique(pose.triangles)]
        assert (used[:, 1].min(), used[:, 1].max()) == pytest.approx((-0.1, 0.3), abs=1e-6)
        assert np.linalg.norm(used - points[0], axis=1).min() < 1e-6


def test_faces_in_holes_are_not_there(stage: Usd.Stage):
    """A body in a wider shell, all of which is a hole."""
    inner, outer = capped(RADIUS, -0.1, 0.3), capped(1.3 * RADIUS, -0.1, 0.3)
    faces = inner[1] + [[corner + len(inner[0]) for corner in face] for face in outer[1]]
    mesh = add(stage, BODY, (np.concatenate([inner[0], outer[0]]), faces))
    mesh.CreateHoleIndicesAttr([*range(len(inner[1]), len(faces))])
    for scheme in ("none", "catmullClark"):
        mesh.CreateSubdivisionSchemeAttr().Set(scheme)
        _, (pose,), _ = felt(stage, BODY)
        assert pose is not None
        assert np.hypot(*pose.points[np.unique(pose.triangles)][:, [0, 2]].T).max() < 1.01 * RADIUS


class TestVisibility:
    @pytest.fixture(autouse=True)
    def body(self, stage: Usd.Stage) -> None:
        """A body that is hidden in the second sample."""
        visible = add(stage, BODY, capped(RADIUS, -0.1, 0.3)).CreateVisibilityAttr()
        visible.Set("inherited", 1.0)
        visible.Set("invisible", 2.0)

    def test_a_body_counts_where_it_is_visible(self, stage: Usd.Stage):
        assert felt(stage, BODY)[1] != [None]
        _, poses, warnings = felt(stage, BODY, time=2.0)
        assert poses == [None]
        assert f"<{BODY}>: no collider where it is invisible, unless physgraph:collider:enabled is set" in warnings

    @pytest.mark.parametrize("how", ["authored", "--set"])
    def test_enabled_goes_before_visibility(self, stage: Usd.Stage, how: str):
        if how == "authored":
            author(stage.GetPrimAtPath(BODY), "physgraph:collider:enabled", True, kind="bool")
        overrides = [] if how == "authored" else [f"<{BODY}>.collider:enabled=on"]
        assert felt(stage, BODY, time=2.0, overrides=overrides)[1] != [None]

    def test_a_disabled_body_that_is_named_is_left_out_and_said(self, stage: Usd.Stage):
        author(stage.GetPrimAtPath("/World"), "physgraph:collider:enabled", False, kind="bool")
        paths, _, warnings = felt(stage, BODY)
        assert paths == []
        assert f"<{BODY}>: no collider, for physgraph:collider:enabled is off, by </World>." in warnings


class TestOpenBodies:
    def test_without_its_hidden_faces_a_body_is_solid(self, stage: Usd.Stage, tmp_path: Path):
        add(stage, BODY, tube(RADIUS, -0.1, 0.3, around=32, rows=9))
        found = refined(stage, tmp_path, level=1, time=2.0)
        assert np.hypot(found[:, 0], found[:, 2]).min() > 0.995 * RADIUS  # Between corners 32 sides are a 200th inside.

    @pytest.mark.parametrize("front", ["up", "down"])
    def test_a_floor_has_one_side_whichever_way_its_faces_look(self, stage: Usd.Stage, tmp_path: Path, front: str):
        points, faces = floor(0.01)
        add(stage, BODY, (points, faces if front == "up" else [face[::-1] for face in faces]))
        assert refined(stage, tmp_path, level=0, time=1.0)[:, 1].min() > 0.01


class TestAuto:
    """Beside the skirt: its body, its own render mesh, a button on it, a copy of the body, a crate far away."""

    @pytest.fixture(autouse=True)
    def meshes(self, stage: Usd.Stage) -> None:
        add(stage, BODY, tube(RADIUS, -0.1, 0.3, around=32, rows=9))
        points, faces = tube(1.04 * RADIUS, 0.0, 0.2, around=24, rows=6)
        shell = np.concatenate([points * [r, 1.0, r] for r in (0.985, 1.015)])
        both = [*faces, *([corner + len(points) for corner in face[::-1]] for face in faces)]
        add_moving(stage, "/World/render", (shell, both), shell, pressed(shell, 0.08))
        button, sides = capped(0.006, 0.0015, 0.0045)
        button = button[:, [1, 0, 2]] + [1.04 * RADIUS, 0.1, 0.0]
        add_moving(stage, "/World/button", (button, sides), button, button - [0.08 * 1.04 * RADIUS, 0.0, 0.0])
        add(stage, "/World/guide", capped(1.2 * RADIUS, -0.1, 0.3)).CreatePurposeAttr("guide")
        add(stage, "/World/hidden", capped(RADIUS, -0.2, 0.3)).CreateVisibilityAttr("invisible")
        crate, sides = capped(0.5, 0.0, 1.0)
        add(stage, "/World/crate", (crate + np.array([9.0, 0.0, 0.0]), sides))

    def test_inspect_says_why_each_is_taken_or_left(self, stage: Usd.Stage):
        found = inspect_shot(save(stage), garments=(SKIRT,))
        assert found["candidates"] == {
            BODY: f"taken: 100% of <{SKIRT}> is inside or within 25 mm at time code 1",
            "/World/render": f"left: it lies on <{SKIRT}> and moves with it: a trim, or the garment's own skin",
            "/World/button": f"left: it lies on <{SKIRT}> and moves with it: a trim, or the garment's own skin",
            "/World/guide": "left: a guide, which no final render shows",
            "/World/hidden": "left: invisible",
        }
        assert found["command"].endswith(f"--collider {BODY}")


class TestSet:
    @pytest.fixture(autouse=True)
    def body(self, stage: Usd.Stage) -> None:
        add(stage, BODY, capped(RADIUS, -0.1, 0.3)).GetPrim().AddAppliedSchema(COLLIDER_API)

    def test_it_takes_a_colliders_attributes(self, stage: Usd.Stage):
        overrides = [f"<{BODY}>.collider:offset=0.003", "physgraph:collider:side=start"]
        with closing(open_shot(save(stage), garments=[SKIRT], overrides=overrides)) as shot:
            (collider,) = shot.scene.colliders
        assert (collider.offset, collider.side) == (0.003, "start")
        assert felt(stage, overrides=["collider:enabled=off"])[0] == []

    def test_one_for_no_collider_is_refused_by_name(self, stage: Usd.Stage):
        with pytest.raises(UsageError, match=f"no such collider; colliders: {BODY}"):
            felt(stage, overrides=["</World/other>.collider:offset=0.003"])


class TestPolygons:
    """A body whose limit surface has `RADIUS` and whose corners stand 4.7 mm outside, under a skirt that lies on it."""

    AROUND = 12

    def notes(self, stage: Usd.Stage, folder: Path, *options: str) -> tuple[list[str], float]:
        """Notes of viewports, and by how much the body's polygons stand above the skirt at its rows [m]."""
        shot, out = Path(save(stage)), folder / "fine.usdc"
        how = {"garments": [SKIRT], "colliders": [BODY], "frames": (2.0, 2.0), "overrides": options, "level": 2}
        report = refine(shot, out, overwrite=True, **how)
        cloth = fine(shot, out, 2.0, prim=SKIRT)
        turn = 2.0 * np.pi / self.AROUND
        angle = np.mod(np.arctan2(cloth[:, 2], cloth[:, 0]), turn) - 0.5 * turn
        corners = float(
            np.linalg.norm(np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath(BODY)).GetPointsAttr().Get())[0, ::2])
        )
        above = corners * np.cos(0.5 * turn) / np.cos(angle) - np.linalg.norm(cloth[:, ::2], axis=1)
        return [note for note in report.notes if "viewports" in note], float(above.max())

    def body(self, stage: Usd.Stage, scheme: str, around: int = AROUND) -> None:
        outside = 3.0 / (2.0 + np.cos(2.0 * np.pi / around)) if scheme != "none" else 1.0
        add(stage, BODY, tube(outside * RADIUS, -0.1, 0.3, around=around, rows=9), scheme=scheme)

    def test_that_show_through_are_told_once_with_an_offset_that_hides_them(self, stage: Usd.Stage, tmp_path: Path):
        self.body(stage, "catmullClark")
        (note,), above = self.notes(stage, tmp_path)
        height = float(note.partition("by up to ")[2].partition(" mm")[0])
        assert note.startswith(f"viewports that draw <{BODY}> unsubdivided show it through <{SKIRT}> by up to ")
        assert height == pytest.approx(1e3 * above, rel=0.15)
        option, _, rest = note.partition("--set ")[2].partition(" ")
        assert rest == "hides it"
        notes, above = self.notes(stage, tmp_path, option)
        assert notes == []
        assert above < 2e-4

    @pytest.mark.parametrize(("scheme", "around"), [("none", AROUND), ("catmullClark", 32)])
    def test_that_stay_below_the_cloth_are_not_told(self, stage: Usd.Stage, tmp_path: Path, scheme: str, around: int):
        self.body(stage, scheme, around)
        assert self.notes(stage, tmp_path)[0] == []


def test_points_that_a_broken_skeleton_throws_away_have_no_flatness():
    points, faces = capped(RADIUS, 0.0, 0.2)
    mesh = mesh_of(faces, len(points))
    cage = ControlMesh(mesh, np.zeros((0, 2), np.int32), np.zeros(0))
    near = flatness(cage, points)
    points[0] = 1e300
    assert flatness(cage, points) == pytest.approx(near, rel=0.5)
