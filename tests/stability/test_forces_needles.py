"""S3: needle triangles of aspect 1e4, and triangles without area: finite."""

import numpy as np
import pytest
import torch
from energies import evaluate
from sheets import equilateral, level_of
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
        assert all(np.isfinite(each).all() for each in force.rest_springs())
