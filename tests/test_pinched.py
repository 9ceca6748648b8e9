"""Cloth that a shot leaves crumpled between limbs is not torn out of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import open_for
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.mesh.topology import edges_of


@pytest.mark.slow
@pytest.mark.real_data
def test_cloth_pinched_between_limbs_leaves_no_spikes(real_data: Path):
    """A dress whose waist crosses itself 120,000 times, in a body: no vertex leaves what is around it behind.

    Pushed out of the leg and out of the hip in turns, vertices were sent 45 cm away.
    """
    options = RefineOptions(garments=("/shot/tiered_dress",), colliders=("/shot/mannequin",), level=2)
    shot = open_for(str(real_data / "shots" / "04_tiered_dress_kick_zup.usdc"), options)
    scene = shot.scene
    refiner = Refiner(scene, options.solve_settings(), levels=[2])
    mesh = refine_garments(scene.garments, [2])[0][-1].mesh
    edges = edges_of(mesh.triangulate(None).triangles, mesh.vertex_count).vertices
    for time in (49.0, 50.0):
        x = refiner.solve(shot.frame(time)).points[0]
        assert x is not None
        assert np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1).max() < 0.2
