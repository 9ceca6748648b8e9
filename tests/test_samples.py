"""Sample shots: valid stages, the same bytes every time, and cloth that leaves something to refine."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="samples are written with usd-core")

from pxr import Usd, UsdGeom, UsdShade, UsdSkel
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from physgraph_usd.errors import UsageError
from physgraph_usd.lab.samples import SAMPLES, write_sample
from physgraph_usd.lab.samples.panel import Cut, sew
from physgraph_usd.lab.samples.shapes import ease, quad_grid, springs
from physgraph_usd.usd.write.plain import PlainMesh, PlainStage

GARMENT, COLLIDER = "PhysGraphGarmentAPI", "PhysGraphColliderAPI"


@cache
def build(name: str) -> PlainStage:
    module, _, variant = name.partition("_")
    make = import_module(f"physgraph_usd.lab.samples.{module}").build
    return make(variant) if variant else make()


def garment(name: str) -> PlainMesh:
    return next(mesh for mesh in build(name).meshes if mesh.role == "garment")


def edges(mesh: PlainMesh) -> tuple[np.ndarray, np.ndarray]:
    """Unique edges and how many faces use each."""
    ends = np.cumsum(mesh.counts)
    following = np.arange(1, len(mesh.indices) + 1)
    following[ends - 1] = ends - mesh.counts
    pairs = np.sort(np.stack([mesh.indices, mesh.indices[following]], axis=1), axis=1)
    return np.unique(pairs, axis=0, return_counts=True)


def lengths(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)


def prims_with(stage: Usd.Stage, schema: str) -> list[Usd.Prim]:
    return [prim for prim in stage.Traverse() if schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas()]


def test_sleeve_has_the_size_of_the_benchmark() -> None:
    mesh = garment("sleeve")
    pairs, uses = edges(mesh)
    vertices, faces = len(mesh.points), len(mesh.counts)
    assert vertices == 1668
    assert vertices - len(pairs) + faces == 0, "an open tube has Euler characteristic 0"
    assert set(uses) == {1, 2}
    assert vertices + 3 * len(pairs) + 3 * faces == 26304, "vertices after two splits"


def test_sleeve_triangles_are_irregular_and_well_shaped() -> None:
    mesh = garment("sleeve")
    corners = mesh.points[mesh.indices.reshape(-1, 3)]
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    quality = 4 * np.sqrt(3) * area / (side**2).sum(axis=1)
    degree = np.bincount(edges(mesh)[0].ravel())
    assert quality.min() > 0.45
    assert np.median(quality) > 0.85
    assert len(np.unique(degree)) >= 4, "regular grids hide errors that artists' meshes show"


def test_sleeve_ends_stay_rigid_and_move_smoothly() -> None:
    mesh = garment("sleeve")
    assert mesh.samples is not None
    assert mesh.pin is not None
    held = mesh.samples[:, mesh.pin == 1]
    assert held.shape[1] == 64
    steps = np.linalg.norm(np.diff(held, axis=0), axis=2)
    jerk = np.linalg.norm(np.diff(held, n=3, axis=0), axis=2)
    assert jerk.max() < 0.25 * steps.max()
    span = [np.linalg.norm(sample[:, None] - sample[None], axis=2).max() for sample in (held[:, :32], held[:, 32:])]
    assert np.all(np.isfinite(span))
    first = lengths(held[0, :32], np.stack([np.arange(31), np.arange(1, 32)], axis=1))
    last = lengths(held[-1, :32], np.stack([np.arange(31), np.arange(1, 32)], axis=1))
    assert np.abs(last / first - 1).max() < 0.12


@pytest.mark.parametrize("name", ["sleeve", "skirt", "flag", "frozen", "swatch"])
def test_coarse_cloth_is_compressed_in_places_and_hardly_stretched(name: str) -> None:
    mesh = garment(name)
    assert mesh.samples is not None
    pairs, _ = edges(mesh)
    ratio = np.stack([lengths(sample, pairs) for sample in mesh.samples]) / lengths(mesh.points, pairs)
    worst = ratio[np.argmin((ratio > 0.95).mean(axis=1))]
    assert (worst < 0.95).mean() > 0.15, "nothing to wrinkle"
    assert np.percentile(worst, 5) > 0.70, "crushed"
    assert np.percentile(worst, 95) < 1.10, "stretched"


def test_tshirt_arm_crushes_the_armpit(sample: Callable[[str], Path]) -> None:
    mesh = garment("tshirt")
    stage = Usd.Stage.Open(str(sample("tshirt")))
    UsdSkel.BakeSkinning(stage.Traverse())
    shirt = UsdGeom.Mesh(prims_with(stage, GARMENT)[0])
    pairs, _ = edges(mesh)
    rest = lengths(mesh.points, pairs)
    samples = shirt.GetPointsAttr().GetTimeSamples()
    assert len(samples) == 36
    ratio = np.stack([lengths(np.asarray(shirt.GetPointsAttr().Get(t)), pairs) / rest for t in samples])
    assert np.abs(ratio[0] - 1).max() < 1e-4, "the first sample is the bind pose"
    middle = mesh.points[pairs].mean(axis=1)
    armpit = (np.abs(np.abs(middle[:, 0]) - 0.19) < 0.05) & (np.abs(middle[:, 1] - 0.40) < 0.08)
    assert ratio[:, armpit].min() < 0.6
    assert ratio[:, armpit].max() > 1.3


def test_tshirt_parts(sample: Callable[[str], Path]) -> None:
    mesh = garment("tshirt")
    pairs, uses = edges(mesh)
    assert 1000 <= len(mesh.points) <= 1400
    assert set(mesh.counts) == {4}
    border = pairs[uses == 1]
    size = len(mesh.points)
    graph = sparse.coo_matrix((np.ones(len(border)), (border[:, 0], border[:, 1])), shape=(size, size))
    count, part = connected_components(graph, directed=False)
    assert np.count_nonzero(np.bincount(part, minlength=count) > 1) == 4, "hem, two cuffs and a collar"
    assert mesh.uv is not None
    assert len(mesh.uv.indices) == len(mesh.indices)
    assert len(mesh.uv.values) > len(mesh.points), "UVs have seams"
    stage = Usd.Stage.Open(str(sample("tshirt")))
    shirt = prims_with(stage, GARMENT)[0]
    subsets = UsdShade.MaterialBindingAPI(shirt).GetMaterialBindSubsets()
    valid, reason = UsdGeom.Subset.ValidateFamily(UsdGeom.Mesh(shirt), "face", "materialBind")
    assert len(subsets) == 2
    assert valid, reason
    bound = {UsdShade.MaterialBindingAPI(each).ComputeBoundMaterial()[0].GetPath() for each in subsets}
    assert len(bound) == 2


def test_tshirt_weights_sum_to_one() -> None:
    for mesh in build("tshirt").meshes:
        assert mesh.skin is not None
        np.testing.assert_allclose(mesh.skin.weights.sum(axis=1), 1.0, atol=1e-12)
        assert mesh.skin.weights.min() >= 0.0


def test_body_is_inside_the_shirt_at_bind() -> None:
    shirt, body = build("tshirt").meshes
    quads = body.indices[: 4 * np.count_nonzero(body.counts == 4)].reshape(-1, 4)
    chest = (np.abs(shirt.points[:, 0]) < 0.12) & (shirt.points[:, 1] < 0.40)
    form = body.points[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    side = np.sign(shirt.points[chest, 2])
    assert chest.sum() > 200
    assert not meets_along_z(shirt.points[chest], side, form).any(), "a ray from the shirt outwards meets the body"
    assert meets_along_z(shirt.points[chest], -side, form).any(), "no ray inwards meets it: the test would see nothing"


def meets_along_z(points: np.ndarray, sign: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Whether the ray along the Z axis from each point, with a sign each, meets one of the triangles, shape (N,)."""
    a, b, c = (corners[:, i] - points[:, None] for i in range(3))  # Shape (N, T, 3).
    weights = np.stack([p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0] for p, q in ((b, c), (c, a), (a, b))])
    inside = (weights >= 0).all(axis=0) | (weights <= 0).all(axis=0)
    height = (weights * np.stack([a, b, c])[..., 2]).sum(axis=0) * np.sign(weights.sum(axis=0))
    return np.asarray((inside & (sign[:, None] * height > 0)).any(axis=1))


