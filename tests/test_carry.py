"""Primvars and subsets on the fine mesh."""

from __future__ import annotations

import numpy as np
import pytest
from layers import grid
from pxr import Gf, Sdf, Vt

from physgraph_usd.solver.mesh.subdivide import subdivide_times
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.write.primvars import FineMap, to_numpy, to_vt

POINTS, COUNTS, INDICES = grid(3, 2)


def fine_map(levels: int = 2, *, dropped: int | None = None) -> FineMap:
    """A map of the grid, perhaps with one face left out as a hole."""
    kept = np.array([face for face in range(len(COUNTS)) if face != dropped])
    indices = INDICES.reshape(-1, 4)[kept].reshape(-1)
    cage = PolygonMesh(COUNTS[kept], indices, len(POINTS))
    return FineMap(cage, subdivide_times(cage, levels), COUNTS, kept)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_a_linear_field_stays_linear(dtype: type) -> None:
    fine = fine_map()
    values, indices = fine.primvar("vertex", POINTS[:, 0].astype(dtype))
    assert indices is None
    assert values is not None
    assert values.dtype == dtype
    np.testing.assert_allclose(values, fine.interpolate(POINTS)[:, 0], atol=1e-3)


def test_an_indexed_vertex_primvar_is_its_flattened_self() -> None:
    fine = fine_map()
    palette, indices = np.array([[0.0, 1.0], [2.0, 3.0]], np.float32), np.arange(len(POINTS)) % 2
    np.testing.assert_array_equal(
        fine.primvar("vertex", palette, indices=indices)[0], fine.primvar("vertex", palette[indices])[0]
    )


def test_whole_numbers_are_picked_not_mixed() -> None:
    fine = fine_map()
    values, _ = fine.primvar("vertex", np.arange(len(POINTS)) * 7, smooth=False)
    assert values is not None
    assert set(values) <= set(np.arange(len(POINTS)) * 7)
    np.testing.assert_array_equal(values[: len(POINTS)], np.arange(len(POINTS)) * 7)


@pytest.mark.parametrize("dropped", [None, 2])
def test_words_are_carried_by_index_alone(dropped: int | None) -> None:
    fine = fine_map(dropped=dropped)
    words, _ = to_numpy(Vt.StringArray([f"face{face}" for face in range(len(COUNTS))]))
    values, indices = fine.primvar("uniform", words, smooth=False)
    assert values is None
    assert indices is not None
    kept = [face for face in range(len(COUNTS)) if face != dropped]
    np.testing.assert_array_equal(indices, np.repeat(kept, 16))


@pytest.mark.parametrize("dropped", [None, 2])
@pytest.mark.parametrize("indexed", [True, False])
def test_texture_coordinates_follow_the_points(dropped: int | None, indexed: bool) -> None:
    fine = fine_map(dropped=dropped)
    coordinates = POINTS[:, :2]
    values, indices = (
        fine.primvar("faceVarying", coordinates, indices=INDICES)
        if indexed
        else fine.primvar("faceVarying", coordinates[INDICES])
    )
    assert values is not None
    flat = values if indices is None else values[indices]
    assert (indices is not None) == indexed
    np.testing.assert_allclose(flat, fine.interpolate(POINTS)[fine.fine.indices][:, :2], atol=1e-12)


def test_a_seam_stays_a_seam() -> None:
    fine = fine_map(1)
    island = np.repeat(np.arange(len(COUNTS)), 4) % 2
    values, indices = fine.primvar("faceVarying", np.array([0.0, 1.0]), indices=island)
    assert values is not None
    assert indices is not None
    assert set(values[indices]) == {0.0, 1.0}


def test_the_wrong_number_of_values_is_refused() -> None:
    with pytest.raises(ValueError, match=r"has 5 elements; vertex needs 12"):
        fine_map().primvar("vertex", np.zeros(5))
    with pytest.raises(ValueError, match=r"indices from 0 to 9 into 2 values"):
        fine_map().primvar("vertex", np.zeros(2), indices=np.full(12, 9) * (np.arange(12) > 0))


@pytest.mark.parametrize("dropped", [None, 2])
def test_a_partition_of_faces_stays_one(dropped: int | None) -> None:
    fine = fine_map(dropped=dropped)
    parts = [fine.subset("face", np.array(part)) for part in ([0, 3], [1], [2, 4, 5])]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(fine.fine.face_count))


def test_a_partition_of_points_stays_one() -> None:
    fine = fine_map()
    halves = [np.arange(5), np.arange(5, len(POINTS))]
    parts = [fine.subset("point", half, exclusive=True) for half in halves]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(fine.fine.vertex_count))
    inside = fine.subset("point", halves[0])
    assert set(inside) < set(parts[0])


def test_edges_are_split() -> None:
    fine = fine_map(1)
    pairs = fine.subset("edge", np.array([1, 0])).reshape(-1, 2)
    assert pairs[0, 0] == 1
    assert pairs[1, 1] == 0
    assert pairs[0, 1] == pairs[1, 0] >= len(POINTS)


def test_a_subset_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="face indices from 99 to 99; the mesh has 6"):
        fine_map().subset("face", np.array([99]))


@pytest.mark.parametrize(
    "value",
    [
        Vt.FloatArray([1, 2]),
        Vt.HalfArray([1, 2]),
        Vt.Vec3dArray([(1, 2, 3)]),
        Vt.Matrix4dArray([Gf.Matrix4d(2)]),
        Vt.QuatfArray([Gf.Quatf(1, 2, 3, 4)]),
        Vt.BoolArray([True, False]),
        Vt.UCharArray([1, 2]),
        Vt.Int64Array([1, 2]),
        Vt.TokenArray(["a"]),
        Vt.StringArray(["a"]),
        Sdf.AssetPathArray([Sdf.AssetPath("a.png")]),
    ],
)
def test_every_type_comes_back_as_it_was(value: object) -> None:
    assert to_vt(to_numpy(value)[0], value) == value
