"""No patch of refined cloth crosses more often than the subdivided cage: else it follows that cage."""

from __future__ import annotations

import numpy as np
import torch
from folds import levels_of, named, square, view_of
from test_tangles import pair

from physgraph_usd.solver.forces.seam import Seam
from physgraph_usd.solver.frame.no_worse import STAY, Faults, no_worse, patches_worse
from physgraph_usd.solver.level import Placed

APART = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)


def two_pairs() -> tuple:
    """Contact of two pairs of sheets that cross, their subdivided cages, and the first vertex of the second pair."""
    garments = [named(square(4), name) for name in "ABCD"]
    levels = levels_of(*garments, dtype=torch.float64)
    base = pair("cornered")[1].double()
    return view_of(levels, garments), levels[-1], torch.cat([base, base + APART])


def kept(view, level, x, smooth, *, before=None):
    none = torch.zeros(level.from_coarse.shape[1], dtype=torch.int64)
    return no_worse(view, Placed(x), smooth, from_coarse=level.from_coarse, before=none if before is None else before)


def test_only_the_pair_that_crosses_more_follows_its_cage():
    view, level, smooth = two_pairs()
    number, x = level.vertex_garment, smooth.clone()
    x[number == 1, 1] -= 0.004
    x[number == 3, 1] += 0.012
    y, left, told = kept(view, level, x, smooth)
    first, counts = number < 2, [len(Faults.of(view, view.detect(each)).corners) for each in (x, smooth, y)]
    crossing = torch.zeros_like(first)
    crossing[torch.cat([Faults.of(view, view.detect(each)).corners.reshape(-1) for each in (x, smooth)]).long()] = True
    crossing &= first
    moved = (y != x).any(dim=1)
    assert torch.equal(y[crossing], smooth[crossing])
    assert 0 < int(moved.sum()) < 0.5 * int(first.sum())
    assert not bool((moved & ~first).any())
    assert counts[2] < min(counts[:2])
    assert (told["solved"], told["subdivided"], told["left"]) == tuple(counts)
    assert told["vertices"] >= int(crossing.sum())
    assert set(left.tolist()) == {0, STAY}


def test_cloth_that_crosses_less_is_as_solved():
    view, level, smooth = two_pairs()
    x = smooth.clone()
    x[level.vertex_garment == 1, 1] += 0.012
    placed = Placed(x)
    none = torch.zeros(level.from_coarse.shape[1], dtype=torch.int64)
    y, left, told = no_worse(view, placed, smooth, from_coarse=level.from_coarse, before=none)
    assert y is placed
    assert not left.any()
    assert told == {}


def test_cloth_follows_for_some_frames_and_returns_at_once():
    view, level, smooth = two_pairs()
    smooth[level.vertex_garment % 2 == 1, 1] += 0.1  # Nothing crosses any more.
    x = smooth.clone()
    x[:, 0] += 0.001
    left = torch.full((level.from_coarse.shape[1],), STAY)
    same = []
    for _ in range(STAY):
        y, left, _ = kept(view, level, x, smooth, before=left)
        same.append((torch.equal(y, smooth), torch.equal(y, x)))
    assert same == [(True, False)] * (STAY - 1) + [(False, True)]


def test_seams_between_cloth_that_follows_and_cloth_as_solved_stay_closed():
    garments = [named(square(4), name) for name in "AB"]
    levels = levels_of(*garments, dtype=torch.float64)
    level, smooth = levels[-1], pair("cornered")[1].double()
    follows = level.vertex_garment == 0
    smooth[~follows, 1] += 0.1
    ends = [int(torch.nonzero(follows)[0]), int(torch.nonzero(~follows)[0])]
    view = view_of(levels, garments, seam=Seam(level, np.array([ends])))
    x = view.closed(smooth + torch.tensor([0.001, 0.0, 0.0], dtype=torch.float64))
    before = torch.where(levels[0].vertex_garment == 0, STAY, 0).long()
    y, _, _ = kept(view, level, x, smooth, before=before)
    assert not torch.equal(y, x)
    assert torch.equal(y[ends[0]], y[ends[1]])


def test_a_patch_is_judged_by_all_of_its_faults_together():
    """Few vertices less inside a body are no reason to keep cloth that crosses much more often, and the other way."""
    view, level, _ = two_pairs()
    pairs = torch.zeros((0, 5), dtype=torch.int64)
    triangles = level.triangles[:40].long()
    many = torch.cat([triangles, triangles[:, :2]], dim=1)
    inside = triangles[:10, 0]
    crossing, within = Faults(many, inside[:0]), Faults(pairs, inside)
    assert patches_worse(view, crossing, within)[triangles].all()
    assert not patches_worse(view, within, crossing).any()
