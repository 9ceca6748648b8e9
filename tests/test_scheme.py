"""Tests of the subdivision surface in a refined layer: scheme, creases and corners by cage, and how it is drawn."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layers import COAT, errors, make_shot, open_over, vec3, write_layer
from pxr import Usd, UsdGeom, Vt

from benchmarks.drawn_surface import crossings, finer, folds
from physgraph_usd.errors import UsageError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.mesh.subdivide import smooth, subdivide
from physgraph_usd.usd.read.meshes import DrawnStage

MIXED = ([3, 3, 4], [0, 1, 2, 1, 3, 2, 1, 4, 5, 3])
"""Two triangles and a quad between six points."""


def shot_of(path: Path, *, scheme: str = "", faces: tuple[list[int], list[int]] | None = None) -> Usd.Stage:
    """A shot of the coat, with a scheme and faces of its own."""
    stage = make_shot(path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    if faces is not None:
        mesh.GetFaceVertexCountsAttr().Set(faces[0])
        mesh.GetFaceVertexIndicesAttr().Set(faces[1])
    if scheme:
        mesh.GetSubdivisionSchemeAttr().Set(scheme)
    stage.Save()
    return stage


def fine_mesh(path: Path, out: Path, **options: object) -> tuple[Usd.Stage, UsdGeom.Mesh]:
    """The coat as refined, and the stage that holds it."""
    write_layer(path, out, **options)  # type: ignore[arg-type]
    stage = open_over(path, out)
    return stage, UsdGeom.Mesh(stage.GetPrimAtPath(COAT))


TRIANGLES = ([3, 3], [0, 1, 5, 1, 6, 5])


@pytest.mark.parametrize(
    ("scheme", "faces", "asked", "expected"),
    [
        ("", None, "keep", "catmullClark"),
        ("loop", None, "keep", "catmullClark"),
        ("", TRIANGLES, "keep", "loop"),
        ("loop", TRIANGLES, "keep", "loop"),
        ("", MIXED, "keep", "catmullClark"),
        ("bilinear", None, "keep", "bilinear"),
        ("none", None, "keep", "none"),
        ("", None, "none", "none"),
        ("bilinear", TRIANGLES, "none", "none"),
    ],
)
def test_the_scheme_is_that_of_the_cage_and_its_faces(
    tmp_path: Path, scheme: str, faces: tuple[list[int], list[int]] | None, asked: str, expected: str
) -> None:
    """Normals are there where the scheme is none, and only there."""
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    shot_of(path, scheme=scheme, faces=faces)
    _, mesh = fine_mesh(path, out, scheme=asked)
    assert mesh.GetSubdivisionSchemeAttr().Get() == expected
    assert mesh.GetNormalsAttr().HasAuthoredValue() == (expected == "none")
    assert errors(out) == []


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("per_edge", [False, True])
def test_creases_and_corners_are_lowered_along_fine_edges(tmp_path: Path, level: int, per_edge: bool) -> None:
    """A chain of two edges of sharpness 3, and one of 1 that is gone; corners of 10, which stays, of 2.5 and of 1."""
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = shot_of(path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    mesh.CreateCreaseIndicesAttr([5, 6, 7, 10, 11])
    mesh.CreateCreaseLengthsAttr([3, 2])
    mesh.CreateCreaseSharpnessesAttr([3.0, 3.0, 1.0] if per_edge else [3.0, 1.0])
    mesh.CreateCornerIndicesAttr([0, 4, 8])
    mesh.CreateCornerSharpnessesAttr([10.0, 2.5, 1.0])
    mesh.CreateInterpolateBoundaryAttr("edgeOnly")
    mesh.CreateFaceVaryingLinearInterpolationAttr("boundaries")
    mesh.CreateTriangleSubdivisionRuleAttr("smooth")
    stage.Save()
    _, fine = fine_mesh(path, out, level=level)
    edges, points = np.asarray(fine.GetCreaseIndicesAttr().Get()).reshape(-1, 2), np.asarray(fine.GetPointsAttr().Get())
    sharpness = np.asarray(fine.GetCreaseSharpnessesAttr().Get())
    assert list(fine.GetCreaseLengthsAttr().Get()) == [2] * len(edges)
    kept = sharpness[sharpness == 3.0 - level]
    assert len(kept) == 2 * 2**level
    assert len(sharpness) == len(kept) + (level == 0)
    along = points[edges[: len(kept)]]
    np.testing.assert_allclose(along[:, :, 1], 1.0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(along[:, :, 0], axis=1), 0.5**level, atol=1e-6)
    corners = dict(zip(fine.GetCornerIndicesAttr().Get(), fine.GetCornerSharpnessesAttr().Get(), strict=True))
    assert corners == {0: {0: 10.0, 4: 2.5, 8: 1.0}, 1: {0: 10.0, 4: 1.5}, 2: {0: 10.0, 4: 0.5}}[level]
    assert fine.GetInterpolateBoundaryAttr().Get() == "edgeOnly"
    assert fine.GetFaceVaryingLinearInterpolationAttr().Get() == "boundaries"
    assert fine.GetTriangleSubdivisionRuleAttr().Get() == "smooth"
    assert errors(out) == []


def test_creases_and_corners_are_emptied_where_the_scheme_is_none(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = shot_of(path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    mesh.CreateCreaseIndicesAttr([5, 6])
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr([9.0])
    mesh.CreateCornerIndicesAttr([0])
    mesh.CreateCornerSharpnessesAttr([9.0])
    stage.Save()
    _, fine = fine_mesh(path, out, scheme="none")
    arrays = [fine.GetCreaseIndicesAttr(), fine.GetCreaseLengthsAttr(), fine.GetCreaseSharpnessesAttr()]
    assert [len(each.Get()) for each in (*arrays, fine.GetCornerIndicesAttr(), fine.GetCornerSharpnessesAttr())] == [
        0
    ] * 5
    assert errors(out) == []


def test_the_rims_of_a_thickened_sheet_are_sharp(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = shot_of(path)
    stage.GetPrimAtPath(COAT).GetAttribute("physgraph:shell:thickness").Set(0.02)
    stage.Save()
    _, fine = fine_mesh(path, out)
    border = 2 * (4 + 3) * 2
    assert list(fine.GetCreaseSharpnessesAttr().Get()) == [UsdGeom.Mesh.SHARPNESS_INFINITE] * 2 * border
    assert errors(out) == []


def test_copies_of_a_point_where_seams_meet_are_not_torn_apart(tmp_path: Path) -> None:
    """Two panels beside a third: at the middle point the third's border runs on, and the others' have corners."""
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = shot_of(path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    points, faces = np.asarray(mesh.GetPointsAttr().Get()), np.asarray(mesh.GetFaceVertexIndicesAttr().Get())
    panel = np.repeat(np.array([0, 0, 1, 1, 0, 0, 1, 1, 2, 2, 2, 2]), 4)
    corners, apart = np.unique(np.stack([panel, faces], axis=1), axis=0, return_inverse=True)
    mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(apart.reshape(-1).astype(np.int32)))
    for time in (None, *mesh.GetPointsAttr().GetTimeSamples()):
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        points = np.asarray(mesh.GetPointsAttr().Get(code)) + np.outer(np.arange(20) % 2, [0.0, 0.0, 0.3])
        mesh.GetPointsAttr().Set(vec3(points[corners[:, 1]]), code)
    stage.Save()
    _, fine = fine_mesh(path, out)
    number = corners[:, 1]
    sharp = number[np.asarray(fine.GetCornerIndicesAttr().Get())]
    assert sorted(sharp.tolist()) == [2, 2, 10, 10, 12, 12, 12, 14, 14]
    assert errors(out) == []


def test_holes_stay_out(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = shot_of(path)
    UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).CreateHoleIndicesAttr([5])
    stage.Save()
    _, fine = fine_mesh(path, out)
    assert len(fine.GetFaceVertexCountsAttr().Get()) == 4 * 11
    assert len(fine.GetHoleIndicesAttr().Get()) == 0


def test_refined_cloth_is_drawn_by_its_subdivision_surface(tmp_path: Path) -> None:
    """Once more subdivided and moved towards the limit surface; by its polygons where the scheme is none."""
    path = tmp_path / "shot.usda"
    shot_of(path)
    sheets = {}
    for scheme in ("keep", "none"):
        out = write_layer(path, tmp_path / f"{scheme}.usdc", scheme=scheme)
        (sheets[scheme],) = DrawnStage(path, out).meshes(4.0, cages=())
    polygons, surface = sheets["none"], sheets["keep"]
    assert surface.mesh.face_count == 4 * polygons.mesh.face_count
    assert surface.authored == polygons.authored == len(polygons.points)
    once = smooth(polygons.mesh, subdivide(polygons.mesh)) @ polygons.points
    away = np.linalg.norm(surface.points - once, axis=1)
    assert 0.0 < away.max() < 0.5 * np.linalg.norm(once[: len(polygons.points)] - polygons.points, axis=1).max()


@pytest.mark.parametrize("scheme", ["keep", "none"])
def test_a_drawn_surface_inside_a_body_is_a_warning(sample: Callable[[str], Path], tmp_path: Path, scheme: str) -> None:
    """Over a block's sharp edges the subdivision surface of the cloth enters the block; polygons stay outside."""
    shot = tmp_path / "block.usda"
    stage = Usd.Stage.CreateNew(str(shot))
    stage.GetRootLayer().subLayerPaths.append(str(sample("block")))
    stage.SetMetadata("metersPerUnit", 1.0)
    (cage,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.HasAPI("PhysGraphGarmentAPI"))
    cage.GetSubdivisionSchemeAttr().Set("catmullClark")
    stage.Save()
    options = RefineOptions(frames=(20, 20), level=2, scheme=scheme, report=tmp_path / "report.json")
    warnings = [each for each in refine_shot(shot, tmp_path / "out.usdc", options).warnings if "renderers draw" in each]
    assert len(warnings) == (scheme == "keep")
    assert all(f"<{cage.GetPath()}> at time code 20: " in each and "--scheme none" in each for each in warnings)


