"""Refined layers in Blender, and what Blender exports as a shot: both in a process of Blender's own Python."""

import itertools
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from blender import NEEDS_BLENDER
from layers import world_metres
from pxr import Usd, UsdGeom, UsdShade

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import inspect_shot, refine_shot

pytestmark = NEEDS_BLENDER

GARMENTS = {
    "tshirt": "/TshirtShot/Shirt",
    "sleeve": "/SleeveShot/Sleeve",
    "swatch_zup": "/SwatchShot/Swatch",
    "swatch_cm": "/SwatchShot/Swatch",
}
FRAMES = {"tshirt": (12, 13, 14), "sleeve": (20, 21, 22), "swatch_zup": (8, 9, 10), "swatch_cm": (8, 9, 10)}
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns Y up into Blender's Z up."""

LOOK = """
import json, sys, bpy, numpy as np
root, name, out, *frames = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=root, import_subdivision=True)
found = {"meshes": {o.name: [m.type for m in o.modifiers] for o in bpy.data.objects if o.type == "MESH"}, "frames": {}}
cloth, arrays = bpy.data.objects[name], {}
found["slots"] = [slot.material.name for slot in cloth.material_slots]
found["range"] = [bpy.context.scene.frame_start, bpy.context.scene.frame_end]
for frame in frames:
    bpy.context.scene.frame_set(int(frame))
    evaluated = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    world = np.array(evaluated.matrix_world)
    arrays["points" + frame] = np.array([v.co for v in mesh.vertices]) @ world[:3, :3].T + world[:3, 3]
    arrays["normals" + frame] = np.array([n.vector for n in mesh.corner_normals])
    arrays["counts" + frame] = [p.loop_total for p in mesh.polygons]
    arrays["corners" + frame] = [loop.vertex_index for loop in mesh.loops]
    arrays["material" + frame] = [p.material_index for p in mesh.polygons]
    for layer in mesh.uv_layers:
        arrays["uv:" + layer.name + frame] = np.array([uv.vector for uv in layer.uv])
np.savez(out + ".npz", **arrays)
json.dump(found, open(out + ".json", "w"))
"""

EXPORT = """
import json, sys, bpy
out, options = sys.argv[1], json.loads(sys.argv[2])
bpy.ops.wm.read_factory_settings(use_empty=True)
side = [(x / 8, y / 8, 0) for y in range(9) for x in range(9)]
mesh = bpy.data.meshes.new("cloth")
mesh.from_pydata(side, [], [(i, i + 1, i + 10, i + 9) for i in range(71) if i % 9 < 8])
coat, rig = bpy.data.objects.new("coat", mesh), bpy.data.objects.new("rig", None)
coat.parent = rig
for item in (coat, rig):
    bpy.context.scene.collection.objects.link(item)
mesh.materials.append(bpy.data.materials.new("Denim"))
rig["physgraph:material:stretchStiffness"] = 77.0
coat["physgraph:material:bendStiffness"] = 2e-4
coat["physgraph:refine:level"] = 1
mesh["physgraph:material:thickness"] = 0.002
mesh.materials[0]["physgraph:material:density"] = 0.4
pin = coat.vertex_groups.new(name="physgraph:pin")
pin.add(list(range(9)), 1.0, "REPLACE")
bpy.ops.wm.usd_export(filepath=out, **options)
"""


class Seen(NamedTuple):
    """What Blender made of a refined layer, and the stage it was given."""

    stage: Usd.Stage
    prim: Usd.Prim
    coarse: str
    found: dict[str, Any]
    arrays: dict[str, np.ndarray]
    frames: tuple[int, ...]

    def array(self, what: str, frame: int) -> np.ndarray:
        return self.arrays[f"{what}{frame}"]

    def expected_points(self, frame: int) -> np.ndarray:
        """World points [m], Z up."""
        points = world_metres(self.stage, str(self.prim.GetPath()), frame)
        return points if UsdGeom.GetStageUpAxis(self.stage) == "Z" else points @ Z_UP.T


