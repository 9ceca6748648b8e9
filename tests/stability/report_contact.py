"""Measurements of the stability report where cloth touches bodies, itself or other garments: S18 to S28 and S30.

Each takes a method's name. Bodies of the scenes are those of `test_contact_bodies.py` beside it.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from bodies import ball, box, flipped, pane, tube
from brute import between
from cloth import DOWN, Answer, base_of
from folds import EDGE, Cloth, curved, frame_with, named, refiner_with, sewn, square
from report_solver import Result, under
from scenes import shot_of, sleeve
from sheets import garment_of
from test_contact import MESH as WIDE
from test_contact import REST as WIDE_REST
from test_contact import draped
from test_contact_bodies import KINDS, STEP, STILL, bodies, closing, jaws, needles
from test_tangles import cornered, dented

from physgraph_usd.solver.colliders.pose import Pose
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.mesh.topology import PolygonMesh

SHEET = square(8)
REST = SHEET[1]
ACROSS = 0.3
"""Side of the bodies between layers [m]."""


THICK = 1e-3
"""Thickness of the fabric [m]."""
WEIGHTLESS = np.zeros(3)


def faces_of(cloth: Cloth, level: int = 1) -> np.ndarray:
    """Triangles of the fine cloth."""
    chain = refine_garments([garment_of(*cloth)], [level])[0]
    mesh: PolygonMesh = chain[-1].mesh if chain else cloth[0]
    return mesh.triangulate().triangles.astype(np.int64)


def told(answer: Answer, which: str, name: str = "crossings") -> int:
    """What the report says of cloth through cloth."""
    return answer.telemetry[0]["contact"]["cloth"][which][name]


def counted(answer: Answer, *cloths: Cloth) -> int:
    """Edges of either garment through faces of the other, by brute force."""
    return between(answer.points, [faces_of(cloth) for cloth in cloths])


def crossed(kind: str) -> tuple[list[Cloth], list[np.ndarray]]:
    """Two sheets that start through one another."""
    cloths = [square(12, edge=0.5 * EDGE), square(10, edge=0.5 * EDGE)]
    lower, upper = (cloth[1] for cloth in cloths)
    upper = upper + np.array([0.0037, 0.0, 0.0051])
    tilted = upper + np.outer(0.3 * upper[:, 0] + 0.11 * upper[:, 2], [0.0, 1.0, 0.0])
    return cloths, [lower, {"dented": dented(upper), "cornered": cornered(upper), "tilted": tilted}[kind]]


def tube_of_cloth() -> Cloth:
    """An open upright tube, as a sleeve."""
    mesh, points = sleeve(8, 5, edge=EDGE)
    return mesh, points[:, [1, 2, 0]] + np.array([0.002, 0.13 * EDGE, 0.003])


def halves() -> tuple[list[Cloth], list[np.ndarray], np.ndarray, np.ndarray]:
    """A sheet cut in two along x = 0: cloths, cages, and fine vertices of the seam on either side, in order."""
    left = square(4)
    cloths = [(left[0], left[1] + np.array([-0.1, 0.0, 0.0])), (left[0], left[1] + np.array([0.1, 0.0, 0.0]))]
    fine = [base_of(*cloth, 1) for cloth in cloths]
    seams = [np.flatnonzero(np.abs(points[:, 0]) < 1e-9) for points in fine]
    seams = [which[np.argsort(points[which, 2])] for which, points in zip(seams, fine, strict=True)]
    return cloths, [cloth[1] for cloth in cloths], seams[0], seams[1]


def seam_gap(gravity: np.ndarray, squeeze: float, **options: Any) -> float:
    """How far the seam of two halves opens at most [m]."""
    cloths, cages, left, right = halves()
    garments = [named(cloth, name) for cloth, name in zip(cloths, "AB", strict=True)]
    cages = [cage * np.array([1.0 - squeeze, 1.0, 1.0]) for cage in cages]
    answer = refiner_with(sewn(garments, *cages), gravity=gravity, **options).solve(frame_with(cages))
    return float(np.linalg.norm(answer.points[0][left] - answer.points[1][right], axis=1).max())


def inside(answer: Answer) -> int:
    """Vertices inside bodies."""
    return sum(body["inside"] for body in bodies(answer))


def none_of(count: int, what: str) -> Result:
    """A count that must be nothing."""
    return Result(count == 0, f"{count} {what}")


def s18_open(method: str) -> Result:
    """Vertices pushed through open tubes and panes, wound either way and both."""
    wrong = 0
    for turn in (0.0, 0.5, 1.0):
        points, triangles = flipped(tube(0.15, 0.5), turn)
        one = refiner_with([named((WIDE, WIDE_REST))], ["mesh"], level=2, integrator=method)
        fine = one.solve(frame_with([draped(0.152)], (points[:, [2, 0, 1]], triangles))).points[0]
        over = (np.abs(fine[:, 0]) < 0.24) & (np.abs(fine[:, 2]) < 0.1)
        wrong += int((np.linalg.norm(fine[over][:, 1:], axis=1) < 0.149).sum())
        for below in (1.0, -1.0):
            cage = REST + np.array([0.0, 0.001 * below, 0.0])
            one = refiner_with([named(SHEET)], ["mesh"], gravity=below * DOWN, integrator=method)
            fine = one.solve(frame_with([cage], flipped(pane(2 * ACROSS), turn))).points[0]
            wrong += int((below * fine[:, 1] <= 0).sum())
    return none_of(wrong, "through")


def s19_thin(method: str) -> Result:
    """Vertices of two layers that change sides of a card of 0.2 mm or of a pane between them."""
    wrong = 0
    for soup in (box((ACROSS, 0.0002, ACROSS)), pane(ACROSS)):
        for layers in (0.0006, 0.003):
            cages = [REST + np.array([0.0, side * layers, 0.0]) for side in (1.0, -1.0)]
            garments = [named(SHEET, "Upper"), named(SHEET, "Lower")]
            answer = refiner_with(garments, ["mesh"], integrator=method).solve(frame_with(cages, soup))
            for side, points in zip((1.0, -1.0), answer.points, strict=True):
                over = (np.abs(points[:, [0, 2]]) < 0.47 * ACROSS).all(axis=1)
                wrong += int((side * points[over, 1] <= 0).sum())
    return none_of(wrong, "on the wrong side")


def s20_deep(method: str) -> Result:
    """Vertices left inside of those that start 15 cm deep in a ball, or past the middle of a flat body."""
    one = refiner_with([named((WIDE, WIDE_REST))], ["mesh"], level=2, integrator=method)
    left = inside(one.solve(frame_with([draped(0.05)], ball(0.2, level=4))))
    points, triangles = ball(0.2, level=4)
    cage = curved(REST * 1.0) + np.array([0.0, 0.04, 0.0])
    cage[np.linalg.norm(REST, axis=1) < 0.06, 1] = -0.02
    one = refiner_with([named(SHEET)], ["mesh"], level=2, integrator=method)
    left += inside(one.solve(frame_with([cage], (points * np.array([1.0, 0.5, 1.0]), triangles))))
    return none_of(left, "left inside")


def s21_pinched(method: str) -> Result:
    """Farthest move of cloth between jaws in 50 more steps, from its cage between overlapping ones, and from frame to
    frame while those stay closed [mm].

    The first must be under its thickness, the second under a cage edge, the third under what one sees.
    """
    settles, farthest = 0.0, 0.0
    restless = max(closing(stays=8, integrator=method)[-8:])
    for kind, kinds in KINDS.items():
        frame = frame_with([REST], *jaws(0.0005, kind))
        runs = [
            refiner_with([named(SHEET)], kinds, steps=n, integrator=method).solve(frame).points[0] for n in (50, 100)
        ]
        settles = max([settles, *(np.linalg.norm(b - a, axis=1).max() for a, b in pairwise(runs))])
        frame = frame_with([REST], *jaws(-0.005, kind))
        found = refiner_with([named(SHEET)], kinds, steps=50, integrator=method).solve(frame).points[0]
        farthest = max(farthest, np.linalg.norm(found - base_of(SHEET[0], REST, 1), axis=1).max())
    held = settles < THICK and farthest < EDGE and restless < 2 * STILL
    return Result(bool(held), ", ".join(f"{1e3 * each:.2g} mm" for each in (settles, farthest, restless)))


def s22_swallowed(method: str) -> Result:
    """Vertices of a sheet wholly inside a body that are neither out nor told; and whether the filter changes a bit."""
    soup = ball(0.5, level=3)
    answer = refiner_with([named(SHEET)], ["mesh"], integrator=method).solve(frame_with([REST], soup))
    out = int((np.linalg.norm(answer.points[0], axis=1) > 0.49).sum())
    untold = max(len(answer.points[0]) - out - sum(each["inside"] + each["pinched"] for each in bodies(answer)), 0)
    alone = refiner_with([named(SHEET)], integrator=method).solve(frame_with([REST])).points[0]
    far = refiner_with([named(SHEET)], integrator=method).solve(frame_with([REST], soup)).points[0]
    held = untold == 0 and bool(np.isfinite(answer.points[0]).all()) and np.array_equal(alone, far)
    return Result(held, f"{untold} untold")


def s23_on_the_surface(method: str) -> Result:
    """How far a sheet that starts exactly on a box slides to the side [mm]; all of it must rise."""
    cage = REST + np.array([0.0, 0.1, 0.0])
    answer = refiner_with([named(SHEET)], ["mesh"], integrator=method).solve(frame_with([cage], box((0.6, 0.2, 0.6))))
    lifted = answer.points[0] - base_of(SHEET[0], cage, 1)
    slides = float(np.abs(lifted[:, [0, 2]]).max())
    return Result(bool((lifted[:, 1] > 2e-4).all()) and slides < 1e-4, f"{1e3 * slides:.2g} mm")


def s24_crossed(method: str) -> Result:
    """Crossings left of two sheets that start through one another in three ways; none may be."""
    said, held = [], True
    for kind in ("dented", "cornered", "tilted"):
        cloths, cages = crossed(kind)
        garments = [named(cloth, name) for cloth, name in zip(cloths, "AB", strict=True)]
        answer = refiner_with(garments, gravity=WEIGHTLESS, integrator=method).solve(frame_with(cages))
        before, after = told(answer, "before"), counted(answer, *cloths)
        said.append(f"{before} to {after}")
        held &= after == 0
    return Result(held, ", ".join(said))


def s25_contours(method: str) -> Result:
    """Crossings of a sleeve through a torso, before and after, and the farthest move in cage edges; under two."""
    sheet, sleeve = square(6), tube_of_cloth()
    garments = [named(sheet, "Torso"), named(sleeve, "Sleeve", bent_rest=True)]
    cages = [sheet[1], sleeve[1]]
    answer = refiner_with(garments, gravity=WEIGHTLESS, integrator=method).solve(frame_with(cages))
    before, after = told(answer, "before"), counted(answer, sheet, sleeve)
    moved = farthest(answer, [sheet, sleeve], cages) / EDGE
    return Result(after <= before and moved < 2.0, f"{before} to {after}, {moved:.2g} edges")


def farthest(answer: Answer, cloths: Sequence[Cloth], cages: Sequence[np.ndarray]) -> float:
    """Farthest move of any vertex from the upsampled cage [m]."""
    bases = [base_of(cloth[0], cage, 1) for cloth, cage in zip(cloths, cages, strict=True)]
    return max(float(np.linalg.norm(a - b, axis=1).max()) for a, b in zip(answer.points, bases, strict=True))


def s26_stacked(method: str) -> Result:
    """Farthest drift of ten layers at half a thickness, in thicknesses."""
    cloth = square(4)
    cages = [cloth[1] + np.array([0.0, 0.5 * THICK * layer, 0.0]) for layer in range(10)]
    garments = [named(cloth, f"L{layer}") for layer in range(10)]
    answer = refiner_with(garments, gravity=WEIGHTLESS, steps=50, integrator=method).solve(frame_with(cages))
    return under(farthest(answer, [cloth] * 10, cages) / THICK, 0.1, " thicknesses")


def s27_scenes(method: str) -> Result:
    """New crossings and vertices inside over three frames through a torus and two over needles."""
    frames = [list(shot_of("torus").frames)]
    heights = ((0.0, 0.0005), (1.0, -0.004))
    frames.append([frame_with([REST + np.array([0.0, h, 0.0])], needles(), time=t) for t, h in heights])
    worse = 0
    for level, run in zip((1, 2), frames, strict=True):
        one = refiner_with([named(SHEET)], ["mesh"], level=level, times=tuple(range(len(run))), integrator=method)
        worse += sum(new_in(one.solve(frame)) for frame in run)
    return none_of(worse, "new")


def new_in(answer: Answer) -> int:
    """Crossings more than in the input, and vertices inside."""
    pairs = zip(bodies(answer, "before"), bodies(answer), strict=True)
    count = sum(max(after["crossings"] - before["crossings"], 0) + after["inside"] for before, after in pairs)
    cloth = answer.telemetry[0].get("contact", {}).get("cloth")
    return count + (max(cloth["after"]["crossings"] - cloth["before"]["crossings"], 0) if cloth else 0)


def s28_seams(method: str) -> Result:
    """How far a seam of two garments opens under weight and pressed together [mm]."""
    gaps = [seam_gap(gravity, squeeze, integrator=method) for gravity, squeeze in ((WEIGHTLESS, 0.0), (DOWN, 0.05))]
    return under(1e3 * max(gaps), 0.1, " mm")


def s30_fast(method: str) -> Result:
    """Vertices inside or under a ball that rises with its sheet by five edges a frame, over four frames."""
    one = refiner_with([named(SHEET)], ["mesh"], times=tuple(range(4)), integrator=method)
    wrong, (points, triangles) = 0, ball(0.15, level=4)
    for time in range(4):
        lift = np.array([0.0, STEP * time, 0.0])
        cage = REST + lift + np.array([0.0, 0.149, 0.0])
        answer = one.solve(frame_with([cage], Pose(points + lift, triangles), time=float(time)))
        over = np.linalg.norm(answer.points[0][:, [0, 2]], axis=1) < 0.05
        wrong += inside(answer) + int((answer.points[0][over, 1] < lift[1] + 0.14).sum())
    return none_of(wrong, "inside or under")
