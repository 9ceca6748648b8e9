"""S1, S2, S4, S7, S10, S16: meshes of almost nothing, faulty ones, sizes, and rest points at one place."""

from __future__ import annotations

import numpy as np
import pytest
from cloth import FABRIC, GUIDE, frame_of, refiner_of, rms, sheet, solved, total, wave
from meshes import mesh_of
from sheets import garment_of

from physgraph_usd.lab.methods import METHODS
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.mesh.topology import PolygonMesh

LONG = {"steps": 200, "tolerance": 1e-6}
"""Enough that what is left is the method's own fault."""
methods = pytest.mark.parametrize("method", ["physgraph", pytest.param("quasi-newton", marks=pytest.mark.slow)])
CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0.01], [0.5, 0.5, 0.5]])
ALMOST_NOTHING = {
    "one triangle": ([[0, 1, 2]], 3),
    "one triangle and two isolated points": ([[0, 1, 2]], 5),
    "one edge": ([[0, 1]], 2),
    "an edge and a triangle": ([[0, 1], [1, 2, 3]], 4),
    "no face": ([], 4),
    "nothing": ([], 0),
    "a triangle that repeats a vertex": ([[0, 0, 1]], 2),
}


@pytest.mark.parametrize("integrator", METHODS)
@pytest.mark.parametrize("name", ALMOST_NOTHING)
def test_s1_almost_nothing_is_solved_by_every_method(name: str, integrator: str):
    mesh = mesh_of(*ALMOST_NOTHING[name])
    moved = CORNERS[: mesh.vertex_count] * [0.9, 1.0, 1.0]
    found = solved(mesh, CORNERS[: mesh.vertex_count], moved, level=1, integrator=integrator).points[0]
    assert np.isfinite(found).all()
    isolated = np.setdiff1d(np.arange(mesh.vertex_count), mesh.indices)
    np.testing.assert_array_equal(found[isolated], moved[isolated])


FAULTS = ("zero-area triangle", "repeated vertex", "coincident point", "duplicate face")


def faulty(kind: str) -> tuple[PolygonMesh, np.ndarray, np.ndarray]:
    """A clean sheet with one fault: mesh, rest, and vertices at the fault."""
    mesh, rest = sheet(8, 6)
    faces, count = mesh.indices.reshape(-1, 3).tolist(), mesh.vertex_count
    if kind == "zero-area triangle":
        return mesh_of([*faces, [0, count, 1]]), np.vstack([rest, 0.5 * (rest[0] + rest[1])]), np.array([0, 1])
    if kind == "repeated vertex":
        return mesh_of([*faces, [20, 20, 21]]), rest, np.array([20, 21])
    if kind == "coincident point":
        return mesh_of(faces, count + 1), np.vstack([rest, rest[20]]), np.array([], int)
    return mesh_of([*faces, faces[30]]), rest, np.array(faces[30])


def hung(points: np.ndarray) -> np.ndarray:
    """A sheet stretched and sheared a little and bowed: a smooth answer, so that changes are the fault's."""
    bow = 0.03 * np.sin(np.pi * points[:, 0] / 0.4)
    return np.stack([1.03 * points[:, 0] + 0.05 * points[:, 1], 1.01 * points[:, 1], bow], axis=1)


@methods
def test_s2_a_fault_changes_little_away_from_it(method: str):
    clean, rest = sheet(8, 6)
    good = solved(clean, rest, hung(rest), integrator=method, **LONG).points[0][: len(rest)]
    for kind in FAULTS:
        mesh, worse, at = faulty(kind)
        bad = solved(mesh, worse, hung(worse), integrator=method, **LONG).points[0][: len(rest)]
        away = np.setdiff1d(np.arange(len(rest)), at)
        assert np.linalg.norm(bad - good, axis=1)[away].max() < 0.01 * rms(good - hung(rest)), kind


@methods
def test_s4_a_fin_a_bow_tie_and_a_face_wound_the_other_way_are_solved(method: str):
    mesh, rest = sheet(4, 3)
    count, faces = len(rest), mesh.indices.reshape(-1, 3).tolist()
    faces[3] = faces[3][::-1]
    more = np.vstack([rest, [[0.05, 0.05, 0.05], [0.3, 0.3, 0.0], [0.3, 0.35, 0.0]]])
    broken = mesh_of([*faces, [6, 7, count], [count - 1, count + 1, count + 2]])
    state = solved(broken, more, wave(more), integrator=method)
    assert np.isfinite(state.points[0]).all()
    assert total(state.telemetry[0], "output") < total(state.telemetry[0], "input")


@methods
def test_s7_cloth_of_a_hundredth_of_the_size_has_the_same_shape(method: str):
    mesh, rest = sheet(6, 4)
    points, scale = wave(rest), 0.01
    one = solved(mesh, rest, points, level=2, integrator=method).points[0]
    fabric = Fabric(FABRIC.stretch, FABRIC.bend * scale**2, FABRIC.density / scale, FABRIC.thickness * scale)
    frame = frame_of(scale * points, fabric=fabric, guide=GUIDE / scale**2)
    two = refiner_of([garment_of(mesh, scale * rest)], level=2, integrator=method).solve(frame).points[0]
    assert rms(two / scale - one) < 1e-4 * 0.05 / 4


@methods
def test_s10_a_patch_is_solved_alike_alone_and_beside_a_hundred_times_its_area(method: str):
    small, rest = sheet(6, 6)
    big, far = sheet(60, 60)
    shift = np.array([10.0, 0.0, 0.0])
    counts, indices = np.append(small.counts, big.counts), np.append(small.indices, big.indices + len(rest))
    both = PolygonMesh(counts, indices, len(rest) + len(far))
    options = {"level": 0, "integrator": method, **LONG}
    alone = solved(small, rest, hung(rest), **options).points[0]
    joined = solved(both, np.vstack([rest, far + shift]), np.vstack([hung(rest), hung(far) + shift]), **options)
    assert rms(joined.points[0][: len(rest)] - alone) < 0.01 * rms(alone - hung(rest))


class TestS16:
    @pytest.mark.parametrize("faces", [None, [[0, 1, 2, 3]]])
    def test_s16_points_at_one_place_at_rest_are_solved(self, faces: list[list[int]] | None):
        mesh, rest = sheet(3, 2) if faces is None else (mesh_of(faces), np.eye(4, 3))
        rest[-1] = rest[-2]
        moved = rest + 0.01 * np.sin(50.0 * rest[:, [1, 2, 0]])
        state = solved(mesh, rest, moved, level=1)
        assert np.isfinite(state.points[0]).all()
        assert np.abs(state.points[0][: len(rest)] - moved).max() < 0.5 * np.ptp(rest, axis=0).max()
