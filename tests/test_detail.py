"""Detail carried in the moving frames of the coarse surface: exact under rigid motion, its own inverse at rest."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cloth import group_of, sheet, wave
from meshes import mesh_of
from sheets import rotation

from physgraph_usd.solver.frame.from_cage import MovingFrames

MESH, REST = sheet(6, 4)
GROUP = group_of(MESH, REST, level=2)
FRAMES: MovingFrames = GROUP.moving_frames
FINEST = GROUP.levels[-1]


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(array, dtype=torch.float64)


def fine(coarse: torch.Tensor, *, seed: int = 0) -> torch.Tensor:
    """A fine surface: the smooth base with noise of a fifth of an edge on it."""
    noise = torch.randn(FINEST.rest.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return FINEST.smooth_base.apply(coarse) + 0.01 * noise


@pytest.mark.parametrize("seed", range(2))
def test_rigid_motion_carries_detail_exactly(seed: int):
    coarse = tensor(wave(REST, height=0.02))
    turn, shift = tensor(rotation(seed)), tensor(np.array([0.3, -2.0, 5.0]))
    x = fine(coarse)
    predicted, *_ = FRAMES.predict(coarse, x, coarse @ turn.T + shift)
    assert torch.allclose(predicted, x @ turn.T + shift, rtol=0, atol=1e-12)


def test_bending_turns_detail_with_the_place_it_is_at():
    """A bump on a flap that folds up by a right angle points where the flap's normal points."""
    coarse = tensor(REST)
    x = FINEST.smooth_base.apply(coarse)
    far = int(x[:, 0].argmax())
    bumped = x.clone()
    bumped[far, 2] += 0.01
    folded = np.where(REST[:, :1] > 0.11, np.stack([0 * REST[:, 0] + 0.1, REST[:, 1], REST[:, 0] - 0.1], axis=1), REST)
    predicted, *_ = FRAMES.predict(coarse, bumped, tensor(folded))
    bump = predicted - FINEST.smooth_base.apply(tensor(folded))
    assert torch.allclose(bump[far], tensor(np.array([-0.01, 0.0, 0.0])), rtol=0, atol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_a_small_turn_moves_no_detail_far(seed: int):
    """Each vertex's first edge, and so its tangent, points anywhere: between two that oppose there is still a turn."""
    rng = np.random.default_rng(seed)
    rest = REST + 0.01 * rng.uniform(-1, 1, REST.shape) * [1, 1, 0]
    faces = MESH.indices.reshape(-1, 3)[rng.permutation(len(MESH.indices) // 3)]
    turned = [np.roll(face, turn).tolist() for face, turn in zip(faces, rng.integers(3, size=len(faces)), strict=True)]
    group = group_of(mesh_of(turned), rest, level=2)
    frames, finest = group.moving_frames, group.levels[-1]
    before, after = tensor(wave(rest, height=0.02)), tensor(wave(rest, height=0.022))
    detail = 0.01 * tensor(rng.normal(size=(finest.vertex_count, 3)))
    x = finest.smooth_base.apply(before) + detail
    moved = frames.predict(before, x, after)[0] - finest.smooth_base.apply(after) - detail
    assert 0.01 < float((moved.norm(dim=1) / detail.norm(dim=1)).max()) < 0.06
