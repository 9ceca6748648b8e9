"""How refined garments compose over shots of many kinds."""

from pathlib import Path

import numpy as np
import pytest
from layers import (
    COAT,
    TIMES,
    dress_up,
    errors,
    fine_points,
    grid,
    make_shot,
    open_over,
    refine_all,
    vec3,
    world_metres,
    write_layer,
    write_shot,
)
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt
from stages import add_skeleton, clip_shot, skinned_points

from physgraph_usd.errors import LayerError
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.write.track import extent_of
from physgraph_usd.usd.write.writer import LayerWriter


@pytest.mark.parametrize("mode", ["over", "sibling"])
def test_bindings_and_partition_survive(dressed: Path, tmp_path: Path, mode: str) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc", mode=mode)
    stage, path = open_over(dressed, out), COAT if mode == "over" else f"{COAT}_refined"
    prim = stage.GetPrimAtPath(path)
    api = UsdShade.MaterialBindingAPI
    assert api(prim).ComputeBoundMaterial()[0].GetPath() == "/World/Looks/red"
    subsets = api(prim).GetMaterialBindSubsets()
    assert [api(subset.GetPrim()).ComputeBoundMaterial()[0].GetPath() for subset in subsets] == ["/World/Looks/red"] * 2
    named = np.concatenate([np.asarray(subset.GetIndicesAttr().Get()) for subset in subsets])
    np.testing.assert_array_equal(np.sort(named), np.arange(48))


def test_a_sibling_renders_and_the_coarse_mesh_is_its_proxy(dressed: Path, tmp_path: Path) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc", mode="sibling")
    stage = open_over(dressed, out)
    coarse, fine = (UsdGeom.Mesh(stage.GetPrimAtPath(path)) for path in (COAT, f"{COAT}_refined"))
    assert coarse.ComputePurpose() == "proxy"
    assert fine.ComputePurpose() == "render"
    assert len(coarse.GetPointsAttr().Get(1.0)) == 20
    assert len(fine.GetPointsAttr().Get(1.0)) == 63
    assert fine.ComputeProxyPrim()[0].GetPath() == COAT
    # Only the coarse mesh is a garment: the sibling must not be refined again.
    assert fine.GetPrim().GetPrimTypeInfo().GetAppliedAPISchemas().count("PhysGraphGarmentAPI") == 0
    assert coarse.GetPrim().GetPrimTypeInfo().GetAppliedAPISchemas().count("PhysGraphGarmentAPI") == 1


def test_a_sibling_that_is_there_already_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    make_shot(path)
    stage = Usd.Stage.Open(str(path))
    stage.DefinePrim(f"{COAT}_refined", "Mesh")
    stage.GetRootLayer().Save()
    shot = open_shot(str(path), level=1, garments=[COAT])
    with pytest.raises(LayerError, match=r"coat_refined> is already on the stage"):
        LayerWriter(shot, refine_all(shot), tmp_path / "again.usdc", mode="sibling")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["shot.usda"]


@pytest.mark.parametrize("mode", ["over", "sibling"])
def test_a_garment_in_an_instance(tmp_path: Path, mode: str) -> None:
    dress_up(make_shot(tmp_path / "asset.usda"))
    path = tmp_path / "shot.usda"
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(30.0)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    for name in ("one", "two"):
        prim = stage.DefinePrim(f"/Set/{name}")
        prim.GetReferences().AddReference("asset.usda")
        prim.SetInstanceable(True)
    stage.Save()
    shot = open_shot(str(path), level=1, garments=["/Set/one/rig/coat"])
    writer = write_shot(shot, tmp_path / "out.usdc", mode=mode)
    assert any("instanceable" in str(notice) for notice in writer.notices)
    composed = open_over(path, tmp_path / "out.usdc")
    name = "coat" if mode == "over" else "coat_refined"
    assert len(UsdGeom.Mesh(composed.GetPrimAtPath(f"/Set/one/rig/{name}")).GetPointsAttr().Get(1.0)) == 63
    assert composed.GetPrimAtPath("/Set/two").IsInstance()
    assert errors(tmp_path / "out.usdc") == []


