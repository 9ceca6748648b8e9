"""S29, S31: teleports, gaps and odd sample times."""

from typing import Any

import numpy as np
import pytest
import torch
from cloth import Solver, frame_of, refiner_of, sheet, wave
from sheets import garment_of

from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Frame

EDGE = 0.05
MESH, REST = sheet(8, 6, EDGE)
SPIN = np.diag([-1.0, 1.0, -1.0])


def refiner(times: tuple[float, ...], **options: Any) -> Solver:
    return refiner_of([garment_of(MESH, REST)], level=1, times=times, dtype=torch.float32, **options)


def still(time: float) -> np.ndarray:
    return wave(REST, phase=0.1 * time)


JUMPS = {
    "two metres": lambda points: points + np.array([2.0, 0.0, 0.0]),
    "half a turn": lambda points: (points - points.mean(axis=0)) @ SPIN + points.mean(axis=0),
}


def jumping(name: str) -> list[Frame]:
    """Three quiet frames, then the jump, then three quiet ones there."""
    return [frame_of(still(t) if t < 4 else JUMPS[name](still(t)), float(t)) for t in range(1, 7)]


def test_s29_what_moves_smoothly_is_no_teleport():
    """Ten edges a frame, and a twelfth of a turn."""
    points = still(0.0)
    frames = []
    for step in range(6):
        angle = step * np.pi / 6
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        frames.append(frame_of(points @ turn.T + [10 * EDGE * step, 0, 0], float(step)))
    states = refiner(tuple(range(6))).refine(frames)
    assert [state.telemetry[0]["start"] == "cold" for state in states] == [True] + [False] * 5


def starts(times: tuple[float, ...]) -> list[str]:
    states = refiner(times).refine([frame_of(still(time), time) for time in times])
    return [str(state.telemetry[0]["start"]).partition(":")[0] for state in states]


@pytest.mark.parametrize(
    ("times", "cold"),
    [
        ((1, 2, 7, 8), [0, 2]),
        ((1, 2, 3, 4, 5), [0]),
        ((1001, 1002, 1003, 1006, 1007), [0]),
        ((1, 4, 7, 10), [0]),
        ((0.0, 0.5, 1.0, 1.5, 4.0, 4.5), [0, 4]),
        ((-3.5, -2.25, -1.0), [0]),
    ],
)
def test_s31_a_gap_starts_cold_and_an_even_spacing_of_any_size_does_not(times: tuple[float, ...], cold: list[int]):
    assert [index for index, start in enumerate(starts(tuple(map(float, times)))) if start == "cold"] == cold


def test_s31_after_a_gap_the_frame_is_its_cold_start_to_the_bit():
    times = (1.0, 2.0, 7.0, 8.0)
    states = list(refiner(times).refine([frame_of(still(time), time) for time in times]))
    cold = refiner(times).solve(frame_of(still(7.0), 7.0))
    assert states[2].points[0].tobytes() == cold.points[0].tobytes()
    assert "time between samples" in str(states[2].telemetry[0]["start"])


def test_s29_pieces_that_part_by_many_edges_start_cold():
    """No one motion of the whole carries the folds of both along."""
    count, aside = len(REST), np.array([1.0, 0.0, 0.0])
    mesh = PolygonMesh(np.tile(MESH.counts, 2), np.concatenate([MESH.indices, MESH.indices + count]), 2 * count)
    one = refiner_of([garment_of(mesh, np.concatenate([REST, REST + aside]))], level=1, times=(1.0, 2.0))
    one.solve(frame_of(np.concatenate([still(1.0), still(1.0) + aside]), 1.0))
    parted = np.concatenate([still(1.0), still(1.0) + 100 * EDGE * aside])
    assert str(one.solve(frame_of(parted, 2.0)).telemetry[0]["start"]).startswith("cold: ")
