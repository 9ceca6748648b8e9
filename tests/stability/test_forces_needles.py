"""S3: needle triangles of aspect 1e4: finite and exact."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from energies import apart, autograd_force, bending_energy, evaluate, membrane_energy, stretch_energy
from hypothesis import given, settings
from hypothesis import strategies as st
from sheets import equilateral, level_of, rotation
from test_forces import force_of

INTERNAL = ("stretch", "membrane", "bending")


def needle_sheet(aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Equilateral triangles, the middle row squeezed into needles."""
    points, triangles = equilateral(0.4, 0.4, 0.1)
    height = np.sqrt(0.75) * 0.1
    row = np.rint(points[:, 1] / height)
    middle = row.max() // 2
    points[:, 1] -= np.where(row > middle, height - 0.1 / aspect, 0.0)
    return points, triangles


def crumpled(points: np.ndarray, aspect: float, seed: int) -> np.ndarray:
    """Bent smoothly and shaken by a twentieth of the shortest height, so that the needles stay proper triangles."""
    rng = np.random.default_rng(seed)
    bent = points + np.stack([0 * points[:, 0], 0 * points[:, 0], 0.1 * np.sin(9 * points[:, 0])], axis=1)
    return (bent + rng.uniform(-1, 1, points.shape) * 0.005 / aspect) @ rotation(seed).T


@settings(max_examples=15)
@given(aspect=st.floats(10, 1e4), seed=st.integers(0, 999))
def test_s3_needle_forces_are_exact(aspect: float, seed: int):
    points, triangles = needle_sheet(aspect)
    level = level_of(points, triangles)
    x = torch.as_tensor(crumpled(points, aspect, seed))
    energies = {
        "stretch": stretch_energy(level.rest, triangles, 30.0),
        "membrane": membrane_energy(level.rest, triangles, 30.0, 7.0),
        "bending": bending_energy(level.rest, triangles, 0.05),
    }
    for name, energy in energies.items():
        found, f = evaluate(force_of(name, level), x)
        expected, g = autograd_force(energy, x)
        assert found == pytest.approx(expected, rel=1e-6), name
        assert apart(f, g) < 1e-6, name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", INTERNAL)
def test_s3_collapsed_triangles_stay_finite(name: str, dtype: torch.dtype):
    """Rest triangles with no area, present triangles with no area, points on one spot."""
    points, triangles = needle_sheet(1e4)
    gone = points * [1.0, 0.0, 1.0]
    for rest in (points, gone, np.where(points > 0.2, 0.2, points)):
        level = level_of(rest, triangles, dtype=dtype)
        force = force_of(name, level)
        for x in (points, gone, 0 * points):
            energy, f = evaluate(force, torch.as_tensor(x, dtype=dtype))
            assert np.isfinite(energy)
            assert bool(f.isfinite().all())
            assert bool(force.diagonal(torch.as_tensor(x, dtype=dtype)).isfinite().all())
        matrix = force.rest_matrix()
        assert matrix is not None
        assert np.isfinite(matrix.data).all()
