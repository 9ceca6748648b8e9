"""Clothes as characters wear them, far from rest: no more faults than in the subdivided cage, in every frame.

Faults are crossings of cloth with cloth and with bodies, and vertices inside bodies.
"""

from typing import Any

import numpy as np
import pytest
from bodies import BodyMesh
from folds import Cloth, frame_with, named, refiner_with
from fuzz.poses import AROUND, BLEND, PLACES, tube
from meshes import mesh_of

ELBOW = 1
"""Number of the joint that is bent."""


def bent(points: np.ndarray, degrees: float) -> np.ndarray:
    """Points [m] of a limb along x, skinned with the elbow bent about z."""
    turn, pivot = np.radians(degrees), np.array([PLACES[ELBOW], 0.0, 0.0])
    matrix = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    weight = np.clip((points[:, :1] - PLACES[ELBOW]) / BLEND + 0.5, 0.0, 1.0)
    return points + weight * ((points - pivot) @ matrix.T + pivot - points)


def arm(radius: float, degrees: float) -> BodyMesh:
    """A closed arm, its elbow bent."""
    points, quads = tube(radius, -0.05, 0.6, 14)
    ends = np.array([points[:AROUND].mean(axis=0), points[-AROUND:].mean(axis=0)])
    first, last = np.arange(AROUND), len(points) - AROUND + np.arange(AROUND)
    sides = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    caps = [np.stack([np.roll(first, -1), first, np.full(AROUND, len(points))], axis=1)]
    caps += [np.stack([last, np.roll(last, -1), np.full(AROUND, len(points) + 1)], axis=1)]
    return bent(np.concatenate([points, ends]), degrees), np.concatenate([*sides, *caps]).astype(np.int32)


def sleeves(*tubes: tuple[float, float, float, int]) -> Cloth:
    """Sleeves over one another in one mesh, each by its radius, start and end [m], and number of rings."""
    faces, points = list[list[int]](), list[np.ndarray]()
    for radius, start, end, rows in tubes:
        ring, quads = tube(radius, start, end, rows)
        faces += (quads + sum(map(len, points))).tolist()
        points.append(ring)
    return mesh_of(faces), np.concatenate(points)


SLEEVE = (0.056, 0.0, 0.5, 12)
SHIRT, LAYERED = sleeves(SLEEVE), sleeves(SLEEVE, (0.064, 0.08, 0.42, 9))


def faults(telemetry: dict[str, Any], side: str) -> int:
    """Sum of the faults before or after the solve, by the frame's telemetry."""
    contact = telemetry["contact"]
    crossings = contact["cloth"][side]["crossings"]
    return crossings + sum(body[side]["crossings"] + body[side]["inside"] for body in contact["bodies"].values())


def solved(cloth: Cloth, cages: list[np.ndarray], arms: list[BodyMesh]) -> list[tuple[int, int]]:
    """Faults of each frame before and after the solve."""
    solver = refiner_with([named(cloth)], ["mesh"], times=tuple(range(len(cages))))
    frames = [
        frame_with([cage], body, time=float(time)) for time, (cage, body) in enumerate(zip(cages, arms, strict=True))
    ]
    told = [solver.solve(frame).telemetry[0] for frame in frames]
    return [(faults(each, "before"), faults(each, "after")) for each in told]


@pytest.mark.parametrize(("degrees", "share"), [(60.0, 0.25), (110.0, 0.75)])
@pytest.mark.parametrize("cloth", [SHIRT, LAYERED], ids=["one sleeve", "two layers in one mesh"])
def test_a_shot_that_begins_with_a_bent_limb(cloth: Cloth, degrees: float, share: float):
    """At 110 degrees skinning folds the arm through itself, and cloth between its two halves has no way out."""
    poses = [degrees, 0.95 * degrees, 0.9 * degrees]
    for before, after in solved(cloth, [bent(cloth[1], pose) for pose in poses], [arm(0.05, pose) for pose in poses]):
        assert before > 0
        assert after <= share * before


def test_a_body_that_is_hidden_under_its_clothes_by_its_maker():
    """The arm is thicker than the sleeve over it, at rest too."""
    poses = [0.0, 10.0]
    for before, after in solved(SHIRT, [bent(SHIRT[1], pose) for pose in poses], [arm(0.058, pose) for pose in poses]):
        assert before > 100
        assert after == 0


@pytest.mark.parametrize("seed", range(3))
def test_a_sleeve_bunched_into_a_heap(seed: int):
    noise = np.random.default_rng(seed).normal(size=LAYERED[1].shape)
    cages = [LAYERED[1] * [0.25, 1.0, 1.0] + (0.012 + 0.0005 * frame) * noise for frame in range(2)]
    for before, after in solved(LAYERED, cages, [arm(0.04, 0.0)] * 2):
        assert before > 500
        assert after <= before
