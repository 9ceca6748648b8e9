"""Topology and points: what no solver could use is refused by name, what can be left out or repaired is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fuzz.damage import replace
from pxr import Usd, UsdGeom
from stages import add_sheet, new_stage, save, sheet_faces, sheet_points, sheet_shot, vec3

from physgraph_usd.errors import GarmentError
from physgraph_usd.usd.read.cage import read_cage, repair
from physgraph_usd.usd.read.reader import open_shot

COUNTS, INDICES = (array.tolist() for array in sheet_faces())


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    return new_stage(tmp_path / "s.usda")


def mesh(stage: Usd.Stage, counts: list[int], indices: list[int]) -> UsdGeom.Mesh:
    made = add_sheet(stage)
    made.GetFaceVertexCountsAttr().Set(counts)
    made.GetFaceVertexIndicesAttr().Set(indices)
    return made


@pytest.mark.parametrize(
    ("counts", "indices", "message"),
    [
        ([], [], "the mesh is empty: 20 points, 0 faces"),
        ([2], [0, 1], "the mesh is empty: 20 points, 1 faces"),
        (COUNTS, INDICES[:-1], "faceVertexCounts sum to 48 but there are 47 faceVertexIndices"),
        (COUNTS, [*INDICES[:-1], 20], r"faceVertexIndices\[47\] is 20 but there are 20 points"),
        (COUNTS, [-1, *INDICES[1:]], r"faceVertexIndices\[0\] is -1"),
        ([3, -1, 3], [0, 1, 2, 3, 4], r"faceVertexCounts\[1\] is -1"),
    ],
)
def test_broken_topology_is_refused_with_prim_index_and_remedy(
    stage: Usd.Stage, counts: list[int], indices: list[int], message: str
) -> None:
    broken = mesh(stage, counts, indices)
    with pytest.raises(GarmentError, match="</World/cloth>.*" + message) as caught:
        read_cage(broken.GetPrim(), 20, ())
    assert caught.value.remedy
    with pytest.raises(GarmentError, match=message + ".*; "):
        open_shot(save(stage))


def test_faces_under_three_corners_are_left_out_and_told(stage: Usd.Stage) -> None:
    cage = read_cage(mesh(stage, [4, 2, 0, 3], [0, 1, 6, 5, 1, 2, 2, 7, 6]).GetPrim(), 20, ())
    np.testing.assert_array_equal(cage.kept_faces, [0, 3])
    np.testing.assert_array_equal(cage.mesh.indices, [0, 1, 6, 5, 2, 7, 6])
    assert "2 faces with fewer than three corners left out, the first is face 1" in str(cage.notices[0])


def test_all_holes_are_refused(stage: Usd.Stage) -> None:
    made = mesh(stage, COUNTS, INDICES)
    made.CreateHoleIndicesAttr(list(range(12)))
    with pytest.raises(GarmentError, match="every one of its 12 faces is a hole"):
        read_cage(made.GetPrim(), 20, ())


def test_topology_in_time_samples_only_is_read(stage: Usd.Stage) -> None:
    made = mesh(stage, COUNTS, INDICES)
    for attribute, value in ((made.GetFaceVertexCountsAttr(), COUNTS), (made.GetFaceVertexIndicesAttr(), INDICES)):
        attribute.Clear()
        attribute.Set(value, 5.0)
    np.testing.assert_array_equal(read_cage(made.GetPrim(), 20, ()).mesh.indices, INDICES)
    np.testing.assert_array_equal(read_cage(made.GetPrim(), 20, (1.0, 9.0)).mesh.indices, INDICES)


def test_creases_are_told(stage: Usd.Stage) -> None:
    made = mesh(stage, COUNTS, INDICES)
    made.CreateCreaseIndicesAttr([0, 1])
    made.CreateCreaseLengthsAttr([2])
    made.CreateCreaseSharpnessesAttr([3.0])
    assert "creaseIndices sharpen" in str(read_cage(made.GetPrim(), 20, ()).notices[0])


@pytest.mark.parametrize(("kind", "value"), [("bool", True), ("half", 0.5), ("token", "soft")])
def test_creases_of_a_wrong_type_are_told_too(stage: Usd.Stage, kind: str, value: object) -> None:
    prim = mesh(stage, COUNTS, INDICES).GetPrim()
    replace(stage, prim.GetPath().AppendProperty("creaseIndices"), kind, value)
    assert "creaseIndices sharpen" in str(read_cage(prim, 20, ()).notices[0])


def test_topology_controls_that_usd_does_not_know_are_told(stage: Usd.Stage) -> None:
    made = mesh(stage, COUNTS, INDICES)
    made.CreateOrientationAttr("upsideDown")
    for time, scheme in ((1.0, "doSabin"), (2.0, "loop")):
        made.GetSubdivisionSchemeAttr().Set(scheme, time)
    notices = "\n".join(map(str, read_cage(made.GetPrim(), 20, ()).notices))
    assert "orientation is 'upsideDown'" in notices
    assert "subdivisionScheme is 'doSabin'" in notices
    assert "subdivisionScheme has time samples" in notices
    assert not open_shot(save(stage)).scene.garments[0].flipped


def test_isolated_points_stay(stage: Usd.Stage) -> None:
    mesh(stage, [3], [0, 1, 5])
    shot = open_shot(save(stage))
    assert shot.scene.garments[0].mesh.vertex_count == 20
    assert len(shot.frame(1.0).garments[0].points) == 20


LINE = np.array([[0, 1], [1, 2], [2, 3]])


def test_a_point_moves_as_its_neighbours_did() -> None:
    before = np.array([[0.0, 0, 0], [1, 5, 0], [2, 0, 0], [3, 0, 0]])
    now = before + np.array([0.0, 0.0, 2.0])
    now[1] = np.nan
    out = repair(now, LINE, before)
    np.testing.assert_allclose(out[1], [1, 5, 2])
    np.testing.assert_array_equal(out[[0, 2, 3]], now[[0, 2, 3]])


def test_repair_grows_inwards_ring_by_ring() -> None:
    before = np.arange(12.0).reshape(4, 3)
    now = before + 1.0
    now[1:] = np.inf
    np.testing.assert_allclose(repair(now, LINE, before), before + 1.0)


def test_a_point_without_neighbours_is_held_and_without_samples_takes_their_mean() -> None:
    before = np.ones((3, 3))
    now = np.array([[0.0, 0, 0], [np.nan, 0, 0], [2, 2, 2]])
    none = np.zeros((0, 2), np.int64)
    np.testing.assert_array_equal(repair(now, none, before)[1], [1, 1, 1])
    np.testing.assert_array_equal(repair(now, np.array([[0, 1], [1, 2]]), None)[1], [1, 1, 1])
    assert np.isnan(repair(now, none, None)[1, 0])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("when", [1.0, 2.0, 3.0])
def test_s5_one_broken_point_is_told_and_leaves_other_frames_alone(tmp_path: Path, value: float, when: float) -> None:
    (tmp_path / "bad").mkdir()
    stage = new_stage(tmp_path / "bad" / "s.usda")
    points = sheet_points(when)
    points[7, 2] = value
    add_sheet(stage).GetPointsAttr().Set(vec3(points), when)
    bad, good = open_shot(save(stage)), open_shot(sheet_shot(tmp_path / "good.usda"))
    for time in (1.0, 2.0, 3.0):
        ours, theirs = (shot.frame(time).garments[0].points for shot in (bad, good))
        same = np.ones(len(ours), bool)
        same[7] = time != when
        np.testing.assert_array_equal(ours[same], theirs[same])
        assert np.linalg.norm(ours[7] - theirs[7]) < 0.5
    told = [notice for notice in bad.warnings if notice.time == when]
    assert len(told) == 1
    assert "points[7] NaN or infinite: 1 repaired" in told[0].message
    np.testing.assert_array_equal(bad.scene.garments[0].rest, good.scene.garments[0].rest)


def test_too_many_broken_points_are_refused_with_prim_and_time(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    points = sheet_points(2.0)
    points[:3] = np.nan
    add_sheet(stage).GetPointsAttr().Set(vec3(points), 2.0)
    shot = open_shot(save(stage))
    with pytest.raises(GarmentError, match=r"</World/cloth> at time code 2: 3 of 20 points are NaN.*--frames"):
        shot.frame(2.0)


@pytest.mark.parametrize("when", [None, 1.0])
def test_a_single_sample_is_repaired_from_its_neighbours(tmp_path: Path, when: float | None) -> None:
    stage = new_stage(tmp_path / "s.usda")
    points = sheet_points(when)
    points[7] = np.nan
    mesh = add_sheet(stage, times=() if when is None else (when,), default=False)
    mesh.CreatePointsAttr().Set(vec3(points), *(() if when is None else (when,)))
    shot = open_shot(save(stage))
    neighbours = sheet_points(when)[[2, 6, 8, 12]].mean(axis=0)
    np.testing.assert_allclose(shot.frame(when).garments[0].points[7], neighbours, atol=1e-6)


def test_a_mesh_without_points_is_refused(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    add_sheet(stage, times=(), default=False)
    with pytest.raises(GarmentError, match="</World/cloth>: has no points; "):
        open_shot(save(stage))
    UsdGeom.Mesh.Get(stage, "/World/cloth").CreatePointsAttr([])
    with pytest.raises(GarmentError, match="the mesh is empty: 0 points"):
        open_shot(save(stage))