def test_samples_from_value_clips_are_replaced(tmp_path: Path) -> None:
    path = clip_shot(tmp_path)
    shot = open_shot(path, level=1)
    write_shot(shot, tmp_path / "out.usdc")
    composed = open_over(Path(path), tmp_path / "out.usdc")
    for time in (1.0, 2.0, 3.0):
        expected = fine_points(shot, refine_all(shot), time)[0]
        np.testing.assert_allclose(world_metres(composed, "/World/cloth", time), expected, atol=1e-6)


def make_skinned(path: Path, *, inherited: bool) -> None:
    """The coat on a joint that turns, bound on the mesh or on its parent."""
    stage = make_shot(path, times=())
    add_skeleton(stage, "/World", TIMES)
    mesh = stage.GetPrimAtPath(COAT)
    UsdSkel.BindingAPI.Apply(mesh)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetParent() if inherited else mesh)
    binding.CreateSkeletonRel().SetTargets(["/World/skel"])
    binding.CreateJointIndicesPrimvar(inherited, 1).Set([1] if inherited else [1] * 20)
    binding.CreateJointWeightsPrimvar(inherited, 1).Set([1.0] if inherited else [1.0] * 20)
    stage.SetStartTimeCode(TIMES[0])
    stage.SetEndTimeCode(TIMES[-1])
    stage.Save()


@pytest.mark.parametrize(("mode", "inherited"), [("over", True), ("sibling", False)])
def test_a_skinned_garment_is_not_skinned_twice(tmp_path: Path, mode: str, inherited: bool) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_skinned(path, inherited=inherited)
    shot = open_shot(str(path), level=1)
    writer = write_shot(shot, out, mode=mode)
    stage = open_over(path, out)
    root, cache = UsdSkel.Root(stage.GetPrimAtPath("/World")), UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    bindings = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    skinned = [str(query.GetPrim().GetPath()) for binding in bindings for query in binding.GetSkinningTargets()]
    assert [cloth for cloth in skinned if cache.GetSkinningQuery(stage.GetPrimAtPath(cloth)).HasJointInfluences()] == (
        [] if mode == "over" else [COAT]
    )
    if mode == "over":
        # A rigid bake moves the coarse mesh by its transform, which a sibling shares.
        stage.SetEditTarget(stage.GetSessionLayer())
        UsdSkel.BakeSkinning(root, Gf.Interval(*TIMES[::2]))
    for time in TIMES:
        found = world_metres(stage, str(writer.targets[0]), time)
        np.testing.assert_allclose(found, fine_points(shot, refine_all(shot), time)[0], atol=1e-6)
        np.testing.assert_allclose(found[:20], 0.01 * skinned_points(grid()[0], [1] * 20, time), atol=1e-6)
    assert errors(out) == []


@pytest.mark.parametrize("mode", ["over", "sibling"])
@pytest.mark.parametrize("default", [None, 2.0])
def test_the_default_of_a_skinned_garment_is_its_default_pose(tmp_path: Path, mode: str, default: float | None) -> None:
    """The pose of the animation's default, and the skeleton's rest pose without one, as UsdSkel shows both."""
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_skinned(path, inherited=False)
    stage = Usd.Stage.Open(str(path))
    rotations = UsdSkel.Animation(stage.GetPrimAtPath("/World/skel/anim")).GetRotationsAttr()
    if default is not None:
        rotations.Set(rotations.Get(default))
        stage.Save()
    writer = write_shot(open_shot(str(path), level=1), out, mode=mode)
    over = open_over(path, out)
    found = world_metres(over, str(writer.targets[0]), None)
    expected = 0.01 * (grid()[0] if default is None else skinned_points(grid()[0], [1] * 20, default))
    np.testing.assert_allclose(found[:20], expected, atol=1e-6)
    mesh = UsdGeom.Mesh(over.GetPrimAtPath(str(writer.targets[0])))
    np.testing.assert_allclose(mesh.GetExtentAttr().Get(), extent_of(np.array(mesh.GetPointsAttr().Get())))
    assert errors(out) == []


