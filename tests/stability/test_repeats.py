"""S34: frames by themselves are the same in any order."""

from __future__ import annotations

import numpy as np
import torch
from cloth import frame_of, refiner_of, sheet, wave
from sheets import garment_of

from physgraph_usd.solver.scene import Frame

MESH, REST = sheet(8, 6)
TIMES = tuple(float(time) for time in range(1, 9))


def shot() -> list[Frame]:
    return [frame_of(wave(REST, squeeze=0.02 * time, phase=0.2 * time), time) for time in TIMES]


def test_s34_shuffled_frames_are_the_sequential_ones_with_temporal_off():
    def refined(frames: list[Frame]) -> dict[float | None, bytes]:
        refiner = refiner_of([garment_of(MESH, REST)], level=1, times=TIMES, dtype=torch.float32, temporal="off")
        return {state.time: state.points[0].tobytes() for state in refiner.refine(frames)}

    frames = shot()
    order = np.random.default_rng(0).permutation(len(frames))
    assert refined([frames[i] for i in order]) == refined(frames)
