"""S18, S19, S22 to S27: open and thin bodies, swallowed cloth, sheets that start on surfaces or through one another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from bodies import Soup, ball, box, flipped, pane, tube
from brute import between
from cloth import DOWN, Answer, base_of
from folds import EDGE, Cloth, frame_with, named, refiner_with, square
from scenes import sleeve
from sheets import garment_of
from test_contact import MESH, draped
from test_contact import REST as WIDE
from test_contact_bodies import bodies, needles
from test_tangles import cornered, dented

from physgraph_usd.solver.level import refine_garments

SHEET = square(8)
REST = SHEET[1]
ACROSS = 0.3
"""Side of the bodies between layers [m]."""
THICK = 1e-3
"""Thickness of the fabric [m]."""
WEIGHTLESS = np.zeros(3)

SLOW = pytest.mark.slow
methods = pytest.mark.parametrize("method", ["physgraph", pytest.param("quasi-newton", marks=SLOW)])


@methods
@pytest.mark.parametrize("turned", [0.5, pytest.param(0.0, marks=SLOW), pytest.param(1.0, marks=SLOW)])
def test_s18_nothing_goes_through_an_open_body_wound_either_way_or_both(method: str, turned: float):
    points, triangles = flipped(tube(0.15, 0.5), turned)
    one = refiner_with([named((MESH, WIDE))], ["mesh"], level=2, integrator=method)
    fine = one.solve(frame_with([draped(0.152)], (points[:, [2, 0, 1]], triangles))).points[0]
    over = (np.abs(fine[:, 0]) < 0.24) & (np.abs(fine[:, 2]) < 0.1)
    assert np.linalg.norm(fine[over][:, 1:], axis=1).min() > 0.149
    for below in (1.0, -1.0):
        cage = REST + np.array([0.0, 0.001 * below, 0.0])
        one = refiner_with([named(SHEET)], ["mesh"], gravity=below * DOWN, integrator=method)
        fine = one.solve(frame_with([cage], flipped(pane(2 * ACROSS), turned))).points[0]
        assert (below * fine[:, 1] > 0.0).all()


@methods
@pytest.mark.parametrize("layers", [0.0006, 0.003])
@pytest.mark.parametrize("between_them", [box((ACROSS, 0.0002, ACROSS)), pane(ACROSS)], ids=["card", "pane"])
def test_s19_two_layers_stay_on_their_sides_of_what_is_thin(method: str, layers: float, between_them: Soup):
    cages = [REST + np.array([0.0, side * layers, 0.0]) for side in (1.0, -1.0)]
    garments = [named(SHEET, "Upper"), named(SHEET, "Lower")]
    answer = refiner_with(garments, ["mesh"], integrator=method).solve(frame_with(cages, between_them))
    for side, points in zip((1.0, -1.0), answer.points, strict=True):
        over = (np.abs(points[:, [0, 2]]) < 0.47 * ACROSS).all(axis=1)
        assert (side * points[over, 1] > 0.0).all()


@methods
def test_s22_what_stays_in_a_body_that_swallows_the_cloth_is_told(method: str):
    answer = refiner_with([named(SHEET)], ["mesh"], integrator=method).solve(frame_with([REST], ball(0.5)))
    points = answer.points[0]
    assert np.isfinite(points).all()
    told = sum(each["inside"] + each["pinched"] for each in bodies(answer))
    assert told >= int((np.linalg.norm(points, axis=1) <= 0.49).sum())


@methods
def test_s23_a_sheet_exactly_on_a_surface_rises_and_does_not_slide(method: str):
    cage = REST + np.array([0.0, 0.1, 0.0])
    answer = refiner_with([named(SHEET)], ["mesh"], integrator=method).solve(frame_with([cage], box((0.6, 0.2, 0.6))))
    lifted = answer.points[0] - base_of(SHEET[0], cage, 1)
    assert lifted[:, 1].min() > 2e-4
    assert np.abs(lifted[:, [0, 2]]).max() < 1e-4


def crossing(answer: Answer, *cloths: Cloth) -> tuple[int, int]:
    """Crossings that were told of before the solve, and edges of either garment through the other after it."""
    chains = refine_garments([garment_of(*cloth) for cloth in cloths], [1] * len(cloths))
    faces = [chain[-1].mesh.triangulate().triangles.astype(np.int64) for chain in chains]
    return answer.telemetry[0]["contact"]["cloth"]["before"]["crossings"], between(answer.points, faces)


@methods
@pytest.mark.parametrize("kind", ["dented", "cornered", "tilted"])
def test_s24_two_sheets_that_start_through_one_another_come_apart(method: str, kind: str):
    lower, upper = square(12, edge=0.5 * EDGE), square(10, edge=0.5 * EDGE)
    points = upper[1] + np.array([0.0037, 0.0, 0.0051])
    tilted = points + np.outer(0.3 * points[:, 0] + 0.11 * points[:, 2], [0.0, 1.0, 0.0])
    cages = [lower[1], {"dented": dented(points), "cornered": cornered(points), "tilted": tilted}[kind]]
    garments = [named(lower, "A"), named(upper, "B")]
    answer = refiner_with(garments, gravity=WEIGHTLESS, integrator=method).solve(frame_with(cages))
    before, after = crossing(answer, lower, upper)
    assert before > 0
    assert after == 0


def farthest(answer: Answer, cloths: Sequence[Cloth], cages: Sequence[np.ndarray]) -> float:
    """Farthest move of any vertex from the upsampled cage [m]."""
    bases = [base_of(cloth[0], cage, 1) for cloth, cage in zip(cloths, cages, strict=True)]
    return max(float(np.linalg.norm(a - b, axis=1).max()) for a, b in zip(answer.points, bases, strict=True))


@methods
def test_s25_a_sleeve_through_a_torso_crosses_no_more_and_stays_near(method: str):
    torso, (mesh, points) = square(6), sleeve(8, 5, edge=EDGE)
    arm = mesh, points[:, [1, 2, 0]] + np.array([0.002, 0.13 * EDGE, 0.003])
    garments = [named(torso, "Torso"), named(arm, "Sleeve", bent_rest=True)]
    cages = [torso[1], arm[1]]
    answer = refiner_with(garments, gravity=WEIGHTLESS, integrator=method).solve(frame_with(cages))
    before, after = crossing(answer, torso, arm)
    assert after <= before
    assert farthest(answer, [torso, arm], cages) < 2.0 * EDGE


@methods
def test_s26_ten_layers_at_half_their_thickness_do_not_drift(method: str):
    cloth = square(4)
    cages = [cloth[1] + np.array([0.0, 0.5 * THICK * layer, 0.0]) for layer in range(10)]
    garments = [named(cloth, f"L{layer}") for layer in range(10)]
    answer = refiner_with(garments, gravity=WEIGHTLESS, steps=50, integrator=method).solve(frame_with(cages))
    assert farthest(answer, [cloth] * 10, cages) < 0.1 * THICK


@methods
def test_s27_cloth_laid_on_needles_is_on_none(method: str):
    one = refiner_with([named(SHEET)], ["mesh"], level=2, times=(0.0, 1.0), integrator=method)
    for time, height in ((0.0, 0.0005), (1.0, -0.004)):
        answer = one.solve(frame_with([REST + np.array([0.0, height, 0.0])], needles(), time=time))
        for before, after in zip(bodies(answer, "before"), bodies(answer), strict=True):
            assert after["inside"] == 0
            assert after["crossings"] <= before["crossings"]
