"""Topology that no solver could use is refused by name; what can be left out is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fuzz.damage import replace
from pxr import Usd, UsdGeom
from stages import add_sheet, new_stage, save, sheet_faces

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


def test_a_change_is_found_where_it_happens_and_only_inside_the_range(stage: Usd.Stage) -> None:
    made = mesh(stage, COUNTS, INDICES)
    holes = made.CreateHoleIndicesAttr()
    for time, value in ((1.0, [2]), (4.0, [2]), (6.0, [3])):
        holes.Set(value, time)
    read_cage(made.GetPrim(), 20, (1.0, 5.0))
    read_cage(made.GetPrim(), 20, (6.0, 9.0))
    with pytest.raises(GarmentError, match="time code 6: holeIndices changes"):
        read_cage(made.GetPrim(), 20, (1.0, 9.0))


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