def test_frozen_samples_are_equal(sample: Callable[[str], Path]) -> None:
    stage = Usd.Stage.Open(str(sample("frozen")))
    points = UsdGeom.Mesh(prims_with(stage, GARMENT)[0]).GetPointsAttr()
    values = [np.asarray(points.Get(t)) for t in points.GetTimeSamples()]
    assert len(values) == 12
    assert all(np.array_equal(values[0], each) for each in values)
    assert not np.array_equal(values[0], np.asarray(points.Get()))


def test_skirt_stays_outside_the_hips() -> None:
    skirt, hips = build("skirt").meshes
    assert skirt.samples is not None
    assert hips.transforms is not None
    turned = [np.degrees(np.arctan2(m[0, 2], m[0, 0])) for m in hips.transforms]
    assert max(turned) > 30
    assert min(turned) < -20
    for matrix, sample in zip(hips.transforms, skirt.samples, strict=True):
        local = (sample - matrix[:3, 3]) @ matrix[:3, :3]
        level = np.abs(local[:, 1] + 0.15) < 0.05
        inside = (local[level, 0] / 0.172) ** 2 + (local[level, 2] / 0.132) ** 2 < 1
        assert not inside.any()


def test_flag_has_no_collider_and_is_held_at_the_pole(sample: Callable[[str], Path]) -> None:
    mesh = garment("flag")
    assert mesh.pin is not None
    assert mesh.samples is not None
    assert mesh.pin.sum() == 28
    assert np.ptp(mesh.samples[:, mesh.pin == 1], axis=0).max() < 0.03
    assert np.ptp(mesh.samples[:, mesh.pin == 0], axis=0).max() > 0.3
    assert not prims_with(Usd.Stage.Open(str(sample("flag"))), COLLIDER)


