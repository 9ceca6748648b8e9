"""The validator catches every fault that we know how to make, and finds none in what we write."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layers import COAT, dress_up, errors, make_shot, vec3, write_layer
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from shots import CLOTH, cloth_shot, refine

from physgraph_usd.errors import LayerError
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.usd.check.rules import LAYER_RULES, RULES
from physgraph_usd.usd.check.validate import Problem, validate_layer
from physgraph_usd.usd.check.validators import PLUGIN

Mutation = Callable[[Sdf.Layer], None]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dressed shot and its refined layer of polygons, as text."""
    folder = tmp_path_factory.mktemp("good")
    dress_up(make_shot(folder / "shot.usda"))
    return write_layer(folder / "shot.usda", folder / "out.usda", velocities=True, scheme="none")


@pytest.fixture(scope="module")
def surface(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dressed shot and its refined layer with the cage's scheme, as text."""
    folder = tmp_path_factory.mktemp("surface")
    dress_up(make_shot(folder / "shot.usda"))
    return write_layer(folder / "shot.usda", folder / "out.usda")


def at(name: str) -> Sdf.Path:
    return Sdf.Path(COAT).AppendProperty(name)


def attribute(layer: Sdf.Layer, name: str) -> Sdf.AttributeSpec:
    return layer.GetAttributeAtPath(at(name))


def default(name: str, edit: Callable[[np.ndarray], object]) -> Mutation:
    """Replace an attribute's default by what ``edit`` makes of it."""

    def mutate(layer: Sdf.Layer) -> None:
        spec = attribute(layer, name)
        spec.default = edit(np.array(spec.default))

    return mutate


def sample(name: str, edit: Callable[[np.ndarray], object], *, time: float = 2.5) -> Mutation:
    def mutate(layer: Sdf.Layer) -> None:
        layer.SetTimeSample(at(name), time, edit(np.array(layer.QueryTimeSample(at(name), time))))

    return mutate


def drop(name: str) -> Mutation:
    def mutate(layer: Sdf.Layer) -> None:
        prim = layer.GetPrimAtPath(COAT)
        prim.RemoveProperty(prim.properties[name])

    return mutate


def author(name: str, type_name: Sdf.ValueTypeName, value: object) -> Mutation:
    def mutate(layer: Sdf.Layer) -> None:
        spec = layer.GetAttributeAtPath(at(name))
        if spec is None:
            spec = Sdf.AttributeSpec(layer.GetPrimAtPath(COAT), name, type_name)
        spec.default = value

    return mutate


def with_nan(points: np.ndarray) -> object:
    points[7, 1] = np.nan
    return vec3(points)


def subset_indices(edit: Callable[[list[int]], list[int]]) -> Mutation:
    def mutate(layer: Sdf.Layer) -> None:
        spec = layer.GetAttributeAtPath(Sdf.Path(f"{COAT}/front.indices"))
        spec.default = edit(list(spec.default))

    return mutate


def shift_times(layer: Sdf.Layer) -> None:
    """Write every sample ten codes late, as a forgotten layer offset would."""
    for name in ("points", "normals", "extent", "velocities"):
        for time in list(layer.ListTimeSamplesForPath(at(name))):
            layer.SetTimeSample(at(name), time + 10, layer.QueryTimeSample(at(name), time))
            layer.EraseTimeSample(at(name), time)


def scaled(layer: Sdf.Layer) -> None:
    """Write metres into a stage of centimetres."""
    for name in ("points", "extent"):
        for time in list(layer.ListTimeSamplesForPath(at(name))):
            layer.SetTimeSample(at(name), time, vec3(0.01 * np.array(layer.QueryTimeSample(at(name), time))))


def in_variant(layer: Sdf.Layer) -> None:
    Sdf.CreatePrimInLayer(layer, Sdf.Path("/World{look=red}coat"))


def rename_garment(layer: Sdf.Layer) -> None:
    data = dict(layer.customLayerData)
    data["physgraph"] = {**data["physgraph"], "garments": Vt.StringArray(["/World/gone"])}
    layer.customLayerData = data


def no_rate(layer: Sdf.Layer) -> None:
    layer.ClearTimeCodesPerSecond()


def interpolation(layer: Sdf.Layer) -> None:
    attribute(layer, "normals").SetInfo("interpolation", "faceVarying")


FAULTS: dict[str, tuple[str, Mutation]] = {
    "counts do not sum to indices": ("topology", default("faceVertexCounts", lambda a: Vt.IntArray(a[:-1].tolist()))),
    "an index out of range": ("topology", default("faceVertexIndices", lambda a: Vt.IntArray((a + 1).tolist()))),
    "too few points at one time": ("topology", sample("points", lambda a: vec3(a[:20]))),
    "NaN": ("points", sample("points", with_nan)),
    "no counts": ("opinions_together", drop("faceVertexCounts")),
    "no normals": ("opinions_together", drop("normals")),
    "animated indices": (
        "opinions_together",
        lambda layer: layer.SetTimeSample(at("faceVertexIndices"), 1.0, attribute(layer, "faceVertexIndices").default),
    ),
    "normals not unit": ("normals", sample("normals", lambda a: vec3(2 * a))),
    "normals inside out": ("normals", sample("normals", lambda a: vec3(-a), time=4.0)),
    "normals of corners": ("normals", interpolation),
    "an extent too small": ("extent", sample("extent", lambda a: vec3(0.5 * a))),
    "a primvar of coarse length": ("primvars", drop("primvars:heat")),
    "indices that stay coarse": ("primvars", drop("primvars:label:indices")),
    "texture indices out of range": ("primvars", drop("primvars:st")),
    "a subset out of range": ("subsets", subset_indices(lambda faces: [*faces, 4800])),
    "a partition with a hole": ("subsets", subset_indices(lambda faces: faces[:-1])),
    "a limit surface with normals": (
        "normals",
        author("subdivisionScheme", Sdf.ValueTypeNames.Token, "catmullClark"),
    ),
    "creases left": ("subdivision", drop("creaseIndices")),
    "accelerations left": ("leftovers", drop("accelerations")),
    "a primvar over the normals": (
        "leftovers",
        author("primvars:normals", Sdf.ValueTypeNames.Normal3fArray, vec3(np.ones((1, 3)))),
    ),
    "orientation changed": ("leftovers", author("orientation", Sdf.ValueTypeNames.Token, "leftHanded")),
    "coarse velocities": ("velocities", drop("velocities")),
    "joint influences": (
        "skinning",
        author("primvars:skel:jointIndices", Sdf.ValueTypeNames.IntArray, Vt.IntArray([0])),
    ),
    "no rate": ("time_scale", no_rate),
    "another rate": ("same_metadata", lambda layer: setattr(layer, "timeCodesPerSecond", 24.0)),
    "another unit": ("same_metadata", lambda layer: layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)),
    "a sublayer": ("self_contained", lambda layer: layer.subLayerPaths.append("./shot.usda")),
    "an opinion in a variant": ("self_contained", in_variant),
    "no record": ("record", lambda layer: setattr(layer, "customLayerData", {})),
    "a garment that is not there": ("composition", rename_garment),
    "samples at other times": ("against_shot", shift_times),
    "metres for centimetres": ("against_shot", scaled),
}