def test_a_bind_transform_stays_with_its_schema_and_no_validator_objects(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_skinned(path, inherited=False)
    stage = Usd.Stage.Open(str(path))
    UsdSkel.BindingAPI(stage.GetPrimAtPath(COAT)).CreateGeomBindTransformAttr(Gf.Matrix4d().SetTranslate((1, 2, 3)))
    stage.Save()
    write_layer(path, out)
    stage = open_over(path, out)
    coat = stage.GetPrimAtPath(COAT)
    assert "SkelBindingAPI" in coat.GetAppliedSchemas()
    assert coat.GetAttribute("primvars:skel:geomBindTransform").HasAuthoredValue()
    assert [problem for problem in validate_layer(out) if "Skel" in problem.rule] == []


def test_animated_subsets_and_deformable_rest_shapes(dressed: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(dressed))
    prim = stage.GetPrimAtPath(COAT)
    front = UsdGeom.Subset(stage.GetPrimAtPath(f"{COAT}/front")).GetIndicesAttr()
    front.Set([0], 1.0)
    front.Set([0, 1], 4.0)
    rest = prim.CreateAttribute("physics:restShapePoints", Sdf.ValueTypeNames.Point3fArray, False)
    rest.Set(UsdGeom.Mesh(prim).GetPointsAttr().Get())
    prim.CreateAttribute("studio:mask", Sdf.ValueTypeNames.FloatArray).Set([0.0] * 20)
    stage.Save()
    writer = write_shot(open_shot(str(dressed), level=1), tmp_path / "out.usdc")
    composed = open_over(dressed, tmp_path / "out.usdc")
    indices = UsdGeom.Subset(composed.GetPrimAtPath(f"{COAT}/front")).GetIndicesAttr()
    assert [len(indices.Get(time)) for time in (1.0, 4.0)] == [4, 8]
    assert len(composed.GetPrimAtPath(COAT).GetAttribute("physics:restShapePoints").Get()) == 63
    assert any("studio:mask has one entry per vertex" in str(notice) for notice in writer.notices)


def subdividing(prim: Usd.Prim) -> dict[str, object]:
    """Values of the renderers' attributes that subdivide a mesh, its ancestors' too."""
    found = UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance()
    return {each.GetPrimvarName(): each.Get() for each in found if each.GetInterpolation() == "constant"}


def with_renderers(path: Path) -> None:
    """A shot whose garment, and a prim above it, carry renderers' settings of subdivision, one of them animated."""
    stage, types = make_shot(path), Sdf.ValueTypeNames
    mesh, rig = (UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(each)) for each in (COAT, "/World/rig"))
    mesh.CreatePrimvar("arnold:subdiv_type", types.String, "constant").Set("catclark")
    mesh.CreatePrimvar("arnold:subdiv_iterations", types.UChar, "constant").Set(3, 1.0)
    rig.CreatePrimvar("moonray:mesh_resolution", types.Float, "constant").Set(8.0)
    rig.CreatePrimvar("redshift:object:RS_objprop_rstess_enable", types.Bool, "constant").Set(True)
    rig.CreatePrimvar("redshift:object:RS_objprop_rstess_maxsubd", types.Int, "constant").Set(1)
    mesh.CreatePrimvar("cycles:object:mesh:subdivision_max_level", types.Int, "constant").Set(4)
    mesh.CreatePrimvar("karma:object:dicingquality", types.Float, "constant").Set(2.0)
    stage.GetPrimAtPath(COAT).CreateAttribute("arnold:subdiv_type", types.Token).Set("catclark")
    stage.Save()


LOWERED = {
    "arnold:subdiv_type": "catclark",
    "arnold:subdiv_iterations": 1,
    "moonray:mesh_resolution": 2.0,
    "redshift:object:RS_objprop_rstess_enable": True,
    "redshift:object:RS_objprop_rstess_maxsubd": 0,
    "cycles:object:mesh:subdivision_max_level": 2,
    "karma:object:dicingquality": 2.0,
}
OFF = {
    "arnold:subdiv_type": "none",
    "arnold:subdiv_iterations": 0,
    "moonray:mesh_resolution": 1.0,
    "redshift:object:RS_objprop_rstess_enable": False,
    "redshift:object:RS_objprop_rstess_maxsubd": 0,
    "cycles:object:mesh:subdivision_max_level": 0,
    "karma:object:dicingquality": 2.0,
}


