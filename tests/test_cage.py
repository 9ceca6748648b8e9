"""Topology and points: what no solver could use is refused by name, what can be left out or repaired is told."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from stages import add_sheet, new_stage, save, sheet_faces, sheet_points, sheet_shot, vec3

from physgraph_usd.errors import GarmentError
from physgraph_usd.usd.read.cage import read_cage
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


def test_topology_in_time_samples_only_is_read(stage: Usd.Stage) -> None:
    made = mesh(stage, COUNTS, INDICES)
    for attribute, value in ((made.GetFaceVertexCountsAttr(), COUNTS), (made.GetFaceVertexIndicesAttr(), INDICES)):
        attribute.Clear()
        attribute.Set(value, 5.0)
    np.testing.assert_array_equal(read_cage(made.GetPrim(), 20, ()).mesh.indices, INDICES)
    np.testing.assert_array_equal(read_cage(made.GetPrim(), 20, (1.0, 9.0)).mesh.indices, INDICES)


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


@pytest.mark.parametrize(("value", "when"), [(np.nan, 1.0), (np.inf, 2.0)])
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