SURFACE_FAULTS: dict[str, tuple[str, Mutation]] = {
    "the cage's normals": ("normals", drop("normals")),
    "Loop's scheme of quads": ("subdivision", author("subdivisionScheme", Sdf.ValueTypeNames.Token, "loop")),
    "the cage's creases": ("subdivision", drop("creaseIndices")),
    "a length for each edge missing": ("subdivision", drop("creaseLengths")),
    "a corner out of range": ("subdivision", author("cornerIndices", Sdf.ValueTypeNames.IntArray, Vt.IntArray([63]))),
    "a corner without sharpness": ("subdivision", author("cornerSharpnesses", Sdf.ValueTypeNames.FloatArray, [])),
}
"""Faults of a layer with the cage's scheme."""


def find(good: Path, tmp_path: Path, mutate: Mutation) -> list[Problem]:
    """Validate a mutated copy of the good layer."""
    layer = Sdf.Layer.OpenAsAnonymous(str(good))
    mutate(layer)
    layer.Export(str(tmp_path / "bad.usda"))
    return validate_layer(tmp_path / "bad.usda", good.parent / "shot.usda")


def test_a_good_layer_has_no_problem(good: Path) -> None:
    assert [problem for problem in validate_layer(good) if problem.rule != "validators"] == []


@pytest.mark.parametrize("name", FAULTS)
def test_a_seeded_fault_is_caught(good: Path, tmp_path: Path, name: str) -> None:
    rule, mutate = FAULTS[name]
    found = [problem for problem in find(good, tmp_path, mutate) if problem.severity == "error"]
    assert rule in {problem.rule for problem in found}
    assert all(problem.path.startswith("/") for problem in found)


