"""Seams stay closed and buttons stay buttons: each kind by its right value on a small stage of its own."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloth import settings_of
from layers import errors, open_over
from meshes import mesh_of, quads_of
from pxr import Sdf, Usd, UsdGeom, Vt
from scipy.spatial import cKDTree
from shots import faults, fine, refine
from stages import add_mesh, new_stage, save, vec3
from test_bodies_as_drawn import Faces, tube

from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.mesh.subdivide import compose, subdivide_times
from physgraph_usd.solver.mesh.weld import weld, weld_skins
from physgraph_usd.usd.read.reader import Shot, open_shot

FRAMES, LEVEL, SAME = 5, 1, 1e-6
Shape = tuple[np.ndarray, Faces]


def panel(x: float, width: float, columns: int, *, rows: int = 8, height: float = 0.24) -> Shape:
    """A sheet of quads in the plane of x and y, from x to the right [m]."""
    across, up = np.linspace(x, x + width, columns + 1), np.linspace(-height, 0.0, rows + 1)
    points = np.array([[a, b, 0.0] for b in up for a in across])
    return points, quads_of(columns + 1, rows + 1).tolist()


def together(*shapes: Shape) -> Shape:
    """Shapes as one mesh in pieces."""
    starts = np.cumsum([0, *(len(points) for points, _ in shapes)])
    moved = [
        [corner + int(start) for corner in face]
        for (_, faces), start in zip(shapes, starts, strict=False)
        for face in faces
    ]
    return np.concatenate([points for points, _ in shapes]), moved


def box(middle: np.ndarray, size: np.ndarray) -> Shape:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return middle + corners * size, faces


def refined(shape: Shape, points: np.ndarray | None = None) -> np.ndarray:
    """The points of a shape, or others of it, placed linearly at the level."""
    return compose(subdivide_times(mesh_of(shape[1], len(shape[0])), LEVEL)) @ (shape[0] if points is None else points)


def shortened(points: np.ndarray, time: int) -> np.ndarray:
    """Pressed together along x by 2% a frame, on a slight wave."""
    out = points * [1.0 - 0.02 * (time - 1), 1.0, 1.0]
    out[:, 2] += 0.002 * (time - 1) * np.sin(12.0 * points[:, 0] + 6.0 * points[:, 1])
    return out


def shot_of(folder: Path, **shapes: Shape) -> Path:
    """A shot of garments that are pressed together."""
    stage = new_stage(folder / "shot.usda")
    for name, (points, faces) in shapes.items():
        mesh = add_mesh(stage, f"/World/{name}", points, faces)
        for time in range(1, FRAMES + 1):
            mesh.GetPointsAttr().Set(vec3(shortened(points, time)), time)
    return Path(save(stage))


def thick_tube(turned: float = 0.0) -> Shape:
    """A tube 2 mm thick with rims at both ends; its inner skin's vertices lie turned by an angle."""
    (outer, sides), (inner, _) = tube(0.102, 0.0, 0.2), tube(0.1, 0.0, 0.2)
    cos, sin = np.cos(turned), np.sin(turned)
    count, around = len(outer), 16
    faces = [*sides, *([corner + count for corner in face[::-1]] for face in sides)]
    for row, turn in ((0, 1), (count - around, -1)):
        ring = [row + k for k in range(around)]
        quads = [
            [ring[k], ring[(k + 1) % around], ring[(k + 1) % around] + count, ring[k] + count] for k in range(around)
        ]
        faces += [quad[::turn] for quad in quads]
    return np.concatenate([outer, inner @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])]), faces


def widest_gap(shot: Path, layer: Path, shapes: dict[str, Shape], *, within: float = SAME) -> float:
    """How far fine points that lie together in the shapes are apart in any frame, at most [m]."""
    rest = np.concatenate([refined(each) for each in shapes.values()])
    pairs = cKDTree(rest).query_pairs(within, output_type="ndarray")
    assert len(pairs) > 4
    widest = 0.0
    for time in range(1, FRAMES + 1):
        points = np.concatenate([fine(shot, layer, time, prim=f"/World/{name}") for name in shapes])
        widest = max(widest, float(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1).max()))
    return widest


def warnings_of(shot: Path, **options: Any) -> str:
    with closing(open_shot(str(shot), **options)) as opened:
        return "; ".join(map(str, opened.warnings))