@pytest.mark.parametrize("mode", ["over", "sibling"])
@pytest.mark.parametrize(("scheme", "expected"), [("keep", LOWERED), ("none", OFF)])
def test_renderers_subdivide_as_often_less_as_the_layer_has_done(
    tmp_path: Path, mode: str, scheme: str, expected: dict[str, object]
) -> None:
    """Numbers of subdivisions fall by the layer's two, and all is off where the scheme is none; others stay."""
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    with_renderers(path)
    writer = write_shot(open_shot(str(path), level=2), out, mode=mode, scheme=scheme)
    composed = open_over(path, out)
    prim = composed.GetPrimAtPath(str(writer.targets[0]))
    assert subdividing(prim) == expected
    assert prim.GetAttribute("arnold:subdiv_type").Get() == expected["arnold:subdiv_type"]
    assert prim.GetAttribute("primvars:arnold:subdiv_iterations").Get(1.0) == expected["arnold:subdiv_iterations"]
    assert errors(out) == []
    assert sum("arnold:subdiv_iterations" in str(note) for note in writer.notes) == 1


@pytest.mark.parametrize("scheme", ["keep", "none"])
def test_renderers_that_subdivide_too_far_are_faults(tmp_path: Path, scheme: str) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    with_renderers(path)
    writer = write_shot(open_shot(str(path), level=1), out, scheme=scheme)
    layer = Sdf.Layer.FindOrOpen(str(out))
    prim = layer.GetPrimAtPath(writer.targets[0])
    prim.RemoveProperty(prim.properties["primvars:arnold:subdiv_iterations"])
    layer.Save()
    assert any("a render subdivides" in error for error in errors(out))


def test_vectors_of_the_coarse_surface_are_blocked_and_names_of_faces_carried(tmp_path: Path) -> None:
    path, out, types = tmp_path / "shot.usda", tmp_path / "out.usdc", Sdf.ValueTypeNames
    stage = make_shot(path)
    make = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(COAT)).CreatePrimvar
    for name in ("tangents", "bitangents", "tangentu", "velocities", "accelerations"):
        make(name, types.Vector3fArray, "vertex").Set([(1, 0, 0)] * 20)
    make("crypto_asset", types.StringArray, "uniform").Set([f"part{face % 3}" for face in range(12)])
    make("lightgroup", types.IntArray, "uniform").Set(list(range(12)))
    make("tangentScale", types.FloatArray, "vertex").Set([1.0] * 20)
    stage.Save()
    writer = write_shot(open_shot(str(path), level=1), out)
    composed = open_over(path, out)
    prim = composed.GetPrimAtPath(COAT)
    api = UsdGeom.PrimvarsAPI(prim)
    names = {each.GetPrimvarName() for each in api.GetPrimvarsWithAuthoredValues()}
    assert names == {"crypto_asset", "lightgroup", "tangentScale"}
    groups = list(api.GetPrimvar("lightgroup").ComputeFlattened())
    assert sorted(groups) == sorted(list(range(12)) * 4)
    assert list(api.GetPrimvar("crypto_asset").ComputeFlattened()) == [f"part{face % 3}" for face in groups]
    assert ["tangentu" in str(note) for note in writer.notes] == [True]
    assert errors(out) == []


def add_twin(stage: Usd.Stage, arc: str) -> UsdGeom.Mesh:
    """A mesh that takes all but its points from the coat, by an arc to the coat itself or to the prim above."""
    path = "/World/other" if arc != "above" else "/World/more"
    mesh = stage.DefinePrim(path, "Mesh" if arc != "above" else "Xform")
    if arc == "inherit":
        mesh.GetInherits().AddInherit(COAT)
    else:
        mesh.GetReferences().AddInternalReference(COAT if arc == "reference" else "/World/rig")
    twin = UsdGeom.Mesh(stage.GetPrimAtPath(path if arc != "above" else f"{path}/coat"))
    for time in TIMES:
        twin.GetPointsAttr().Set(vec3(2.0 * grid()[0]), time)
    stage.Save()
    return twin


