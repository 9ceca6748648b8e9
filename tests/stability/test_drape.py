"""S38: Cusick's drape test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drape import BANDS, INNER, OUTER, disc, drape, shadow

from physgraph_usd.solver.fabric import PRESETS

BELOW = pytest.mark.xfail(reason="the preset drapes more than is published: docs/fabrics.md", strict=True)


def test_s38_the_shadow_of_a_flat_disc_is_its_area():
    level, rim = disc(0.012)
    points = level.rest.numpy()
    assert shadow(points, level.triangles.numpy()) == pytest.approx(np.pi * OUTER**2, rel=0.01)
    assert np.linalg.norm(points[rim], axis=1) == pytest.approx(OUTER)
    assert np.linalg.norm(points[~level.free[:, 0].numpy()], axis=1).max() <= INNER + 1e-6


@pytest.mark.slow
def test_s38_what_is_stiffer_drapes_less():
    cotton = PRESETS["cotton"]
    found = [drape(replace(cotton, bend=factor * cotton.bend), 7, edge=0.008)[0] for factor in (0.1, 1.0, 10.0, 1000.0)]
    assert found == sorted(found)
    assert found[0] < 25.0
    assert found[-1] > 90.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["silk", *(pytest.param(name, marks=BELOW) for name in ("cotton", "wool", "denim"))])
def test_s38_a_fabric_drapes_as_published(name: str):
    """Leather is left out: by its folds it lies under or over the band's lower end."""
    low, high = BANDS[name]
    assert low <= drape(PRESETS[name], 7)[0] <= high