@pytest.mark.parametrize("scheme", ["keep", "none"])
def test_cloth_that_a_renderer_subdivides_has_no_new_crossings(
    sample: Callable[[str], Path], tmp_path: Path, scheme: str
) -> None:
    """Once and twice more subdivided, nothing crosses, and at most a quarter of the folded edges still are."""
    shot, out = sample("swatch"), tmp_path / "out.usdc"
    refine_shot(shot, out, RefineOptions(frames=(1, 2), level=2, scheme=scheme))
    stage = open_over(shot, out)
    (fine,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.HasAPI("PhysGraphGarmentAPI"))
    cage = Usd.Stage.Open(str(shot))
    kept = UsdGeom.Mesh(cage.GetPrimAtPath(fine.GetPath())).GetSubdivisionSchemeAttr().Get()
    assert fine.GetSubdivisionSchemeAttr().Get() == ("none" if scheme == "none" else kept)
    (mesh,) = DrawnStage(shot, out).meshes(2.0, cages=[str(fine.GetPath())])
    once, twice = finer(mesh), finer(finer(mesh))
    assert [crossings([each], []) for each in (mesh, once, twice)] == [0, 0, 0]
    assert folds(twice).mean() <= folds(once).mean() <= 0.25 * folds(mesh).mean()
    assert Usd.Stage.Open(str(out)).GetRootLayer().customLayerData["physgraph"]["options"]["scheme"] == scheme


def test_the_option_is_recorded_and_checked() -> None:
    assert RefineOptions().plain()["scheme"] == "keep"
    assert RefineOptions(scheme="none").plain()["scheme"] == "none"
    with pytest.raises(UsageError, match="unknown scheme 'loop'"):
        RefineOptions(scheme="loop").check()


def test_creases_that_do_not_fit_are_dropped(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = shot_of(path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    mesh.CreateCreaseIndicesAttr([5, 6, 7])
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr(Vt.FloatArray([4.0]))
    stage.Save()
    _, fine = fine_mesh(path, out)
    assert len(fine.GetCreaseIndicesAttr().Get()) == 0
    assert errors(out) == []
