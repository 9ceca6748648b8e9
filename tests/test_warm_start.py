"""Which frames start from the last one's detail: those whose cloth it does not tear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cloth import frame_of, group_of, sheet, wave

from physgraph_usd.group import Group
from physgraph_usd.resolution import edge_strain

MESH, REST = sheet(8, 6)


def said(group: Group, *, strain: float, squeeze: float = 0.0) -> tuple[str, float]:
    """Where a frame starts whose carried detail strains the cloth so much, and by how much it does.

    The detail of a solved frame is enlarged until the 99th percentile of the edges' strain is what is asked for.
    """
    frames = list(frame_of(wave(REST)).garments)
    kept = group.solve(frames, None, at=None).carried
    cage = REST * np.array([1.0 - squeeze, 1.0, 1.0])
    world = torch.as_tensor(cage)
    coarse = group._tensor(cage - cage.mean(axis=0))
    low, high, found, here = 0.0, 1e4, "", 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        detailed = replace(kept, coarse=world, detail=middle * kept.detail)
        predicted, found = group._predict(detailed, coarse, world)
        moved = group._frames.predict(replace(detailed, coarse=coarse), coarse)[0]
        here = edge_strain(group.levels[-1], moved if predicted is None else predicted)["p99"]
        low, high = (middle, high) if here < strain else (low, middle)
    return found, here


@pytest.mark.parametrize(
    ("strain", "squeeze", "start"),
    [(0.3, 0.0, "warm"), (0.45, 0.0, "warm"), (0.55, 0.0, "cold"), (0.65, 0.4, "warm"), (1.1, 0.6, "cold")],
)
def test_detail_that_tears_the_cloth_is_not_carried(strain: float, squeeze: float, start: str):
    """Half its length more is too much, or twice what the cage itself is strained by, and its whole length always."""
    found, here = said(group_of(MESH, REST, level=1), strain=strain, squeeze=squeeze)
    assert here == pytest.approx(strain, rel=0.02)
    assert found.startswith(start), found
    assert ("carried detail strains the cloth" in found) == (start == "cold")