class TestWelded:
    """Open borders of one mesh at one place."""

    def test_a_mesh_cut_along_a_seam_is_the_whole_one(self, tmp_path: Path):
        whole = panel(-0.12, 0.24, 8)
        halves = together(panel(-0.12, 0.12, 4), panel(0.0, 0.12, 4))
        points = []
        for name, shape in (("whole", whole), ("halves", halves)):
            (tmp_path / name).mkdir()
            shot = shot_of(tmp_path / name, sheet=shape)
            refine(shot, tmp_path / f"{name}.usdc")
            points.append(fine(shot, tmp_path / f"{name}.usdc", FRAMES, prim="/World/sheet"))
            assert not faults(tmp_path / f"{name}.usdc", shot)
        rest = [refined(each) for each in (whole, halves)]
        same = cKDTree(rest[0]).query(rest[1])[1]
        assert len(points[1]) > len(points[0])
        assert np.abs(points[1] - points[0][same]).max() < 5e-4, "numbering alone differs"
        assert widest_gap(tmp_path / "halves" / "shot.usda", tmp_path / "halves.usdc", {"sheet": halves}) == 0.0

    def test_a_sheet_drawn_twice_is_solved_once_and_has_two_sides(self, tmp_path: Path):
        sheet = panel(0.0, 0.24, 8)
        back = (sheet[0].copy(), [[*face[1:], face[0]][::-1] for face in sheet[1]])
        points = []
        for name, shape in (("one", sheet), ("two", together(sheet, back))):
            (tmp_path / name).mkdir()
            shot = shot_of(tmp_path / name, sheet=shape)
            refine(shot, tmp_path / f"{name}.usdc", scheme="none")
            points.append(fine(shot, tmp_path / f"{name}.usdc", FRAMES, prim="/World/sheet"))
        rest = [refined(each) for each in (sheet, together(sheet, back))]
        distance, same = map(np.asarray, cKDTree(rest[0]).query(rest[1]))
        assert distance.max() < SAME
        assert np.array_equal(points[1], points[0][same])
        stage = open_over(shot, tmp_path / "two.usdc")
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/sheet"))
        normals = np.asarray(mesh.GetNormalsAttr().Get(FRAMES))
        front = np.array([np.flatnonzero(same == vertex)[0] for vertex in range(len(rest[0]))])
        behind = np.array([np.flatnonzero(same == vertex)[1] for vertex in range(len(rest[0]))])
        np.testing.assert_allclose(normals[front], -normals[behind], atol=1e-5)

    def test_borders_that_part_in_a_frame_are_not_welded(self):
        points, _ = halves = together(panel(-0.12, 0.12, 4), panel(0.0, 0.12, 4))
        later = points + np.where(np.arange(len(points)) < len(points) // 2, 0.0, 0.01)[:, None] * [1.0, 0.0, 0.0]
        mesh = mesh_of(halves[1], len(points))
        assert not weld(mesh, [points], 1e-5).is_none
        assert weld(mesh, [points, later], 1e-5).is_none


class TestSewn:
    """Borders of garments, and of unequal resolution."""

    def test_two_garments_stay_together(self, tmp_path: Path):
        shapes = {"left": panel(-0.12, 0.12, 4), "right": panel(0.0, 0.12, 4)}
        refine(shot := shot_of(tmp_path, **shapes), tmp_path / "fine.usdc")
        assert widest_gap(shot, tmp_path / "fine.usdc", shapes) < 1e-6

    @pytest.mark.parametrize(("rows", "meshes"), [(12, 1), (16, 2)])
    def test_a_finer_border_follows_the_coarser_one(self, tmp_path: Path, rows: int, meshes: int):
        parts = panel(-0.12, 0.12, 4), panel(0.0, 0.12, 4 * rows // 8, rows=rows)
        shapes: dict[str, Shape] = (
            {"sheet": together(*parts)} if meshes == 1 else dict(zip(("left", "right"), parts, strict=True))
        )
        report = refine(shot := shot_of(tmp_path, **shapes), tmp_path / "fine.usdc")
        assert widest_gap(shot, tmp_path / "fine.usdc", shapes) < 1e-6
        assert not report.unsettled
        assert "not sewn" not in warnings_of(shot)

    def test_strips_sewn_to_an_edge_between_its_points_stay_on_it(self, tmp_path: Path):
        """The rest shape is fitted to the shot, and the strips lie off the edge in it."""
        stage = new_stage(tmp_path / "shot.usda")
        mesh = add_mesh(stage, "/World/hem", *fringe(0.9))
        for time in range(1, 5):
            mesh.GetPointsAttr().Set(vec3(fringe(0.9 * time)[0]), time)
        shot = Path(save(stage))
        refine(shot, tmp_path / "fine.usdc", level=LEVEL)
        steps = subdivide_times(mesh_of(fringe(0.0)[1], len(fringe(0.0)[0])), LEVEL)
        band = 4 * (STRIPS + 1)
        ends = steps[0].edges[:, 0] < STRIPS, steps[0].edges[:, 1] == steps[0].edges[:, 0] + 1
        middles = steps[0].parent_vertex_count + np.flatnonzero(ends[0] & ends[1])
        for time in range(1, 5):
            points = fine(shot, tmp_path / "fine.usdc", float(time), prim="/World/hem")
            hem = np.stack([points[:STRIPS], points[middles], points[1 : STRIPS + 1]], axis=1)
            for number in range(STRIPS):
                first = band + 2 * ROWS * number
                off = [to_line(points[first + side], hem[number]) for side in (0, 1)]
                assert max(off) < 1e-4

    @pytest.mark.parametrize("meshes", [1, 2])
    def test_borders_beside_one_another_are_told_of_and_sewn_on_request(self, tmp_path: Path, meshes: int):
        parts = panel(-0.12, 0.12, 4), panel(3e-4, 0.12, 4)
        shapes: dict[str, Shape] = (
            {"sheet": together(*parts)} if meshes == 1 else dict(zip(("left", "right"), parts, strict=True))
        )
        shot = shot_of(tmp_path, **shapes)
        told = warnings_of(shot)
        assert "not sewn" in told
        remedy = told.partition("--set ")[2].split(";")[0].split()[0]
        assert "not sewn" not in warnings_of(shot, overrides=[remedy])
        refine(shot, tmp_path / "fine.usdc", overrides=(remedy,))
        assert widest_gap(shot, tmp_path / "fine.usdc", shapes, within=4e-4) < 1e-6


STRIPS, ALONG, WIDE, ROWS = 6, (0.2, 0.5), 0.006, 4
"""Strips of a fringe, between which parts of a hem's edge each is sewn, its width [m] and its rows of points."""


def fringe(time: float) -> Shape:
    """A waving band with strips sewn to its lower edge [m]: each strip's upper end lies on an edge, between points."""
    points, faces = panel(0.0, 0.02 * STRIPS, STRIPS, rows=3, height=0.06)
    points[:, 2] = 0.004 * np.sin(40.0 * points[:, 0] + time) * (1.0 - points[:, 1] / 0.06)
    shapes = [(points, faces)]
    for number in range(STRIPS):
        left, right = points[number], points[number + 1]
        top = np.stack([left + part * (right - left) for part in ALONG])
        swing = 0.3 * np.sin(2.0 * time + number)
        rows = [top + 0.02 * row * np.array([0.5 * swing, -1.0, swing]) for row in range(ROWS)]
        shapes.append((np.concatenate(rows), quads_of(2, ROWS, turned=True).tolist()))
    return together(*shapes)


def to_line(point: np.ndarray, line: np.ndarray) -> float:
    """Distance of a point from a line of points [m]."""
    start, along = line[:-1], np.diff(line, axis=0)
    part = np.clip(((point - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(start + part[:, None] * along - point, axis=1).min())


def pieces_of(shot: Shot) -> np.ndarray | None:
    """Numbers of the rigid parts of the first garment."""
    return shot.scene.garments[0].rigid


class TestPieces:
    """Parts of a garment's mesh that are no sheet."""

    def test_buttons_keep_their_shape_and_stay_on_the_cloth(self, tmp_path: Path):
        size = np.array([0.012, 0.012, 0.003])
        buttons = [box(np.array([x, -0.12, 0.0027]), size) for x in (-0.06, 0.0, 0.06)]
        cloth = panel(-0.12, 0.24, 8)
        shape = together(cloth, *buttons)
        shot = shot_of(tmp_path, sheet=shape)
        assert "3 pieces of it moved rigidly" in warnings_of(shot)
        refine(shot, tmp_path / "fine.usdc")
        fine_owner = refined(shape, np.r_[np.zeros(len(cloth[0])), np.repeat([1, 2, 3], 8)])
        for time in range(1, FRAMES + 1):
            points = fine(shot, tmp_path / "fine.usdc", time, prim="/World/sheet")
            tree = cKDTree(points[fine_owner == 0])
            for number in (1, 2, 3):
                button = points[fine_owner == number]
                cage = refined(shape, shortened(shape[0], time))[fine_owner == number]
                spans = [np.linalg.norm(each[:, None] - each, axis=2) for each in (button, cage)]
                np.testing.assert_allclose(spans[0], spans[1], atol=1e-6)
                assert np.asarray(tree.query(button)[0]).min() < 0.009, "as near as the mesh's vertices can be"

    def test_pieces_that_are_asked_for_are_rigid(self, tmp_path: Path):
        shape = together(panel(-0.12, 0.24, 8), panel(-0.05, 0.1, 4, rows=4, height=0.1))
        shot = shot_of(tmp_path, sheet=shape)
        stage = Usd.Stage.Open(str(shot))
        with closing(open_shot(str(shot))) as opened:
            assert pieces_of(opened) is None
        subset = UsdGeom.Subset.Define(stage, "/World/sheet/badge")
        subset.CreateIndicesAttr(Vt.IntArray([*range(64, 80)]))
        subset.GetPrim().CreateAttribute("physgraph:rigid", Sdf.ValueTypeNames.Bool).Set(True)
        stage.Save()
        with closing(open_shot(str(shot))) as opened:
            found = pieces_of(opened)
            assert found is not None
            assert (found >= 0).sum() == 25
        subset.GetIndicesAttr().Set(Vt.IntArray([*range(8)]))
        stage.Save()
        assert "paint bendScale" in warnings_of(shot)

    def test_a_thick_garment_that_is_no_sheet_keeps_its_rim(self, tmp_path: Path):
        shape = thick_tube(turned=np.pi / 16)
        shot, count = shot_of(tmp_path, sheet=shape), len(shape[0]) // 2
        assert "both skins are refined" in warnings_of(shot)
        with closing(open_shot(str(shot))) as opened:
            garment, frame = opened.scene.garments[0], opened.frame(1.0)
            rims = []
            for each in (garment, replace(garment, closed=None)):
                scene = replace(opened.scene, garments=(each,))
                points = Refiner(scene, settings_of(), levels=[LEVEL]).solve(frame).garments[0].points
                assert points is not None
                radius = np.linalg.norm(points[: 2 * count, ::2], axis=1).reshape(2, -1)[:, :16]
                rims.append(float(radius[0].mean() - radius[1].mean()))
        assert 1e-3 < rims[0] < 5e-3

    def test_a_thick_garment_is_as_thick_as_its_cage(self, tmp_path: Path):
        points, faces = thick_tube()
        shot, count = shot_of(tmp_path, sheet=(points, faces)), len(points) // 2
        for rest_frame in (None, "auto"):
            said = warnings_of(shot, rest_frame=rest_frame)
            assert "a closed shell, 2 mm thick" in said
            assert "no length" not in said
        refine(shot, tmp_path / "fine.usda", level=LEVEL)
        found = fine(shot, tmp_path / "fine.usda", 1.0, prim="/World/sheet")
        assert len(found) == len(refined((points, faces)))
        assert np.linalg.norm(found[:count] - found[count : 2 * count], axis=1) == pytest.approx(2e-3, rel=0.1)
        outer, inner = np.linalg.norm(found[: 2 * count, ::2], axis=1).reshape(2, -1)
        assert (outer > inner).all()
        assert not errors(tmp_path / "fine.usda", shot)

    def test_a_coat_with_its_lining_and_a_cord_are_no_thick_sheets(self):
        points, faces = thick_tube()
        mesh = mesh_of(faces, len(points))
        assert weld_skins(mesh, [points, points]) is not None
        apart = points.copy()
        apart[: len(points) // 2, ::2] *= 1.05  # A coat and its lining, which part.
        assert weld_skins(mesh, [points, apart]) is None
        square = np.array([[0.0, 0.0], [0.002, 0.0], [0.002, 0.002], [0.0, 0.002]])
        cord = np.array([[x, y, 0.05 * z] for z in range(3) for x, y in square])
        sides = [
            [4 * z + k, 4 * z + (k + 1) % 4, 4 * z + 4 + (k + 1) % 4, 4 * z + 4 + k] for z in (0, 1) for k in range(4)
        ]
        assert weld_skins(mesh_of([*sides, [3, 2, 1, 0], [8, 9, 10, 11]], 12), [cord]) is None
