"""S38: stretched, sheared, bent and hanging sheets against closed formulas, on every kind of mesh.

The bounds are those of benchmarks/results/calibration.md: 5% where the mesh can do it, the true deviation where it
cannot.
"""

from functools import cache

import numpy as np
import pytest
from calibration import (
    BENT,
    CHAIN,
    CHAIN_LENGTH,
    CHAIN_SPAN,
    YOUNGS,
    expected_cantilever,
    measure_bend,
    measure_cantilever,
    measure_plane,
)
from probes import Spread, catenary_sag, hanging_chain, plane_constants
from sheets import KINDS

measure_bend, measure_cantilever = cache(measure_bend), cache(measure_cantilever)
GOOD = ("equilateral", "irregular", "quads")
EXACT = ("equilateral", "quads")


def near(spread: Spread, value: float, tolerance: float) -> bool:
    return spread.low > value - tolerance and spread.high < value + tolerance


SLIVERS = 0.01
"""What the softer slivers of irregular triangles take from a sheet's stiffness."""


@pytest.mark.parametrize("kind", KINDS)
def test_s38_membrane_shears_as_asked_for(kind: str):
    """Along warp and weft Y, nu and G are the ones asked for; on the bias they follow from those."""
    asked = np.array([[9 / 8, 3 / 8, 0], [3 / 8, 9 / 8, 0], [0, 0, 0.1]])
    expected = plane_constants(asked)
    found, few = measure_plane(kind, 0.1 * YOUNGS), SLIVERS if kind == "irregular" else 1e-5
    for spread, other in ((found.youngs, expected["Y"]), (found.poisson, expected["nu"]), (found.shear, expected["G"])):
        assert (spread.mean, spread.low, spread.high) == pytest.approx((other.mean, other.low, other.high), rel=few)
    assert (found.pulled, found.narrowed) == pytest.approx((1.0, 1 / 3), rel=few)


@pytest.mark.parametrize("kind", EXACT)
def test_s38_springs_are_isotropic_with_a_third(kind: str):
    found = measure_plane(kind, None)
    assert near(found.youngs, 1.0, 1e-5)
    assert near(found.poisson, 1 / 3, 1e-5)
    assert near(found.shear, 0.375, 1e-5)
    assert (found.pulled, found.narrowed) == pytest.approx((1.0, 1 / 3), rel=0.02)


def test_s38_springs_on_irregular_triangles():
    found = measure_plane("irregular", None)
    assert found.youngs.mean == pytest.approx(1.0, abs=0.05)
    assert near(found.youngs, 1.0, 0.08)
    assert near(found.poisson, 1 / 3, 0.04)
    assert near(found.shear, 0.375, 0.04)


def test_s38_springs_on_one_way_diagonals_deviate_as_documented():
    found = measure_plane("quads, one way", None)
    assert (found.youngs.low, found.youngs.high) == pytest.approx((1 / 3, 4 / 3), rel=1e-3)
    assert (found.pulled, found.narrowed) == pytest.approx((1.0, 0.0), abs=1e-5)


@pytest.mark.parametrize(
    ("kind", "mean", "spread"), [(GOOD[0], 1e-3, 1e-3), (GOOD[1], 0.08, 0.12), (GOOD[2], 5e-3, 5e-3)]
)
def test_s38_bending_stiffness_in_every_direction(kind: str, mean: float, spread: float):
    found = measure_bend(kind)
    assert found.rigidity.mean == pytest.approx(1.0, abs=mean)
    assert near(found.rigidity, 1.0, spread)
    assert near(found.poisson, BENT[kind], 0.06)


def test_s38_bending_on_one_way_diagonals_deviates_as_documented():
    found = measure_bend("quads, one way")
    assert (found.rigidity.low, found.rigidity.high) == pytest.approx((0.75, 3.0), rel=1e-3)


@pytest.mark.parametrize("kind", EXACT)
def test_s38_cylinder(kind: str):
    assert near(measure_bend(kind).rolled, 1.0, 5e-3)


@pytest.mark.parametrize("kind", GOOD)
def test_s38_cantilever_angle(kind: str):
    angle, rigidity = measure_cantilever(kind)
    assert angle == pytest.approx(expected_cantilever(BENT[kind]), rel=0.05)
    assert rigidity == pytest.approx(1.0 - BENT[kind] ** 2, abs=0.05)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "irregular"])
def test_s38_catenary(kind: str):
    tolerance = 0.025 if kind == "equilateral" else 0.005
    sag = hanging_chain(kind, CHAIN_LENGTH, CHAIN_SPAN, CHAIN)
    assert sag == pytest.approx(catenary_sag(CHAIN_LENGTH, CHAIN_SPAN), rel=tolerance)
