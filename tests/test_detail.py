"""Detail carried in the moving frames of the coarse surface: exact under rigid motion, its own inverse at rest."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cloth import group_of, sheet, wave
from meshes import mesh_of
from sheets import rotation

from physgraph_usd.solver.frame.from_cage import MovingFrames
from physgraph_usd.solver.frame.values import State

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


def stored(coarse: torch.Tensor) -> tuple[torch.Tensor, State]:
    x = fine(coarse)
    return x, FRAMES.store(coarse, x)


def test_frames_are_orthonormal_and_right_handed():
    frames = FRAMES.frames(tensor(wave(REST, height=0.03)))
    assert torch.allclose(frames.transpose(1, 2) @ frames, torch.eye(3, dtype=torch.float64).expand_as(frames))
    assert torch.allclose(torch.linalg.det(frames), torch.ones(len(frames), dtype=torch.float64))


def test_frames_turn_with_the_surface():
    coarse, turn = tensor(wave(REST, height=0.03)), tensor(rotation(5))
    assert torch.allclose(FRAMES.frames(coarse @ turn.T), turn @ FRAMES.frames(coarse))


def test_the_third_axis_is_the_normal():
    assert torch.allclose(FRAMES.frames(tensor(REST))[:, :, 2], tensor(np.array([0.0, 0.0, 1.0])))


def test_predict_after_store_with_the_same_cage_is_the_identity():
    coarse = tensor(wave(REST, height=0.02))
    x, kept = stored(coarse)
    predicted, motion, turn = FRAMES.predict(kept, coarse)
    assert torch.allclose(predicted, x, rtol=0, atol=1e-14)
    assert motion == 0.0
    assert turn < 1e-7


@pytest.mark.parametrize("seed", range(3))
def test_rigid_motion_carries_detail_exactly(seed: int):
    coarse = tensor(wave(REST, height=0.02))
    turn, shift = tensor(rotation(seed)), tensor(np.array([0.3, -2.0, 5.0]))
    x, kept = stored(coarse)
    predicted, _, _ = FRAMES.predict(kept, coarse @ turn.T + shift)
    assert torch.allclose(predicted, x @ turn.T + shift, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [0.1, 1.0, 3.0, -2.0])
def test_turn_is_the_angle_of_the_rotation(angle: float):
    coarse = tensor(REST)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = tensor(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]))
    _, _, found = FRAMES.predict(FRAMES.store(coarse, fine(coarse)), coarse @ turn.T)
    assert found == pytest.approx(abs(angle), abs=1e-6)


def test_motion_is_in_mean_cage_edges():
    sides = REST[MESH.indices.reshape(-1, 3)]
    edge = np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2).mean()
    coarse = tensor(REST)
    _, motion, _ = FRAMES.predict(FRAMES.store(coarse, fine(coarse)), coarse + tensor(np.array([0.0, 7 * edge, 0.0])))
    assert motion == pytest.approx(7.0)


def test_bending_turns_detail_with_the_place_it_is_at():
    """A bump on a flap that folds up by a right angle points where the flap's normal points."""
    coarse = tensor(REST)
    x = FINEST.smooth_base.apply(coarse)
    far = int(x[:, 0].argmax())
    bumped = x.clone()
    bumped[far, 2] += 0.01
    folded = np.where(REST[:, :1] > 0.11, np.stack([0 * REST[:, 0] + 0.1, REST[:, 1], REST[:, 0] - 0.1], axis=1), REST)
    predicted, _, _ = FRAMES.predict(FRAMES.store(coarse, bumped), tensor(folded))
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
    kept = frames.store(before, finest.smooth_base.apply(before) + detail)
    moved = frames.predict(kept, after)[0] - finest.smooth_base.apply(after) - detail
    assert 0.01 < float((moved.norm(dim=1) / detail.norm(dim=1)).max()) < 0.06


def test_stretching_does_not_stretch_detail():
    coarse = tensor(REST)
    x, kept = stored(coarse)
    grown, _, _ = FRAMES.predict(kept, 3.0 * coarse)
    before, after = x - FINEST.smooth_base.apply(coarse), grown - FINEST.smooth_base.apply(3.0 * coarse)
    assert torch.allclose(before.norm(dim=1), after.norm(dim=1))


@pytest.mark.parametrize("rest", [np.zeros((3, 3)), np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]])])
def test_a_cage_without_area_gives_finite_frames(rest: np.ndarray):
    frames = group_of(mesh_of([[0, 1, 2]]), rest).moving_frames.frames(tensor(rest))
    assert bool(frames.isfinite().all())


def test_an_isolated_point_and_no_point_at_all():
    mesh = mesh_of([[0, 1, 2]], 4)
    rest = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [5, 5, 5.0]])
    group = group_of(mesh, rest, level=1)
    coarse = tensor(rest)
    x = group.levels[-1].smooth_base.apply(coarse)
    assert torch.allclose(group.moving_frames.predict(group.moving_frames.store(coarse, x), coarse)[0], x)
    empty = group_of(mesh_of([], 0), np.zeros((0, 3)), level=1)
    nothing = torch.zeros((0, 3), dtype=torch.float64)
    assert empty.moving_frames.store(nothing, nothing).detail.shape == (0, 3)
