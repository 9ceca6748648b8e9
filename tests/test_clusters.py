"""Clusters of vertices, edges and faces: each part is in one, and each hangs together."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from folds import levels_of, named, square
from scipy.sparse import csgraph

from physgraph_usd.solver.collide.clusters import Clusters
from physgraph_usd.solver.level import Level
from physgraph_usd.solver.mesh.topology import adjacency, owned_sides


def clusters_of(level: Level) -> Clusters:
    edges, triangles = level.edges.numpy(), level.triangles.numpy()
    return Clusters(level, adjacency(edges, level.vertex_count), owned_sides(edges, triangles))


def test_every_part_is_in_one():
    level = levels_of(named(square(4)))[-1]
    clusters = clusters_of(level)
    for numbers, count in (
        (clusters.faces[2], len(level.triangles)),
        (clusters.edges[2], len(level.edges)),
        (clusters.vertices[1], level.vertex_count),
    ):
        assert sorted(numbers.numpy().tolist()) == list(range(count))


def test_each_hangs_together_and_is_of_one_garment():
    level = levels_of(named(square(3), "A"), named(square(4), "B"))[-1]
    clusters = clusters_of(level)
    first, vertices = (np.asarray(each.numpy(), dtype=np.int64) for each in clusters.vertices)
    beside = adjacency(level.edges.numpy(), level.vertex_count)
    for a, b in pairwise(first):
        own = vertices[a:b]
        assert len(set(level.vertex_garment.numpy()[own].tolist())) == 1
        assert csgraph.connected_components(beside[own][:, own])[0] == 1
    assert 2 * clusters.count < level.vertex_count


def test_they_are_the_same_each_time():
    level = levels_of(named(square(4)))[-1]
    first, second = clusters_of(level), clusters_of(level)
    for one, other in zip((*first.faces, *first.edges), (*second.faces, *second.edges), strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())
