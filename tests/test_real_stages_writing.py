"""Layers written over real assets, refined without a solver: every rule and USD's own validators hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from layers import errors, fine_points, open_over, refine_all, world_metres

from physgraph_usd.usd.reader import open_shot
from physgraph_usd.usd.writer import LayerWriter

SHOTS = {
    "01_newton_shirt_dab_cm.usdc": ["/shot/char/shirt_geo"],
    "02_makehuman_usdskel_dm.usdc": ["/shot/char/top", "/shot/char/shorts"],
    "06_torus_pull.usda": ["/shot/cloth"],
    "07_flag_quads_nocollider.usda": ["/shot/flag"],
    "08_sphere_spin_xformcollider.usdc": ["/shot/set/cloth"],
    "09_cesiumman_kilt/shot.usda": ["/shot/kilt"],
    "12_variants/a_lefthanded_consistent.usdc": ["/shot/shirt"],
    "12_variants/b_winding_flipped_unflagged.usdc": ["/shot/shirt"],
    "12_variants/c_zup_cm.usdc": ["/shot/shirt"],
    "12_variants/d_mixed_quads_tris.usdc": ["/shot/shirt"],
    "12_variants/e_sparse_samples.usdc": ["/shot/shirt"],
    "12_variants/f_subframe_times_tcps48.usdc": ["/shot/shirt"],
    "12_variants/g_nonuniform_scaled_parent.usdc": ["/shot/rig/shirt"],
    "12_variants/h_holes_creases_normals.usdc": ["/shot/shirt"],
    "12_variants/j_visibility_purpose.usdc": ["/shot/shirt"],
    "12_variants/k_static_garment.usda": ["/shot/shirt"],
}


@pytest.mark.real_data
@pytest.mark.parametrize("mode", ["over", "sibling"])
@pytest.mark.parametrize("name", SHOTS)
def test_a_real_shot(real_data: Path, tmp_path: Path, name: str, mode: str) -> None:
    path, out = real_data / "shots" / name, tmp_path / "out.usdc"
    shot = open_shot(str(path), level=1, garments=SHOTS[name])
    steps = refine_all(shot)
    times = [*shot.scene.times[:2], *shot.scene.times[-1:]] or [None]
    with LayerWriter(shot, steps, out, mode=mode, velocities=True) as writer:
        for time in times:
            writer.write(time, fine_points(shot, steps, time))
    assert errors(out, path) == []
    stage = open_over(path, out)
    for time in times:
        for target, points in zip(writer.targets, fine_points(shot, steps, time), strict=True):
            size = float(np.ptp(points, axis=0).max())
            np.testing.assert_allclose(world_metres(stage, str(target), time), points, atol=1e-5 * size)
