"""Real shots and odd stages: every valid one gives every frame and a layer without fault, every broken one says why."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from layers import errors, fine_points, open_over, refine_all, world_metres, write_shot
from shots import SHOTS, VALID

from physgraph_usd.errors import GarmentError, PhysGraphError, StageError
from physgraph_usd.usd.read.reader import Shot, open_shot
from physgraph_usd.usd.read.survey import survey

UNOPENABLE = ("framesPerSecond_-1.usda", "framesPerSecond_0.usda")
VARIANTS = [name for name in SHOTS if name.startswith("12_variants/") and "k_static" not in name]


def opened(folder: Path, name: str, **options) -> Shot:
    return open_shot(str(folder / "shots" / name), garments=SHOTS[name][0], **options)


@pytest.mark.parametrize("name", SHOTS)
def test_every_valid_shot_opens_and_gives_every_frame(real_data: Path, name: str) -> None:
    paths, counts, frames = SHOTS[name]
    with contextlib.closing(opened(real_data, name)) as shot:
        assert [garment.path for garment in shot.scene.garments] == paths
        assert [garment.mesh.vertex_count for garment in shot.scene.garments] == counts
        assert len(shot.scene.times) == frames
        for time in shot.scene.times or (None,):
            for garment, frame in zip(shot.scene.garments, shot.frame(time).garments, strict=True):
                assert np.isfinite(frame.points).all()
                assert frame.points.shape == garment.rest.shape
                assert 0.3 < np.ptp(frame.points, axis=0).max() < 3.0, "a garment has a garment's size in metres"
        assert np.linalg.norm(shot.scene.gravity) == pytest.approx(9.81)


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


def test_broken_samples_are_repaired_with_prim_point_and_time(real_data: Path) -> None:
    with contextlib.closing(open_shot(str(real_data / "shots/11b_nan_frame.usda"), garments=["dress"])) as shot:
        frames = {time: shot.frame(time).garments[0].points for time in shot.scene.times}
    told = {notice.time: notice.message for notice in shot.warnings if notice.time is not None}
    assert set(told) == {4.0, 5.0}
    for time, message in told.items():
        index = int(message.split("]")[0].removeprefix("points["))
        step = np.linalg.norm(frames[time] - frames[time - 1], axis=1)
        assert step[index] <= 1.5 * np.delete(step, index).max()


def test_varying_topology_is_refused_with_prim_and_time(real_data: Path) -> None:
    path = str(real_data / "shots/12_variants/i_topology_varying.usda")
    with pytest.raises(GarmentError, match="</shot/shirt> at time code 7: faceVertexIndices changes"):
        open_shot(path, garments=["/shot/shirt"])
    assert open_shot(path, garments=["/shot/shirt"], frames=(1, 6)).scene.times[-1] == 6.0


def test_an_untagged_real_shot_lists_its_meshes(real_data: Path) -> None:
    with pytest.raises(StageError, match="meshes: /shot/char/shirt_geo, /shot/char/body_geo"):
        open_shot(str(real_data / "shots/01_newton_shirt_dab_cm.usdc"))


def test_a_body_by_path_is_a_collider_with_its_skin_and_payload(real_data: Path) -> None:
    shot = opened(real_data, "09_cesiumman_kilt/shot.usda", colliders=["/shot/CesiumMan"])
    assert len(shot.colliders) == 1
    assert shot.colliders[0].endswith("Cesium_Man_2")
    with pytest.raises(StageError, match="no prim at </shot/body>"):
        opened(real_data, "07_flag_quads_nocollider.usda", colliders=["/shot/body"])


def test_odd_stages_have_a_named_outcome(real_data: Path) -> None:
    files = [file for folder in ("float_units", "usd_wg") for file in (real_data / "stages" / folder).rglob("*.usd*")]
    assert len(files) > 50
    for file in sorted(files):
        if file.name in UNOPENABLE:
            with pytest.raises(StageError, match="framesPerSecond"):
                survey(str(file))
            continue
        found = survey(str(file))
        broken = {mesh.path for mesh in found.meshes if mesh.problem}
        for mesh in found.meshes:
            assert mesh.problem == "" or mesh.path in mesh.problem
            read(file, mesh.path, valid=mesh.path not in broken)


def read(file: Path, mesh: str, *, valid: bool) -> None:
    if not valid:
        with pytest.raises(PhysGraphError, match=mesh):
            open_shot(str(file), garments=[mesh])
        return
    shot = open_shot(str(file), garments=[mesh])
    assert np.isfinite(shot.frame(None).garments[0].points).all()


@pytest.mark.real_data
@pytest.mark.parametrize("mode", ["over", "sibling"])
@pytest.mark.parametrize("name", VALID)
def test_a_layer_over_a_real_shot_keeps_every_rule(real_data: Path, tmp_path: Path, name: str, mode: str) -> None:
    path, out = real_data / "shots" / name, tmp_path / "out.usdc"
    shot = open_shot(str(path), level=1, garments=VALID[name])
    steps = refine_all(shot)
    times = [*shot.scene.times[:2], *shot.scene.times[-1:]] or [None]
    writer = write_shot(shot, out, times=times, mode=mode, velocities=True)
    assert errors(out, path) == []
    stage = open_over(path, out)
    for time in times:
        for target, points in zip(writer.targets, fine_points(shot, steps, time), strict=True):
            size = float(np.ptp(points, axis=0).max())
            np.testing.assert_allclose(world_metres(stage, str(target), time), points, atol=1e-5 * size)