@pytest.mark.parametrize(("arc", "mode"), [("reference", "over"), ("inherit", "over"), ("above", "sibling")])
def test_a_mesh_that_takes_faces_from_the_garment_keeps_its_own_arrays(
    dressed: Path, tmp_path: Path, arc: str, mode: str
) -> None:
    stage = Usd.Stage.Open(str(dressed))
    path = str(add_twin(stage, arc).GetPath())
    before = shown(stage, path)
    writer = write_shot(open_shot(str(dressed), garments=[COAT], level=1), tmp_path / "out.usdc", mode=mode)
    over = open_over(dressed, tmp_path / "out.usdc")
    after = shown(over, path)
    assert [name for name in before if before[name] != after.get(name)] == []
    assert [str(prim.GetPath()) for prim in over.Traverse() if prim.GetName() == "coat_refined"] == (
        [] if mode == "over" else [f"{COAT}_refined"]
    )
    fine = UsdGeom.Mesh(over.GetPrimAtPath(str(writer.targets[0])))
    assert len(fine.GetPointsAttr().Get(1.0)) == 63
    assert any(f"<{path}>: is composed from <{COAT}> and has points of its own" in str(note) for note in writer.notes)
    assert errors(tmp_path / "out.usdc") == []


def shown(stage: Usd.Stage, path: str) -> dict[str, object]:
    """All values of a mesh and its subsets at the default and at each time code of the coat, without empty ones."""
    prims = Usd.PrimRange(stage.GetPrimAtPath(path))
    codes = [Usd.TimeCode.Default(), *map(Usd.TimeCode, TIMES)]
    found = {str(each.GetPath()): [each.Get(code) for code in codes] for prim in prims for each in prim.GetAttributes()}
    return {name: values for name, values in found.items() if any(value is not None for value in values)}


def test_a_mesh_that_is_all_of_the_garment_is_refined_with_it(dressed: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(dressed))
    stage.DefinePrim("/World/copy").GetReferences().AddInternalReference(COAT)
    stage.Save()
    writer = write_shot(open_shot(str(dressed), garments=[COAT], level=1), tmp_path / "out.usdc")
    over = open_over(dressed, tmp_path / "out.usdc")
    copy = UsdGeom.Mesh(over.GetPrimAtPath("/World/copy"))
    assert len(copy.GetPointsAttr().Get(1.0)) == 63
    assert not any("/World/copy" in str(note) for note in writer.notes)


def test_validate_names_a_mesh_broken_by_the_faces_of_a_refined_one(dressed: Path, tmp_path: Path) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc")
    assert errors(out) == []
    add_twin(Usd.Stage.Open(str(dressed)), "reference")
    (problem,) = [each for each in validate_layer(out) if each.rule == "other_meshes"]
    assert problem.path == "/World/other.faceVertexIndices"
    assert "composed from a refined mesh" in problem.message


def test_faults_of_the_shot_inside_an_instance_that_is_opened_are_the_shots(dressed: Path, tmp_path: Path) -> None:
    """USD's validators pass over what is inside of an instance, here a subset with more faces than the mesh has."""
    stage = Usd.Stage.Open(str(dressed))
    coat = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    UsdGeom.Subset.CreateGeomSubset(coat, "back", "face", Vt.IntArray([3, 4, 5]), "materialBind", "nonOverlapping")
    twin = UsdGeom.Mesh(stage.DefinePrim("/World/other", "Mesh"))
    twin.GetPrim().GetReferences().AddInternalReference(COAT)
    twin.CreateFaceVertexCountsAttr([3])
    twin.CreateFaceVertexIndicesAttr([0, 1, 2])
    twin.GetPrim().SetInstanceable(True)
    stage.Save()
    write_shot(open_shot(str(dressed), garments=[COAT], level=1), tmp_path / "out.usdc")
    assert not open_over(dressed, tmp_path / "out.usdc").GetPrimAtPath("/World/other").IsInstance()
    assert errors(tmp_path / "out.usdc", dressed) == []