@pytest.mark.parametrize("name", SURFACE_FAULTS)
def test_a_seeded_fault_of_a_subdivision_surface_is_caught(surface: Path, tmp_path: Path, name: str) -> None:
    rule, mutate = SURFACE_FAULTS[name]
    assert [problem for problem in validate_layer(surface) if problem.rule != "validators"] == []
    assert rule in {problem.rule for problem in find(surface, tmp_path, mutate) if problem.severity == "error"}


def test_a_mesh_still_skinned_is_caught(tmp_path: Path) -> None:
    stage = make_shot(tmp_path / "shot.usda")
    out = write_layer(tmp_path / "shot.usda", tmp_path / "out.usda")
    assert [problem for problem in validate_layer(out) if problem.severity == "error"] == []
    binding = UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath(COAT).GetParent())
    binding.CreateJointIndicesPrimvar(True, 1).Set([0])
    stage.Save()
    assert "skinning" in {problem.rule for problem in validate_layer(out)}


def test_an_over_inside_an_instance_is_caught(tmp_path: Path) -> None:
    make_shot(tmp_path / "shot.usda")
    out = write_layer(tmp_path / "shot.usda", tmp_path / "out.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "set.usda"))
    stage.SetTimeCodesPerSecond(30.0)
    prim = stage.DefinePrim("/World")
    prim.GetReferences().AddReference("shot.usda")
    prim.SetInstanceable(True)
    stage.Save()
    found = validate_layer(out, tmp_path / "set.usda")
    assert any(problem.rule == "composition" and "instance" in problem.message for problem in found)


def test_usd_validators_run_and_the_shots_own_faults_are_left_out(tmp_path: Path) -> None:
    pytest.importorskip("pxr.UsdValidation", reason="this version of USD has no validators of its own")
    stage = make_shot(tmp_path / "shot.usda")
    stage.GetRootLayer().ClearDefaultPrim()
    stage.Save()
    out = write_layer(tmp_path / "shot.usda", tmp_path / "out.usda")
    assert [problem for problem in validate_layer(out) if problem.rule != "validators"] == []
    layer = Sdf.Layer.OpenAsAnonymous(str(out))
    # A fault that the validators of every version know.
    Sdf.CreatePrimInLayer(layer, "/World/nested").referenceList.Prepend(Sdf.Reference(primPath="/Nowhere"))
    layer.Export(str(tmp_path / "bad.usda"))
    rules = {problem.rule for problem in validate_layer(tmp_path / "bad.usda")}
    assert any(":" in rule for rule in rules), rules


@pytest.mark.slow
@pytest.mark.parametrize("package", os.environ.get("PHYSGRAPH_USD_VERSIONS", "").split(os.pathsep))
def test_layers_pass_with_another_usd_core(sample: Callable[[str], Path], tmp_path: Path, package: str) -> None:
    if not package:
        pytest.skip(
            "no other usd-core: PHYSGRAPH_USD_VERSIONS names folders made by pip install --target usd-core==..."
        )
    path = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "physgraph_usd"]
    layer = str(tmp_path / "fine.usdc")
    for words in (["refine", str(sample("swatch")), "-o", layer, "--level", "1"], ["validate", layer]):
        done = subprocess.run(
            [*command, *words], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert "error" not in done.stdout


def test_without_the_shot_of_its_record_a_layer_fails(good: Path, tmp_path: Path) -> None:
    (tmp_path / "out.usda").write_bytes(good.read_bytes())
    (found,) = validate_layer(tmp_path / "out.usda")
    assert (found.severity, found.rule) == ("error", "record")
    assert str(tmp_path / "shot.usda") in found.message
    assert "--shot" in found.message
    assert errors(tmp_path / "out.usda", good.parent / "shot.usda") == []
    layer = Sdf.Layer.OpenAsAnonymous(str(good))
    no_rate(layer)
    layer.Export(str(tmp_path / "bad.usda"))
    assert {problem.rule for problem in validate_layer(tmp_path / "bad.usda")} == {"record", "time_scale"}


def test_a_file_that_is_no_layer_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "cut.usdc").write_bytes(b"PXR-USDC cut")
    with pytest.raises(LayerError, match="cannot read"):
        validate_layer(tmp_path / "cut.usdc")