@pytest.mark.parametrize("variant", ["cm", "zup", "lefthanded"])
def test_variants_show_the_same_cloth(sample: Callable[[str], Path], variant: str) -> None:
    def read(name: str) -> tuple[np.ndarray, np.ndarray]:
        stage = Usd.Stage.Open(str(sample(name)))
        mesh = UsdGeom.Mesh(prims_with(stage, GARMENT)[0])
        points = np.asarray(mesh.GetPointsAttr().Get(24.0)) * UsdGeom.GetStageMetersPerUnit(stage)
        if UsdGeom.GetStageUpAxis(stage) == "Z":
            points = points[:, [0, 2, 1]] * [1, 1, -1]
        quads = np.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
        left = mesh.GetOrientationAttr().Get() == "leftHanded"
        corners = points[quads[:, ::-1] if left else quads]
        return points, np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])

    points, normals = read("swatch")
    others, other_normals = read(f"swatch_{variant}")
    np.testing.assert_allclose(others, points, atol=1e-6)
    np.testing.assert_allclose(other_normals, normals, atol=1e-7)


@pytest.mark.parametrize("name", SAMPLES)
def test_stage_is_complete_and_valid(sample: Callable[[str], Path], name: str) -> None:
    validation = pytest.importorskip("pxr.UsdValidation", reason="pxr before 24.11 cannot validate")
    stage = Usd.Stage.Open(str(sample(name)))
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetErrorAsString() for error in context.Validate(stage)] == []
    assert stage.HasAuthoredMetadata("metersPerUnit")
    assert stage.HasAuthoredMetadata("upAxis")
    assert stage.HasAuthoredMetadata("timeCodesPerSecond")
    assert stage.HasAuthoredTimeCodeRange()
    assert Usd.ModelAPI(stage.GetDefaultPrim()).GetKind() == "component"
    assert prims_with(stage, GARMENT)
    for prim in prims_with(stage, GARMENT):
        assert prim.GetAttribute("physgraph:material:bendStiffness").Get() > 0
    for prim in stage.Traverse():
        mesh = UsdGeom.Mesh(prim)
        if not mesh:
            continue
        indices, counts = mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get()
        points = mesh.GetPointsAttr()
        for code in [Usd.TimeCode.Default(), *points.GetTimeSamples()]:
            place = points.Get(code)
            valid, reason = UsdGeom.Mesh.ValidateTopology(indices, counts, len(place))
            assert valid, reason
            np.testing.assert_allclose(mesh.GetExtentAttr().Get(code), [np.min(place, 0), np.max(place, 0)])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "dancer" else name for name in SAMPLES]
)
def test_same_bytes_every_time_and_soon(sample: Callable[[str], Path], name: str, tmp_path: Path) -> None:
    start = time.process_time()
    again = write_sample(name, tmp_path / "new" / "folder")
    assert time.process_time() - start < 15.0
    assert again.read_bytes() == sample(name).read_bytes()


def test_unknown_sample_is_named() -> None:
    with pytest.raises(UsageError, match=r"unknown sample 'scarf'; known samples: sleeve, skirt"):
        write_sample("scarf", Path())


def test_grid_closes_on_itself() -> None:
    quads = quad_grid(3, 5, closed=True)
    assert len(quads) == 10
    assert np.all(np.bincount(quads.ravel())[5:10] == 4)
    assert len(springs(quad_grid(2, 2))) == 6


def test_ease_has_no_velocity_at_its_ends() -> None:
    step = 1e-4
    assert ease(0.0) == 0.0
    assert ease(1.0) == 1.0
    assert ease(step) < 1e-10
    assert 1.0 - ease(1.0 - step) < 1e-10


def test_strip_inflates_to_an_ellipse() -> None:
    pillow = sew(Cut(0.2, 4.0, 4.1, 0.0, 0.1, 0.05, (24, 2, 60, 2), depth=(0.5, 0.5)))
    middle = np.abs(pillow.points[:, 1] - 1.5) < 0.05
    x, _, z = pillow.points[middle].T
    np.testing.assert_allclose((x / 0.2) ** 2 + (z / 0.1) ** 2, 1.0, atol=0.02)