def in_blender(folder: Path, script: str, *arguments: str) -> None:
    python = os.environ["PHYSGRAPH_BPY_PYTHON"]
    (folder / "script.py").write_text(script)
    ran = subprocess.run(
        [python, "script.py", *arguments], cwd=folder, check=False, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stderr


@pytest.fixture(scope="module", params=itertools.product(GARMENTS, ("over", "sibling")), ids="-".join)
def seen(
    request: pytest.FixtureRequest, sample: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> Seen:
    """A sample refined, its root layer imported into Blender with the subdivision modifier allowed."""
    name, mode = request.param
    folder, frames = tmp_path_factory.mktemp(name), FRAMES[name]
    root, prim = folder / "root.usda", GARMENTS[name] + ("_refined" if mode == "sibling" else "")
    options = RefineOptions(level=1, frames=(frames[0], frames[-1]), mode=mode, root=root)
    assert not refine_shot(sample(name), folder / "layer.usdc", options).failed
    in_blender(folder, LOOK, "root.usda", prim.rpartition("/")[2], "seen", *map(str, frames))
    stage = Usd.Stage.Open(str(root))
    found = json.loads((folder / "seen.json").read_text())
    with np.load(folder / "seen.npz") as arrays:
        return Seen(stage, stage.GetPrimAtPath(prim), GARMENTS[name], found, dict(arrays), frames)


def test_the_frames_show_the_refined_points_where_they_are(seen: Seen) -> None:
    size = float(np.linalg.norm(np.ptp(seen.expected_points(seen.frames[0]), axis=0)))
    poses = [seen.expected_points(frame) for frame in seen.frames]
    assert min(np.abs(b - a).max() for a, b in itertools.pairwise(poses)) > 1e-4 * size, "must move"
    for frame, expected in zip(seen.frames, poses, strict=True):
        points = seen.array("points", frame)
        assert points.shape == expected.shape
        assert np.abs(points - expected).max() < 1e-5 * size


def test_the_topology_is_the_refined_one_and_not_subdivided_again(seen: Seen) -> None:
    mesh = UsdGeom.Mesh(seen.prim)
    for frame in seen.frames:
        np.testing.assert_array_equal(seen.array("counts", frame), mesh.GetFaceVertexCountsAttr().Get())
        np.testing.assert_array_equal(seen.array("corners", frame), mesh.GetFaceVertexIndicesAttr().Get())


def test_uvs_have_a_value_per_corner(seen: Seen) -> None:
    expected = np.array(UsdGeom.PrimvarsAPI(seen.prim).GetPrimvar("st").ComputeFlattened())
    for frame in seen.frames:
        values = seen.array("uv:st", frame)
        assert values.shape == (int(seen.array("counts", frame).sum()), 2)
        np.testing.assert_allclose(values, expected, atol=1e-6)


def test_each_face_has_the_material_of_its_subset(seen: Seen) -> None:
    def bound(prim: Usd.Prim) -> str:
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        return material.GetPrim().GetName() if material else "none"

    expected = np.full(len(UsdGeom.Mesh(seen.prim).GetFaceVertexCountsAttr().Get()), bound(seen.prim), object)
    subsets = UsdShade.MaterialBindingAPI(seen.prim).GetMaterialBindSubsets()
    assert len(subsets) == (2 if seen.coarse == GARMENTS["tshirt"] else 0)
    for subset in subsets:
        expected[np.asarray(subset.GetIndicesAttr().Get())] = bound(subset.GetPrim())
    assert sorted(seen.found["slots"]) == sorted(set(expected))
    for frame in seen.frames:
        given = np.array(seen.found["slots"], object)[seen.array("material", frame)]
        np.testing.assert_array_equal(given, expected)


def exported(folder: Path, **options: object) -> Path:
    """A coat with custom properties on every kind of data-block and a vertex group, exported."""
    in_blender(folder, EXPORT, str(folder / "coat.usda"), json.dumps(options))
    return folder / "coat.usda"


@pytest.mark.parametrize("merged", [False, True], ids=["transform and mesh", "merged"])
def test_custom_properties_of_an_export_choose_the_fabric(tmp_path: Path, merged: bool) -> None:
    shot = exported(tmp_path, merge_parent_xform=merged)
    holder = "/root/rig/coat"
    mesh = holder if merged else f"{holder}/cloth"
    name = "physgraph:material:bendStiffness"
    stage = Usd.Stage.Open(str(shot))
    written = stage.GetPrimAtPath(holder).GetAttribute(name)
    assert (written.GetTypeName(), written.IsCustom()) == ("double", True)
    garment = inspect_shot(shot, garments=("coat",))["garments"][0]
    assert garment["path"] == mesh
    assert garment["level"] == 1
    expected = {"bend": 2e-4, "stretch": 77.0, "thickness": 0.002, "density": 0.4}
    assert {name: garment["fabric"][name] for name in expected} == pytest.approx(expected, rel=1e-6)
    sources = {name: garment["sources"][name].partition(">")[0] for name in garment["sources"]}
    assert sources["bendStiffness"] == f"<{holder}"
    assert sources["stretchStiffness"] == "</root/rig"
    assert sources["thickness"] == f"<{mesh}"
    assert sources["density"] == "</root/_materials/Denim"


def test_a_vertex_group_pins(tmp_path: Path) -> None:
    assert inspect_shot(exported(tmp_path), garments=("coat",))["garments"][0]["pinned_points"] == 9


def test_an_export_is_refined_as_it_is(tmp_path: Path) -> None:
    shot = exported(tmp_path)
    report = refine_shot(shot, tmp_path / "fine.usdc", RefineOptions(garments=("/root/rig/coat",), steps=2))
    assert not report.failed
    assert report.garments[0]["fabric"]["bend"] == pytest.approx(2e-4)
