"""The validator catches every fault that we know how to make, and finds none in what we write."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layers import COAT, dress_up, errors, make_shot, vec3, write_layer
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdSkel, Vt
from shots import CLOTH, cloth_shot, refine

from physgraph_usd.errors import AbsentError, LayerError
from physgraph_usd.usd.check.validate import Problem, validate_layer

Mutation = Callable[[Sdf.Layer], None]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dressed shot and its refined layer, as text."""
    folder = tmp_path_factory.mktemp("good")
    dress_up(make_shot(folder / "shot.usda"))
    return write_layer(folder / "shot.usda", folder / "out.usda", velocities=True)


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
    """Replace one time sample."""

    def mutate(layer: Sdf.Layer) -> None:
        layer.SetTimeSample(at(name), time, edit(np.array(layer.QueryTimeSample(at(name), time))))

    return mutate


def drop(name: str) -> Mutation:
    """Remove an attribute."""

    def mutate(layer: Sdf.Layer) -> None:
        prim = layer.GetPrimAtPath(COAT)
        prim.RemoveProperty(prim.properties[name])

    return mutate


def author(name: str, type_name: Sdf.ValueTypeName, value: object) -> Mutation:
    """Add an attribute."""

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
    "a face of two corners": ("topology", default("faceVertexCounts", lambda a: Vt.IntArray([2, 6, *a[2:].tolist()]))),
    "too few points at one time": ("topology", sample("points", lambda a: vec3(a[:20]))),
    "more points at one time": ("points", sample("points", lambda a: vec3(np.concatenate([a, a])))),
    "a coarse default": ("points", default("points", lambda a: vec3(a[:20]))),
    "NaN": ("points", sample("points", with_nan)),
    "infinity at the default": ("points", default("points", lambda a: vec3(np.full_like(a, np.inf)))),
    "no counts": ("opinions_together", drop("faceVertexCounts")),
    "no extent": ("opinions_together", drop("extent")),
    "no normals": ("opinions_together", drop("normals")),
    "animated indices": (
        "opinions_together",
        lambda layer: layer.SetTimeSample(at("faceVertexIndices"), 1.0, attribute(layer, "faceVertexIndices").default),
    ),
    "too few normals": ("normals", sample("normals", lambda a: vec3(a[:-1]))),
    "normals not unit": ("normals", sample("normals", lambda a: vec3(2 * a))),
    "normals inside out": ("normals", sample("normals", lambda a: vec3(-a), time=4.0)),
    "normals at other times": ("normals", lambda layer: layer.EraseTimeSample(at("normals"), 2.5)),
    "normals of corners": ("normals", interpolation),
    "an extent too small": ("extent", sample("extent", lambda a: vec3(0.5 * a))),
    "an extent too large": ("extent", sample("extent", lambda a: vec3(2 * a + 1))),
    "an extent held": ("extent", lambda layer: layer.EraseTimeSample(at("extent"), 4.0)),
    "a primvar of coarse length": ("primvars", drop("primvars:heat")),
    "a varying primvar of coarse length": ("primvars", drop("primvars:zone")),
    "a primvar of coarse length at one time": (
        "primvars",
        sample("primvars:wave", lambda a: Vt.FloatArray(a[:20].tolist())),
    ),
    "indices that stay coarse": ("primvars", drop("primvars:label:indices")),
    "coarse texture indices": ("primvars", drop("primvars:st:indices")),
    "texture indices out of range": ("primvars", drop("primvars:st")),
    "an index not blocked": ("primvars", drop("primvars:tone:indices")),
    "elements of two": (
        "primvars",
        default("primvars:pair", lambda a: Vt.HalfArray.FromNumpy(np.ascontiguousarray(a[::2]))),
    ),
    "a subset out of range": ("subsets", subset_indices(lambda faces: [*faces, 4800])),
    "a subset with a face twice": ("subsets", subset_indices(lambda faces: [*faces, faces[0]])),
    "a partition with a hole": ("subsets", subset_indices(lambda faces: faces[:-1])),
    "a partition that overlaps": ("subsets", subset_indices(lambda faces: [*faces, 47])),
    "a limit surface": ("leftovers", author("subdivisionScheme", Sdf.ValueTypeNames.Token, "catmullClark")),
    "creases left": ("leftovers", drop("creaseIndices")),
    "corners left": ("leftovers", drop("cornerIndices")),
    "accelerations left": ("leftovers", drop("accelerations")),
    "a primvar over the normals": (
        "leftovers",
        author("primvars:normals", Sdf.ValueTypeNames.Normal3fArray, vec3(np.ones((1, 3)))),
    ),
    "orientation changed": ("leftovers", author("orientation", Sdf.ValueTypeNames.Token, "leftHanded")),
    "coarse velocities": ("velocities", drop("velocities")),
    "too few velocities": ("velocities", sample("velocities", lambda a: vec3(a[:3]))),
    "joint influences": (
        "skinning",
        author("primvars:skel:jointIndices", Sdf.ValueTypeNames.IntArray, Vt.IntArray([0])),
    ),
    "no rate": ("time_scale", no_rate),
    "another rate": ("same_metadata", lambda layer: setattr(layer, "timeCodesPerSecond", 24.0)),
    "another unit": ("same_metadata", lambda layer: layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)),
    "another axis": ("same_metadata", lambda layer: layer.pseudoRoot.SetInfo("upAxis", "Y")),
    "another range": ("same_metadata", lambda layer: setattr(layer, "endTimeCode", 99.0)),
    "a sublayer": ("self_contained", lambda layer: layer.subLayerPaths.append("./shot.usda")),
    "an opinion in a variant": ("self_contained", in_variant),
    "no record": ("record", lambda layer: setattr(layer, "customLayerData", {})),
    "a garment that is not there": ("composition", rename_garment),
    "samples at other times": ("against_shot", shift_times),
    "metres for centimetres": ("against_shot", scaled),
    "another place": ("against_shot", sample("points", lambda a: vec3(a + 100.0), time=4.0)),
}


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