def test_a_value_beyond_its_limits_is_named_with_them_by_inspect_too(tmp_path: Path) -> None:
    shot, out, name = cloth_shot(tmp_path / "sheet.usda"), tmp_path / "out.usda", "physgraph:material:density"
    refine(shot, out, level=0, frames=(1.0, 1.0))
    stage, refined = Usd.Stage.Open(str(shot)), Sdf.Layer.FindOrOpen(str(out))
    authored = stage.GetPrimAtPath(CLOTH).CreateAttribute(name, Sdf.ValueTypeNames.Float)
    over = refined.GetPrimAtPath(CLOTH)

    def found(value: float) -> str:
        authored.Set(value)
        stage.Save()
        kept = over.attributes.get(name) or Sdf.AttributeSpec(over, name, Sdf.ValueTypeNames.Float)
        kept.default = value
        return "\n".join(str(each) for each in validate_layer(out, shot) if each.rule == "limits")

    assert found(0.2) == ""
    assert f"<{CLOTH}.{name}>: is 50 kg/m^2, beyond its soft limits 0.01 .. 2" in found(50.0)
    assert f"{name} is 50 kg/m^2" in str(inspect_shot(shot)["warnings"])
    assert "is -1 kg/m^2, beyond its hard limits 0.0001 .." in found(-1.0)
    assert f"{name} is -1" in inspect_shot(shot)["problem"]


def test_cloth_is_compared_with_its_cage_in_the_world(tmp_path: Path) -> None:
    """Flattened a thousand times, cloth that sags by a millimetre sags by a metre in the garment's own space."""
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0))
    stage = Usd.Stage.Open(str(shot))
    matrix = Gf.Matrix4d(1.0)
    matrix[1, 1], matrix[1, 0] = 1e-3, 1e-2
    UsdGeom.Xformable(stage.GetPrimAtPath(CLOTH)).MakeMatrixXform().Set(matrix)
    stage.Save()
    assert refine(shot, tmp_path / "fine.usdc").exit_code == 0
    assert errors(tmp_path / "fine.usdc", shot) == []


FOLDER = Path(__file__).parents[1] / "plugins" / "usdvalidation"
CHECK = """
import json, sys
from pxr import Usd, UsdValidation as V
import physgraph_validators
stage = Usd.Stage.Open(sys.argv[1])
layer = stage.GetLayerStack(False)[-2]
registry = V.ValidationRegistry()
validators = registry.GetOrLoadValidatorsByName([m.name for m in registry.GetValidatorMetadataForKeyword("PhysGraph")])
errors = V.ValidationContext(validators).Validate(stage)
fixed = []
for error in errors:
    for fixer in error.GetFixers():
        target = Usd.EditTarget(layer)
        if len(sys.argv) > 2 and fixer.CanApplyFix(error, target):
            fixed.append(fixer.ApplyFix(error, target))
print(json.dumps({"errors": [[str(e.GetIdentifier()), e.GetMessage()] for e in errors], "fixed": fixed,
    "heavy": [m for m in ("torch", "warp") if m in sys.modules]}))
"""


