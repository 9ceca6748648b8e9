"""Garments and colliders are found; a survey of a stage never raises on a mesh."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdPhysics
from stages import COLLIDER_API, add_sheet, author, new_stage, save, set_matrix

from physgraph_usd.errors import StageError
from physgraph_usd.usd.read.find import find_colliders, find_garments
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.read.survey import survey


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    made = new_stage(tmp_path / "s.usda")
    add_sheet(made, "/World/hero/coat")
    add_sheet(made, "/World/hero/hat", tagged=False)
    add_sheet(made, "/World/crowd/coat", tagged=False)
    UsdGeom.Cube.Define(made, "/World/box")
    return made


def paths(prims: list[Usd.Prim]) -> list[str]:
    return [str(prim.GetPath()) for prim in prims]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ([], ["/World/hero/coat"]),
        (["/World/hero/hat"], ["/World/hero/hat"]),
        (["/World/hero"], ["/World/hero/coat", "/World/hero/hat"]),
        (["coat"], ["/World/hero/coat", "/World/crowd/coat"]),
        (["/World/*/coat"], ["/World/hero/coat", "/World/crowd/coat"]),
        (["*hat", "coat"], ["/World/hero/coat", "/World/hero/hat", "/World/crowd/coat"]),
        (["*/c???"], ["/World/hero/coat", "/World/crowd/coat"]),
    ],
)
def test_garments_by_schema_path_name_and_glob(stage: Usd.Stage, wanted: list[str], expected: list[str]) -> None:
    assert paths(find_garments(stage, wanted)) == expected


def test_garments_by_collection(stage: Usd.Stage) -> None:
    collection = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "clothes")
    collection.IncludePath("/World/hero")
    collection.ExcludePath("/World/hero/hat")
    assert paths(find_garments(stage, ["/World.collection:clothes"])) == ["/World/hero/coat"]
    with pytest.raises(StageError, match="no collection 'shoes'; collections: clothes"):
        find_garments(stage, ["/World.collection:shoes"])


def test_without_any_garment_the_meshes_are_listed_with_the_ways_to_name_one(tmp_path: Path) -> None:
    plain = new_stage(tmp_path / "plain.usda")
    add_sheet(plain, "/World/coat", tagged=False)
    said = "--garment PATH names one, and inspect proposes some; meshes: /World/coat"
    with pytest.raises(StageError, match=said):
        find_garments(plain)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("/World/nobody", "no prim at </World/nobody>; meshes: /World/hero/coat, /World/hero/hat"),
        ("/World/box", "names no Mesh"),
        ("*sock", "names no Mesh; meshes: "),
        ("//bad path", "is no prim path"),
    ],
)
def test_what_is_not_there_lists_what_is(stage: Usd.Stage, wanted: str, message: str) -> None:
    with pytest.raises(StageError, match=message):
        find_garments(stage, [wanted])


@pytest.mark.parametrize("state", ["abstract", "over"])
def test_prims_that_do_not_exist_say_why(stage: Usd.Stage, state: str) -> None:
    if state == "abstract":
        stage.CreateClassPrim("/_class")
        UsdGeom.Mesh.Define(stage, "/_class/cloth")
    else:
        UsdGeom.Mesh(stage.OverridePrim("/World/ghost"))
    with pytest.raises(StageError, match=state):
        find_garments(stage, ["/_class/cloth" if state == "abstract" else "/World/ghost"])


def test_colliders_by_schema_whatever_their_visibility_and_purpose(stage: Usd.Stage) -> None:
    kinds = {"a": UsdGeom.Sphere, "b": UsdGeom.Mesh, "c": UsdGeom.Capsule, "d": UsdGeom.Plane, "e": UsdGeom.Cube}
    prims = {name: kind.Define(stage, f"/World/{name}").GetPrim() for name, kind in kinds.items()}
    for name in "abc":
        prims[name].AddAppliedSchema(COLLIDER_API)
    UsdGeom.Imageable(prims["a"]).MakeInvisible()
    UsdGeom.Imageable(prims["b"]).CreatePurposeAttr("guide")
    prims["c"].SetActive(False)
    UsdPhysics.CollisionAPI.Apply(prims["d"])
    UsdPhysics.CollisionAPI.Apply(prims["e"]).CreateCollisionEnabledAttr(False)
    assert paths(find_colliders(stage, find_garments(stage))) == ["/World/a", "/World/b", "/World/d"]
    author(prims["a"], "physgraph:collider:enabled", False, kind="bool")
    assert paths(find_colliders(stage, find_garments(stage))) == ["/World/b", "/World/d"]


def test_colliders_by_relationship_and_by_path(stage: Usd.Stage) -> None:
    for name in ("a", "b"):
        UsdGeom.Sphere.Define(stage, f"/World/{name}").GetPrim().AddAppliedSchema(COLLIDER_API)
    garments = find_garments(stage)
    relationship = garments[0].CreateRelationship("physgraph:colliders")
    relationship.SetTargets([Sdf.Path("/World/box")])
    assert paths(find_colliders(stage, garments)) == ["/World/box"]
    assert paths(find_colliders(stage, garments, ["/World/b", "/World/hero"])) == ["/World/hero/hat", "/World/b"]
    relationship.SetTargets([Sdf.Path("/World/gone")])
    with pytest.raises(StageError, match="/World/gone"):
        find_colliders(stage, garments)


def test_every_mesh_is_told_and_broken_ones_say_why(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda", metres=None)
    add_sheet(stage, "/World/good")
    add_sheet(stage, "/World/plain", tagged=False, times=())
    add_sheet(stage, "/World/short").GetFaceVertexIndicesAttr().Set([0, 1, 2])
    set_matrix(add_sheet(stage, "/World/flat").GetPrim(), np.diag([1.0, 1.0, 0.0, 1.0]))
    UsdGeom.Mesh.Define(stage, "/World/none")
    found = survey(save(stage))
    meshes = {mesh.path.removeprefix("/World/"): mesh for mesh in found.meshes}
    assert [name for name, mesh in meshes.items() if not mesh.problem] == ["good", "plain"]
    assert "sum to 48 but there are 3" in meshes["short"].problem
    assert "singular" in meshes["flat"].problem
    assert "has no points" in meshes["none"].problem
    assert (meshes["good"].garment, meshes["plain"].garment) == (True, False)
    assert (meshes["good"].points, meshes["good"].faces, meshes["good"].times) == (20, 12, (1.0, 2.0, 3.0))
    assert found.metres_per_unit == 0.01
    assert "metersPerUnit" in str(found.notices[0])


@pytest.mark.parametrize("shown", ["default", "override"])
def test_a_level_of_detail_that_is_not_shown_is_no_garment_and_no_body(tmp_path: Path, shown: str) -> None:
    stage = new_stage(tmp_path / "s.usda")
    for kind, tagged in (("coat", True), ("body", False)):
        for level in ("high", "low"):
            mesh = add_sheet(stage, f"/World/{kind}/{level}/shape", tagged=tagged)
            if not tagged:
                mesh.GetPrim().AddAppliedSchema(COLLIDER_API)
        root = stage.GetPrimAtPath(f"/World/{kind}")
        root.AddAppliedSchema("LODRootAPI")
        author(root, "lod:default:index", 1 if shown == "default" else 0, kind="int")
    if shown == "override":
        author(stage.GetPrimAtPath("/World"), "lod:override:mode", "indexedLOD", kind="token")
        author(stage.GetPrimAtPath("/World"), "lod:override:index", 1.0, kind="double")
    for wanted in ([], ["/World/coat"], ["/World/coat/*"]):
        assert paths(find_garments(stage, wanted)) == ["/World/coat/low/shape"]
    garments = find_garments(stage)
    for wanted in ([], ["/World/body"]):
        assert paths(find_colliders(stage, garments, wanted)) == ["/World/body/low/shape"]
    assert paths(find_garments(stage, ["/World/coat/high/shape"])) == ["/World/coat/high/shape"]


@pytest.mark.parametrize("index", [float("nan"), float("inf"), -float("inf")])
def test_a_level_of_detail_by_no_number_is_the_first(tmp_path: Path, index: float) -> None:
    stage = new_stage(tmp_path / "s.usda")
    for name in ("high", "low"):
        add_sheet(stage, f"/World/coat/{name}")
    stage.GetPrimAtPath("/World/coat").AddAppliedSchema("LODRootAPI")
    author(stage.GetPrimAtPath("/World"), "lod:override:mode", "indexedLOD", kind="token")
    author(stage.GetPrimAtPath("/World"), "lod:override:index", index, kind="double")
    assert paths(find_garments(stage)) == ["/World/coat/high"]


def test_faces_that_are_counted_elsewhere_are_named(tmp_path: Path) -> None:
    """The refined mesh has other faces; vertices of the cage keep their numbers."""
    stage = new_stage(tmp_path / "s.usda")
    add_sheet(stage, "/World/coat")
    add_sheet(stage, "/World/body", tagged=False)
    attachment = stage.DefinePrim("/World/attachment", "PhysicsVtxTriAttachment")
    for number, target in enumerate(("/World/body", "/World/coat")):
        attachment.CreateRelationship(f"physics:src{number}").SetTargets([target])
        author(attachment, f"physics:triIndicesSrc{number}", [0, 1], kind="int[]")
        author(attachment, f"physics:vtxIndicesSrc{number}", [0, 1], kind="int[]")
    notices = [str(each) for each in open_shot(save(stage), level=1).warnings]
    assert [each.partition(" ")[0] for each in notices] == ["</World/attachment>:"]
    assert "triIndicesSrc1 counts faces of </World/coat>" in notices[0]
