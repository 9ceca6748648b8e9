"""What is near what, and what passes through what, against every pair in numpy and against the IPC toolkit."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from brute import Soup, beside, between_edges, crossings, on_triangles
from folds import SHAPES, Cloth, crumpled, flat, folded, levels_of, named, placed, square, strip

from physgraph_usd.contact.cloth_mesh import ClothMesh
from physgraph_usd.contact.nearest import Pairs
from physgraph_usd.level import Level
from physgraph_usd.mesh.topology import PolygonMesh

REACH = 0.06
"""More than twice the longest edge of the sheets: every pair that counts is within what is asked."""
CROSSED = ("rolled through itself", "crumpled", "crumpled more")


def two_sheets() -> tuple[Level, torch.Tensor]:
    """Two garments that pass through one another and through themselves."""
    cloths: list[Cloth] = [square(3), square(3)]
    level = levels_of(named(cloths[0], "A"), named(cloths[1], "B"))[-1]
    half = level.vertex_count // 2
    points = level.rest.double().numpy()
    x = np.concatenate([crumpled(points[:half], 1, size=0.5), crumpled(points[half:], 2, size=0.5)])
    x[half:, 0] += 0.01
    return level, torch.as_tensor(x, dtype=level.dtype)


def fan(corners: int = 90) -> Cloth:
    """A disc whose triangles all meet in its middle: more than bits tell of."""
    angle = 2 * np.pi * np.arange(corners) / corners
    rim = 0.05 * np.stack([np.cos(angle), 0.0 * angle, -np.sin(angle)], axis=1)
    ids = np.arange(corners)
    faces = np.stack([0 * ids, 1 + ids, 1 + (ids + 1) % corners], axis=1)
    return PolygonMesh(np.full(corners, 3), faces.ravel(), corners + 1), np.concatenate([np.zeros((1, 3)), rim])


def two_fans() -> tuple[Level, torch.Tensor]:
    """Two such discs, bent and a little apart."""
    level = levels_of(named(fan(), "A"), named(fan(), "B"), level=0)[-1]
    x = level.rest.double().numpy() + 1e-3 * np.random.default_rng(0).normal(size=level.rest.shape)
    half = level.vertex_count // 2
    x[half:] = x[half:] * [0.8, 1.0, 0.9] + [0.0031, 0.02, 0.0017]
    return level, torch.as_tensor(x, dtype=level.dtype)


@cache
def scene(name: str) -> tuple[Level, torch.Tensor]:
    """A level and positions."""
    if name in (more := {"two sheets": two_sheets, "two fans": two_fans}):
        return more[name]()
    cloth = strip(8, 3) if "crumpled" not in name else square(4)
    level = levels_of(named(cloth))[-1]
    return level, placed(level, SHAPES[name])


SCENES = (*SHAPES, "two sheets", "two fans")
ALL = np.ones((2, 2), bool)


def moved(level: Level, x: torch.Tensor, meets: np.ndarray | None = None) -> ClothMesh:
    mesh = ClothMesh(level, ALL if meets is None else meets)
    mesh.move(x)
    return mesh


def everything(level: Level) -> torch.Tensor:
    return torch.ones(level.vertex_count, dtype=torch.bool)


def reach(level: Level) -> torch.Tensor:
    return torch.full_like(level.spacing, REACH)


def normals(soup: Soup) -> np.ndarray:
    """Area-weighted vertex normals, one face at a time."""
    out = np.zeros_like(soup.x)
    for face in soup.faces:
        a, b, c = soup.x[face]
        out[face] += np.cross(b - a, c - a)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)


def refused(way: np.ndarray, at_rest: np.ndarray, cosine: np.ndarray, same: np.ndarray, by: float) -> np.ndarray:
    """Parts of one garment that are where they belong, in its plane; with the limits moved a little."""
    distance, usual = np.linalg.norm(way, axis=-1), np.linalg.norm(at_rest, axis=-1)
    return same & (np.abs(cosine) < 0.5 + by) & (distance > (0.5 - by) * usual)


class TestVertexFace:
    @pytest.mark.parametrize("name", SCENES)
    def test_the_closest_face_above_and_below_each_vertex(self, name: str):
        level, x = scene(name)
        soup, rest = Soup.of(level, x), level.rest.double().numpy()
        pairs = moved(level, x).pairs(everything(level), reach(level))
        found = found_faces(soup, pairs)
        near = np.asarray(beside(soup)[:, soup.faces].any(axis=2))
        normal, tally = normals(soup), 0
        for v, point in enumerate(soup.x):
            corners = [soup.x[soup.faces[:, i]] for i in range(3)]
            foot = on_triangles(point[None], *corners)
            way = point - foot
            weight = weights_of(foot, *corners)
            at_rest = rest[v] - (weight[:, :, None] * rest[soup.faces]).sum(axis=1)
            distance = np.linalg.norm(way, axis=1)
            cosine = way @ normal[v] / np.maximum(distance, 1e-300)
            same: np.ndarray = soup.garment[soup.faces[:, 0]] == soup.garment[v]
            surely = ~near[v] & ~refused(way, at_rest, cosine, same, 1e-3) & (distance < REACH - 1e-5)
            maybe = ~near[v] & ~refused(way, at_rest, cosine, same, -1e-3) & (distance < REACH + 1e-5)
            for side in (1.0, -1.0):
                got = [row for row in found.get(v, []) if (row[1] * side > 0)]
                least = distance[surely & (side * cosine > 1e-3)].min(initial=np.inf)
                most = distance[maybe & (side * cosine > -1e-3)].min(initial=np.inf)
                assert len(got) <= 1
                here = got[0][0] if got else np.inf
                assert most - 1e-6 <= here <= least + 1e-6, (v, side, here, least)
                tally += bool(got)
        assert tally > 30 if name != "rolled" else tally > 10

    @pytest.mark.parametrize("name", SCENES)
    def test_weights_are_the_closest_points(self, name: str):
        level, x = scene(name)
        soup = Soup.of(level, x)
        pairs = moved(level, x).pairs(everything(level), reach(level))
        corners, weight = (each[pairs.face].double().numpy() for each in (pairs.corners, pairs.weight))
        corners = corners.astype(int)
        assert (weight[:, 0] == 1.0).all()
        assert (weight[:, 1:] <= 0).all()
        np.testing.assert_allclose(weight.sum(axis=1), 0.0, atol=1e-6)
        foot = on_triangles(soup.x[corners[:, 0]], *(soup.x[corners[:, i]] for i in (1, 2, 3)))
        there = -(weight[:, 1:, None] * soup.x[corners[:, 1:]]).sum(axis=1)
        np.testing.assert_allclose(there, foot, atol=2e-6)

    def test_a_flat_sheet_is_near_nothing(self):
        level = levels_of(named(square(4)))[-1]
        assert len(moved(level, level.rest).pairs(everything(level), reach(level)).corners) == 0

    def test_an_accordion_sees_the_next_pleat(self):
        """Neighbours two edges apart come near where the cloth folds sharply."""
        level = levels_of(named(strip(8, 2)))[-1]
        x = placed(level, lambda points: points * np.array([0.1, 1.0, 1.0]) + pleats(points))
        pairs = moved(level, x).pairs(everything(level), reach(level))
        assert int(pairs.face.sum()) > level.vertex_count // 2


def pleats(points: np.ndarray) -> np.ndarray:
    """Up and down at every other edge of a strip's second level."""
    up = np.round(points[:, 0] / 0.025).astype(int) % 4
    return np.outer(np.array([0.0, 0.0245, 0.049, 0.0245])[up], [0.0, 1.0, 0.0])