def run(*words: str) -> subprocess.CompletedProcess[str]:
    """A Python of its own: what registers once stays for the process."""
    path = os.pathsep.join([str(FOLDER), str(FOLDER.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])])
    env = os.environ | {"PYTHONPATH": path, "PXR_PLUGINPATH_NAME": str(FOLDER)}
    return subprocess.run([sys.executable, "-c", *words], env=env, capture_output=True, text=True, check=False)


def check(stage: Path, *, fix: bool = False) -> dict[str, list]:
    done = run(CHECK, str(stage), *(["fix"] if fix else []))
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return json.loads(done.stdout)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A file with the refined layer over its shot."""
    own = pytest.importorskip("pxr.UsdValidation", reason="this version of USD has no validators of its own")
    if not hasattr(own.ValidationRegistry, "RegisterPluginPrimValidator"):
        pytest.skip("registering validators from Python takes USD 26.5")
    dress_up(make_shot(tmp_path / "shot.usda"))
    write_layer(tmp_path / "shot.usda", tmp_path / "out.usda", velocities=True)
    made = Sdf.Layer.CreateNew(str(tmp_path / "root.usda"))
    made.subLayerPaths[:] = ["out.usda", "shot.usda"]
    made.timeCodesPerSecond = Usd.Stage.Open(str(tmp_path / "shot.usda")).GetTimeCodesPerSecond()
    made.Save()
    return tmp_path / "root.usda"


def test_the_plugin_lists_each_rule_with_its_doc() -> None:
    (plugin,) = json.loads((FOLDER / "plugInfo.json").read_text(encoding="utf-8"))["Plugins"]
    listed = dict(plugin["Info"]["Validators"])
    assert (plugin["Name"], plugin["Type"], listed.pop("keywords")) == (PLUGIN, "python", ["PhysGraph"])
    rules = (*LAYER_RULES, *RULES)
    assert {name: row["doc"] for name, row in listed.items()} == {
        rule.__name__: (rule.__doc__ or "").split("\n")[0] for rule in rules
    }


def test_a_good_stage_has_no_error_and_needs_no_solver(root: Path) -> None:
    assert check(root) == {"errors": [], "fixed": [], "heavy": []}


def test_broken_points_are_found_by_name_and_place(root: Path) -> None:
    layer = Sdf.Layer.FindOrOpen(str(root.parent / "out.usda"))
    path = Sdf.Path(COAT).AppendProperty("points")
    broken = np.array(layer.QueryTimeSample(path, 2.5))
    broken[7] = np.nan
    layer.SetTimeSample(path, 2.5, Vt.Vec3fArray.FromNumpy(broken))
    layer.ClearTimeCodesPerSecond()
    layer.Save()
    found = dict(check(root, fix=True)["errors"])
    assert found[f"{PLUGIN}:points.points"].startswith(f"<{COAT}.points> at time code 2.5: point 7 is not finite")
    assert found[f"{PLUGIN}:time_scale.time_scale"].startswith("</>: timeCodesPerSecond is not authored")


def test_the_extent_is_fixed_and_nothing_else_changes(root: Path) -> None:
    file = root.parent / "out.usda"
    before = file.read_text(encoding="utf-8")
    layer = Sdf.Layer.FindOrOpen(str(file))
    path = Sdf.Path(COAT).AppendProperty("extent")
    layer.SetTimeSample(path, 2.5, Vt.Vec3fArray([(0, 0, 0), (1, 1, 1)]))
    layer.SetTimeSample(path, 77.0, Vt.Vec3fArray([(0, 0, 0), (1, 1, 1)]))
    layer.Save()
    assert file.read_text(encoding="utf-8") != before
    first = check(root, fix=True)
    assert {name for name, _ in first["errors"]} == {f"{PLUGIN}:extent.extent"}
    assert first["fixed"]
    assert all(first["fixed"])
    assert check(root)["errors"] == []
    assert file.read_text(encoding="utf-8") == before