def test_a_problem_names_path_time_and_values(good: Path, tmp_path: Path) -> None:
    found = find(good, tmp_path, sample("points", with_nan))
    nan = next(problem for problem in found if problem.rule == "points")
    assert nan.path == f"{COAT}.points"
    assert nan.time == 2.5
    assert "point 7 is not finite" in nan.message
    assert str(nan) == f"error: <{COAT}.points> at time code 2.5: {nan.message} [points]"


def test_a_mesh_still_skinned_is_caught(tmp_path: Path) -> None:
    stage = make_shot(tmp_path / "shot.usda")
    UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath(COAT))
    stage.Save()
    out = write_layer(tmp_path / "shot.usda", tmp_path / "out.usda")
    assert [problem for problem in validate_layer(out) if problem.severity == "error"] == []
    layer = Sdf.Layer.OpenAsAnonymous(str(out))
    layer.GetPrimAtPath(COAT).ClearInfo("apiSchemas")
    layer.Export(str(tmp_path / "bad.usda"))
    assert "skinning" in {problem.rule for problem in validate_layer(tmp_path / "bad.usda")}


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


def test_validators_that_do_not_load_are_named_and_the_others_run(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with usd-core 25.2 and 25.5, whose packages lack the libraries of most validators."""
    own = pytest.importorskip("pxr.UsdValidation", reason="this version of USD has no validators of its own")
    real = own.ValidationRegistry

    class Registry:
        def __init__(self) -> None:
            self._all = real()

        def GetAllValidatorMetadata(self) -> list:
            return self._all.GetAllValidatorMetadata()

        def GetOrLoadValidatorByName(self, name: str) -> object:
            if name != "usdValidation:CompositionErrorTest":
                Tf.RaiseRuntimeError("Failed to load plugin: cannot open shared object file")
            return self._all.GetOrLoadValidatorByName(name)

        def GetOrLoadAllValidators(self) -> list:
            return [self.GetOrLoadValidatorByName(each.name) for each in self.GetAllValidatorMetadata()]

    monkeypatch.setattr(own, "ValidationRegistry", Registry)
    (found,) = validate_layer(good)
    assert (found.severity, found.rule) == ("warning", "validators")
    assert "usdValidation:StageMetadataChecker" in found.message
    assert "CompositionErrorTest" not in found.message


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


def test_files_that_are_not_there_are_said_to_be_missing(good: Path, tmp_path: Path) -> None:
    for layer, shot in ((tmp_path / "nothing.usda", None), (good, tmp_path / "nothing.usda")):
        with pytest.raises(AbsentError, match=f"^no such file: {tmp_path / 'nothing.usda'}$"):
            validate_layer(layer, shot)


def test_a_file_that_is_no_layer_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "cut.usdc").write_bytes(b"PXR-USDC cut")
    with pytest.raises(LayerError, match="cannot read"):
        validate_layer(tmp_path / "cut.usdc")


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
