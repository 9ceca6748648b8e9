"""Real shots and odd stages: every valid one gives every frame and a layer without fault, every broken one says why."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from shots import SHOTS

from physgraph_usd.errors import StageError
from physgraph_usd.usd.read.reader import Shot, open_shot

VARIANTS = [name for name in SHOTS if name.startswith("12_variants/") and "k_static" not in name]


def opened(folder: Path, name: str, **options) -> Shot:
    return open_shot(str(folder / "shots" / name), garments=SHOTS[name][0], **options)


@pytest.mark.parametrize("name", VARIANTS)
def test_the_variants_are_one_animation_under_many_conventions(real_data: Path, name: str) -> None:
    with contextlib.closing(opened(real_data, name)) as shot:
        reference = opened(real_data, "12_variants/b_winding_flipped_unflagged.usdc")
        points = shot.frame(shot.scene.times[0]).garments[0].points
        expected = reference.frame(1.0).garments[0].points
        if name.endswith("c_zup_cm.usdc"):
            points = points @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        np.testing.assert_allclose(points, expected, atol=2e-6)
    assert shot.scene.garments[0].flipped == ("lefthanded" in name)


def test_sub_frame_and_sparse_times_are_the_authored_ones(real_data: Path) -> None:
    sparse = opened(real_data, "12_variants/e_sparse_samples.usdc")
    assert sparse.scene.times == (1.0, 4.0, 7.0, 10.0)
    sub = opened(real_data, "12_variants/f_subframe_times_tcps48.usdc").scene.times
    np.testing.assert_array_equal(np.diff(sub), [2.25, 1.75] * 5 + [2.25])


def test_holes_of_a_real_garment_are_left_out(real_data: Path) -> None:
    shot = opened(real_data, "12_variants/h_holes_creases_normals.usdc")
    assert len(shot.sources[0].kept_faces) == shot.scene.garments[0].mesh.face_count == 2764
    assert any("creaseIndices" in notice.message for notice in shot.warnings)


def test_a_body_by_path_is_a_collider_with_its_skin_and_payload(real_data: Path) -> None:
    shot = opened(real_data, "09_cesiumman_kilt/shot.usda", colliders=["/shot/CesiumMan"])
    assert len(shot.colliders) == 1
    assert shot.colliders[0].endswith("Cesium_Man_2")
    with pytest.raises(StageError, match="no prim at </shot/body>"):
        opened(real_data, "07_flag_quads_nocollider.usda", colliders=["/shot/body"])
