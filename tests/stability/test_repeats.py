"""S34, S35, S36: the same bytes each time, equal frames kept, and no drift when a stage is put on its own output."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from cloth import FABRIC, GUIDE, frame_of, group_of, refiner_of, rms, sheet, solved, total, wave
from sheets import garment_of

from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.frame.values import FrameInput
from physgraph_usd.solver.scene import Frame, GarmentFrame

MESH, REST = sheet(8, 6)
TIMES = tuple(float(time) for time in range(1, 9))


def shot() -> list[Frame]:
    return [frame_of(wave(REST, squeeze=0.02 * time, phase=0.2 * time), time) for time in TIMES]


def test_s34_any_number_of_threads_gives_the_same_bytes():
    """Enough elements that each of four threads has its slice."""
    mesh, rest = sheet(60, 60)
    runs = [
        solved(mesh, rest, wave(rest), level=1, dtype=torch.float32, threads=threads, steps=4).points[0].tobytes()
        for threads in (1, 2, 4, 4)
    ]
    assert len(set(runs)) == 1


@pytest.mark.parametrize("seed", [0, 1])
def test_s34_shuffled_frames_are_the_sequential_ones_with_temporal_off(seed: int):
    def refined(frames: list[Frame]) -> dict[float | None, bytes]:
        refiner = refiner_of([garment_of(MESH, REST)], level=1, times=TIMES, dtype=torch.float32, temporal="off")
        return {state.time: state.points[0].tobytes() for state in refiner.refine(frames)}

    frames = shot()
    order = np.random.default_rng(seed).permutation(len(frames))
    assert refined([frames[i] for i in order]) == refined(frames)


def test_s34_the_test_sees_history_where_there_is_one():
    def refined(frames: list[Frame]) -> dict[float | None, bytes]:
        refiner = refiner_of([garment_of(MESH, REST)], level=1, times=TIMES, dtype=torch.float32)
        return {state.time: state.points[0].tobytes() for state in refiner.refine(frames)}

    assert refined(shot()[::-1]) != refined(shot())


@pytest.mark.parametrize("temporal", ["tether", "warm", "off"])
def test_s35_a_hundred_equal_frames_are_one(temporal: str):
    refiner = refiner_of([garment_of(MESH, REST)], level=1, dtype=torch.float32, temporal=temporal)
    states = list(refiner.refine(frame_of(wave(REST), float(time)) for time in range(100)))
    assert len({state.points[0].tobytes() for state in states}) == 1
    assert [state.reused for state in states] == [(False,)] + [(True,)] * 99
    assert [state.time for state in states] == list(range(100))
    assert all("reused" in str(state.telemetry[0]["start"]) for state in states[1:])


@pytest.mark.parametrize("temporal", ["tether", "warm"])
@pytest.mark.parametrize("steps", [4, 12])
def test_s36_ten_passes_over_its_own_output_do_not_drift(temporal: str, steps: int):
    group = group_of(MESH, REST, level=2, temporal=temporal, steps=steps, tolerance=0.0)
    frame = GarmentFrame(wave(REST), FABRIC, GUIDE)
    state, outputs, energies, inputs = None, [], [], []
    for _ in range(11):
        solved = solve_frame(group, FrameInput([frame]), state)
        points, state, telemetry = solved.points, solved.state, solved.telemetry
        outputs.append(points[0])
        energies.append(total(telemetry, "output"))
        inputs.append(total(telemetry, "input"))
    changes = [rms(after - before) / (0.05 / 4) for before, after in pairwise(outputs)]
    assert all(after <= before + 1e-9 * abs(before) for before, after in pairwise(energies)), energies
    assert changes[-1] < 0.5 * changes[0], changes
    assert max(changes[5:]) <= max(changes[:5]), changes
    assert energies[-1] <= inputs[-1]
    assert np.isfinite(outputs[-1]).all()
