"""Clusters of faces, and what is kept from one look at the cloth to the next: a stale answer is a wrong one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from brute import Soup, crossings
from folds import EDGE, SHAPES, crumpled, folded, levels_of, named, placed, square, strip, view_of
from scipy.sparse import csgraph

from physgraph_usd.collide.clusters import ClusteredParts
from physgraph_usd.contact import cloth
from physgraph_usd.contact.cloth_mesh import ClothMesh, Crossings
from physgraph_usd.level import Level
from physgraph_usd.mesh.topology import adjacency, owned_sides

ALL = np.ones((2, 2), bool)


def parts_of(level: Level) -> ClusteredParts:
    edges, triangles = level.edges.numpy(), level.triangles.numpy()
    return ClusteredParts(level, adjacency(edges, level.vertex_count), owned_sides(edges, triangles), meets=ALL)


def listed(found: Crossings) -> set[tuple[int, int]]:
    return set(zip(found.edge.tolist(), found.face.tolist(), strict=True))


def everything(level: Level) -> torch.Tensor:
    return torch.ones(level.vertex_count, dtype=torch.bool)


class TestClusters:
    def test_every_part_is_in_one_cluster(self):
        level = levels_of(named(square(4)))[-1]
        parts = parts_of(level)
        for numbers, count in (
            (parts.faces[2], len(level.triangles)),
            (parts.edges[2], len(level.edges)),
            (parts.vertices[1], level.vertex_count),
        ):
            assert sorted(numbers.numpy().tolist()) == list(range(count))

    def test_each_hangs_together_and_is_of_one_garment(self):
        level = levels_of(named(square(3), "A"), named(square(4), "B"))[-1]
        parts = parts_of(level)
        first, vertices = (np.asarray(each.numpy(), dtype=np.int64) for each in parts.vertices)
        beside = adjacency(level.edges.numpy(), level.vertex_count)
        for a, b in pairwise(first):
            own = vertices[a:b]
            assert len(set(level.vertex_garment.numpy()[own].tolist())) == 1
            assert csgraph.connected_components(beside[own][:, own])[0] == 1
        assert 2 * parts.count < level.vertex_count

    def test_boxes_follow_the_positions(self):
        level = levels_of(named(square(4)))[-1]
        parts, x = parts_of(level), placed(level, crumpled)
        for _ in range(2):
            parts.move(x)
            numbers = np.asarray(parts.faces[2].numpy(), dtype=np.int64)
            corners = x.numpy()[level.triangles.numpy()[numbers]]
            np.testing.assert_array_equal(parts.face_boxes[0].numpy(), corners.min(axis=1))
            np.testing.assert_array_equal(parts.face_boxes[1].numpy(), corners.max(axis=1))
            x[: len(x) // 2] += 0.3 * EDGE  # In place: the same tensor with other values.

    def test_they_are_the_same_each_time(self):
        level = levels_of(named(square(4)))[-1]
        first, second = parts_of(level), parts_of(level)
        for one, other in zip((*first.faces, *first.edges), (*second.faces, *second.edges), strict=True):
            np.testing.assert_array_equal(one.numpy(), other.numpy())


class TestCrossingsSince:
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("name", ["rolled through itself", "rolled", "folded"])
    def test_are_those_of_asking_everywhere(self, name: str, seed: int):
        level = levels_of(named(strip(8, 3)))[-1]
        x = placed(level, SHAPES[name])
        mesh, fresh = ClothMesh(level, ALL), ClothMesh(level, ALL)
        chosen = torch.Generator().manual_seed(seed)
        known, compared, changed = None, 0, 0
        for _ in range(8):
            moved = torch.rand(len(x), generator=chosen) < 0.08
            x = torch.where(moved.unsqueeze(1), x + 0.3 * EDGE * torch.randn(x.shape, generator=chosen), x)
            for each in (mesh, fresh):
                each.move(x)
            everywhere = fresh.crossings(everything(level))
            assert everywhere.count == len(crossings(Soup.of(level, x)))
            if known is not None and known.all_listed:
                since = mesh.crossings_since(known, moved)
                assert listed(since) == listed(everywhere)
                assert since.count == everywhere.count
                compared, changed = compared + 1, changed + (listed(known) != listed(since))
            known = everywhere
        assert compared > 1
        assert changed > 1

    def test_what_did_not_move_is_not_asked(self, monkeypatch: pytest.MonkeyPatch):
        level = levels_of(named(strip(24, 3)))[-1]
        mesh = ClothMesh(level, ALL)
        mesh.move(placed(level, folded))
        asked: list[int] = []
        ask = ClothMesh.crossings
        monkeypatch.setattr(
            ClothMesh, "crossings", lambda own, busy: (asked.append(int(busy.sum())), ask(own, busy))[1]
        )
        moved = torch.zeros(level.vertex_count, dtype=torch.bool)
        moved[0] = True
        mesh.crossings_since(Crossings.none(moved.device), moved)
        assert 0 < asked[0] < level.vertex_count // 4


class TestLooks:
    def test_a_mesh_sees_what_is_written_into_its_tensor(self):
        level = levels_of(named(square(4)))[-1]
        mesh = ClothMesh(level, ALL)
        x = placed(level, SHAPES["crumpled more"])
        flat = level.rest.clone()
        mesh.move(flat)
        assert mesh.crossings(everything(level)).count == 0
        assert float(mesh.normals()[:, 1].abs().min()) > 0.99
        flat.copy_(x)
        mesh.move(flat)
        assert mesh.crossings(everything(level)).count == len(crossings(Soup.of(level, x)))
        assert float(mesh.normals()[:, 1].abs().min()) < 0.9

    def test_a_view_looks_again_where_its_tensor_was_written_to(self):
        garments = [named(square(4))]
        levels = levels_of(*garments)
        view = view_of(levels, garments, levels[-1].rest)
        x = placed(levels[-1], SHAPES["crumpled more"])
        first = view.look(x)
        assert view.look(x) is first
        x[:] = levels[-1].rest
        assert first.crossings.count > 0
        assert view.look(x).crossings.count == 0

    @pytest.mark.parametrize("local", [0.0, 0.2, 2.0])
    def test_looking_beside_what_moved_finds_the_same(self, local: float, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(cloth, "LOCAL", local)
        garments = [named(square(4))]
        levels = levels_of(*garments)
        view = view_of(levels, garments, levels[-1].rest)
        chosen = torch.Generator().manual_seed(3)
        x = placed(levels[-1], crumpled)
        for share in (0.0, 0.05, 0.1, 0.5, 0.05):
            moved = torch.rand((len(x), 1), generator=chosen) < share
            x = torch.where(moved, x + 0.5 * EDGE * torch.randn(x.shape, generator=chosen), x)
            assert view.look(x).crossings.count == len(crossings(Soup.of(levels[-1], x)))

    def test_mending_leaves_all_else_where_it_was_to_the_last_bit(self):
        garments = [named(strip(24, 3))]
        levels = levels_of(*garments)
        base = placed(levels[-1], folded)
        view = view_of(levels, garments, base)
        x = base + 1e-3 * torch.randn(base.shape, generator=torch.Generator().manual_seed(0))
        lowest = int(base[:, 1].argmin())
        x[lowest, 1] += 0.02
        if not view.look(x).crossings.count:
            x[lowest, 1] += 0.02
        assert view.look(x).crossings.count > 0
        mended = view.mend(x)
        assert mended.crossings.count == 0
        still = (mended.x == x).all(dim=1)
        assert 0.2 < float(still.float().mean()) < 1.0
