"""S1, S2, S16: meshes of almost nothing by every method, faults in compressed cloth, rest points at one place."""

import numpy as np
import pytest
import torch
from cloth import sheet, solved
from meshes import mesh_of

from physgraph_usd.lab.methods import METHODS
from physgraph_usd.solver.mesh.topology import PolygonMesh

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
    rest = CORNERS[: mesh.vertex_count]
    state = solved(mesh, rest, rest * [0.9, 1.0, 1.0], level=1, integrator=integrator)
    assert np.isfinite(state.points[0]).all()


FAULTS = ("zero-area triangle", "repeated vertex", "coincident point", "duplicate face")


def faulty(kind: str) -> tuple[PolygonMesh, np.ndarray, np.ndarray, str]:
    """A clean sheet with one fault: mesh, rest, vertices at the fault, and what it is called."""
    mesh, rest = sheet(8, 6)
    faces, count = mesh.indices.reshape(-1, 3).tolist(), mesh.vertex_count
    if kind == "zero-area triangle":
        a, b = 0, 1
        return (
            mesh_of([*faces, [a, count, b]]),
            np.vstack([rest, 0.5 * (rest[a] + rest[b])]),
            np.array([a, b]),
            "zero-area-face",
        )
    if kind == "repeated vertex":
        return mesh_of([*faces, [20, 20, 21]]), rest, np.array([20, 21]), "degenerate-face"
    if kind == "coincident point":
        return mesh_of(faces, count + 1), np.vstack([rest, rest[20]]), np.array([], int), "isolated-point"
    return mesh_of([*faces, faces[30]]), rest, np.array(faces[30]), "duplicate-face"


def hung(points: np.ndarray) -> np.ndarray:
    """A sheet stretched and sheared a little and bowed: a smooth answer, so that changes are the fault's."""
    bow = 0.03 * np.sin(np.pi * points[:, 0] / 0.4)
    return np.stack([1.03 * points[:, 0] + 0.05 * points[:, 1], 1.01 * points[:, 1], bow], axis=1)


@pytest.mark.parametrize("kind", FAULTS)
def test_s2_a_fault_in_compressed_cloth_stays_finite(kind: str):
    mesh, rest, _, _ = faulty(kind)
    state = solved(mesh, rest, hung(rest) * [0.8, 1.0, 1.0], level=2, dtype=torch.float32, steps=50)
    assert np.isfinite(state.points[0]).all()
    energy = state.telemetry[0]["energy_joules"]
    assert sum(energy["output"].values()) < sum(energy["input"].values())


class TestS16:
    @pytest.mark.parametrize("faces", [None, [[0, 1, 2, 3]]])
    def test_s16_points_at_one_place_at_rest_are_solved(self, faces: list[list[int]] | None):
        mesh, rest = sheet(3, 2) if faces is None else (mesh_of(faces), np.eye(4, 3))
        rest[-1] = rest[-2]
        moved = rest + 0.01 * np.sin(50.0 * rest[:, [1, 2, 0]])
        state = solved(mesh, rest, moved, level=1)
        assert np.isfinite(state.points[0]).all()
        assert np.abs(state.points[0][: len(rest)] - moved).max() < 0.5 * np.ptp(rest, axis=0).max()