def weights_of(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points in the planes of triangles."""
    matrix = np.stack([b - a, c - a], axis=2)
    uv = np.einsum("nij,nj->ni", np.linalg.pinv(matrix), p - a)
    return np.column_stack([1 - uv.sum(axis=1), uv])


def found_faces(soup: Soup, pairs: Pairs) -> dict[int, list[tuple[float, float]]]:
    """Distance and cosine of what was found, by vertex."""
    normal = normals(soup)
    out: dict[int, list[tuple[float, float]]] = {}
    for corners, weight in zip(pairs.corners[pairs.face].numpy(), pairs.weight[pairs.face].numpy(), strict=True):
        way = weight.astype(float) @ soup.x[corners]
        distance = float(np.linalg.norm(way))
        out.setdefault(int(corners[0]), []).append((distance, float(way @ normal[corners[0]]) / distance))
    return out


class TestEdgeEdge:
    @pytest.mark.parametrize("name", SCENES)
    def test_the_closest_edge_above_and_below_each_edge(self, name: str):
        """Of edges that have a vertex within reach of a face; all of those that matter to the force do."""
        level, x = scene(name)
        soup, rest = Soup.of(level, x), level.rest.double().numpy()
        pairs = moved(level, x).pairs(everything(level), reach(level))
        found = {frozenset((*map(tuple, np.sort(row.reshape(2, 2), axis=1).tolist()),)) for row in corners_of(pairs)}
        normal, near = normals(soup), beside(soup)
        ends = soup.edges
        missed, tally = [], 0
        for e, (a, b) in enumerate(ends):
            s, t = between_edges(soup.x[a], soup.x[b], soup.x[ends[:, 0]], soup.x[ends[:, 1]])
            inside = (s > 1e-4) & (s < 1 - 1e-4) & (t > 1e-4) & (t < 1 - 1e-4)
            inside &= ~(near[a][ends].any(axis=1) | near[b][ends].any(axis=1))
            s, t = np.nan_to_num(s)[:, None], np.nan_to_num(t)[:, None]
            way, at_rest = (
                (1 - s) * p[a] + s * p[b] - (1 - t) * p[ends[:, 0]] - t * p[ends[:, 1]] for p in (soup.x, rest)
            )
            up = normal[a] + normal[b]
            distance = np.linalg.norm(way, axis=1)
            cosine = way @ up / np.maximum(np.linalg.norm(up) * distance, 1e-300)
            same = soup.garment[a] == soup.garment[ends[:, 0]]
            good = inside & ~refused(way, at_rest, cosine, same, 1e-3) & (distance < 0.5 * REACH) & (distance > 1e-8)
            for side in (1.0, -1.0):
                those = np.flatnonzero(good & (side * cosine > 1e-3))
                if not len(those):
                    continue
                best = those[distance[those].argmin()]
                if (distance[good & (np.abs(cosine) <= 1e-3)] < distance[best]).any():
                    continue  # Rounding says which side that one is on.
                tally += 1
                tied = those[distance[those] < distance[best] + 1e-6]
                if not any(frozenset((tuple(sorted(ends[e])), tuple(sorted(ends[g])))) in found for g in tied):
                    missed.append((e, int(best), float(distance[best])))
        assert not missed
        assert tally > 10

    @pytest.mark.parametrize("name", SCENES)
    def test_pairs_are_closest_inside_both_occur_once_and_are_not_joined(self, name: str):
        level, x = scene(name)
        soup = Soup.of(level, x)
        pairs = moved(level, x).pairs(everything(level), reach(level))
        corners, weight = corners_of(pairs), pairs.weight[~pairs.face].double().numpy()
        assert len(corners) > 10
        s, t = between_edges(*(soup.x[corners[:, i]] for i in range(4)))
        crossed = np.isfinite(s)  # Parallel ones are closest in many places.
        expected = np.stack([1 - s, s, t - 1, -t], axis=1)
        assert np.abs(weight - expected)[crossed].max() < 5e-3
        assert ((weight[:, :2] > 0) & (weight[:, 2:] < 0)).all()
        np.testing.assert_allclose(weight.sum(axis=1), 0.0, atol=1e-6)
        assert ((0 < expected[crossed, :2]) | (np.abs(expected[crossed, :2]) < 1e-3)).all()
        keys = {frozenset(map(tuple, np.sort(row.reshape(2, 2), axis=1).tolist())) for row in corners}
        assert len(keys) == len(corners)
        near: np.ndarray = beside(soup)
        assert not near[corners[:, :2, None], corners[:, None, 2:]].any()


def corners_of(pairs: Pairs) -> np.ndarray:
    """Corners of the edge-edge pairs."""
    return pairs.corners[~pairs.face].numpy()


class TestCrossings:
    @pytest.mark.parametrize("name", SCENES)
    def test_against_every_edge_and_face(self, name: str):
        level, x = scene(name)
        expected = crossings(Soup.of(level, x))
        found = moved(level, x).crossings(everything(level))
        assert found.count == len(expected)
        listed = set(zip(found.edge.tolist(), found.face.tolist(), strict=True))
        assert len(listed) == len(found.edge)
        assert listed <= expected
        edges = np.array(sorted(expected), int).reshape(-1, 2)[:, 0]
        few = {pair for pair in expected if (edges == pair[0]).sum() <= 4}
        assert few <= listed
        assert (len(expected) > 10) == (name in (*CROSSED, "two sheets"))

    @pytest.mark.parametrize("name", SCENES)
    def test_against_the_ipc_toolkit(self, name: str):
        ipctk = pytest.importorskip("ipctk", reason="the IPC toolkit is not installed; it is in the extra `dev`")
        level, x = scene(name)
        soup = Soup.of(level, x)
        mesh = ipctk.CollisionMesh(soup.x, soup.edges.astype(np.int32), soup.faces.astype(np.int32))
        found = moved(level, x).crossings(everything(level))
        assert ipctk.has_intersections(mesh, soup.x) == (found.count > 0)
        listed = set(zip(found.edge.tolist(), found.face.tolist(), strict=True))
        for e, edge in enumerate(soup.edges):
            for f in np.flatnonzero(~np.isin(soup.faces, edge).any(axis=1)):
                hit = ipctk.is_edge_intersecting_triangle(*soup.x[edge], *soup.x[soup.faces[f]])
                assert hit == ((e, int(f)) in listed) or found.count > len(listed)

    @pytest.mark.parametrize(
        "meets", [[[True, False], [False, True]], [[False, True], [True, False]], [[False, False], [False, True]]]
    )
    def test_only_garments_that_feel_one_another(self, meets: list[list[bool]]):
        level, x = scene("two sheets")
        felt = np.array(meets)
        found = moved(level, x, felt).crossings(everything(level))
        expected = crossings(Soup.of(level, x), felt)
        assert 0 < len(expected) < len(crossings(Soup.of(level, x)))
        assert found.count == len(expected)
        table = moved(level, x, felt).between(found)
        assert table.sum() == len(found.edge)
        assert not table[~felt | np.tri(2, k=-1, dtype=bool)].any()

    def test_touching_is_not_passing(self):
        """A sheet laid exactly on another, and one whose vertices lie in the other's faces."""
        level = levels_of(named(square(2), "A"), named(square(2), "B"))[-1]
        half = level.vertex_count // 2
        for shift in ([0.0, 0.0, 0.0], [0.004, 0.0, 0.003]):
            x = level.rest.clone()
            x[half:] += torch.tensor(shift)
            assert moved(level, x).crossings(everything(level)).count == 0

    def test_a_lining_of_the_same_mesh_passes_through_at_the_sides_of_faces(self):
        """Every edge that passes through meets an edge below it; it is counted once, as when moved aside by a hair."""
        level = levels_of(named(square(4), "A"), named(square(4), "B"))[-1]
        half = level.vertex_count // 2
        x = level.rest.clone()
        x[half:, 1] = 0.3 * x[half:, 0] + 0.11 * x[half:, 2] + 0.002
        found = moved(level, x).crossings(everything(level)).count
        x[half:] += 1e-5 * torch.rand_like(x[half:])
        aside = moved(level, x).crossings(everything(level)).count
        assert aside == len(crossings(Soup.of(level, x)))
        assert 0.5 * aside < found < 1.5 * aside

    @pytest.mark.parametrize("shape", [flat, folded])
    def test_what_does_not_cross_has_none(self, shape: object):
        level = levels_of(named(strip(8, 3)))[-1]
        x = placed(level, shape)  # type: ignore[arg-type]
        assert moved(level, x).crossings(everything(level)).count == 0


def test_the_vertices_opposite_an_edge_are_those_of_its_faces():
    level = levels_of(named(square(2)))[-1]
    mesh = ClothMesh(level, ALL)
    faces = level.triangles.numpy()
    for edge, opposite in zip(level.edges.numpy(), mesh.opposite.numpy(), strict=True):
        own = faces[np.isin(faces, edge).sum(axis=1) == 2]
        thirds = sorted(own[~np.isin(own, edge)].tolist())
        assert sorted(opposite[opposite >= 0].tolist()) == thirds
        assert opposite[0] >= 0


def test_rings_grow_by_edges():
    level = levels_of(named(square(4)))[-1]
    mesh = ClothMesh(level, ALL)
    near: np.ndarray = beside(Soup.of(level, level.rest)).astype(int)
    start = torch.zeros(level.vertex_count, dtype=torch.bool)
    start[7] = True
    for rings in range(4):
        expected = np.linalg.matrix_power(near, rings)[7] > 0
        np.testing.assert_array_equal(mesh.grown(start, rings).numpy(), expected)
    assert not mesh.grown(torch.zeros_like(start), 3).any()
