"""Programs that open a refined shot: the table in docs/layers.md is what each of them finds in the files.

Blender runs in the Python of PHYSGRAPH_BPY_PYTHON, three.js from the folder PHYSGRAPH_NODE_MODULES, tinyusdz in the
Python of PHYSGRAPH_TINYUSDZ_PYTHON. Readers that are not named are skipped.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from pxr import Usd, UsdUtils
from shots import CLOTH, cloth_shot, refine

FILES = ("root.usda", "fine.usdc", "flat.usda", "flat.usdc", "flat.usdz")
PAGE = Path(__file__).parents[1] / "docs" / "layers.md"

_USD = """
import sys
from pxr import Usd, UsdGeom
for file in sys.argv[1:]:
    stage = Usd.Stage.Open(file)
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    print(max((len(mesh.GetFaceVertexCountsAttr().Get(1.0)) for mesh in meshes), default=0))
"""
_BLENDER = """
import sys
import bpy
for file in sys.argv[1:]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=file)
    found = max((len(each.data.polygons) for each in bpy.data.objects if each.type == "MESH"), default=0)
    print(f"faces {found}")
"""
_THREE = """
import { readFileSync } from 'node:fs';
import { USDLoader } from 'three/examples/jsm/loaders/USDLoader.js';
for (const file of process.argv.slice(2)) {
  const bytes = readFileSync(file), text = file.endsWith('.usda');
  const data = text ? bytes.toString() : bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
  let faces = 0;
  new USDLoader().parse(data).traverse((node) => {
    if (node.isMesh) faces = Math.max(faces, node.geometry.attributes.position.count / 6);
  });
  console.log(faces);
}
"""
_TINYUSDZ = """
import sys
import tinyusdz
for file in sys.argv[1:]:
    found = [prim for prim in tinyusdz.traverse(tinyusdz.load(file)) if prim.type_name == "Mesh"]
    counts = [prim.get_attribute("faceVertexCounts").value.to_string() for prim in found]
    print(max((text.count(",") + 1 for text in counts), default=0))
"""


def needed(name: str) -> str:
    """A program or folder named by an environment variable; skips without."""
    if not os.environ.get(name):
        pytest.skip(f"{name} names no such reader")
    return os.environ[name]


def read_by_usd(folder: Path) -> list[str]:
    """Command that reads files by usd-core."""
    (folder / "read.py").write_text(_USD)
    return [sys.executable, "read.py"]


def read_by_blender(folder: Path) -> list[str]:
    """Command that imports files into Blender."""
    (folder / "read.py").write_text(_BLENDER)
    return [needed("PHYSGRAPH_BPY_PYTHON"), "read.py"]


def read_by_three(folder: Path) -> list[str]:
    """Command that loads files by three.js."""
    modules, node = needed("PHYSGRAPH_NODE_MODULES"), shutil.which("node")
    if node is None:
        pytest.skip("no node on the path")
    (folder / "node_modules").symlink_to(modules)
    (folder / "read.mjs").write_text(_THREE)
    return [node, "read.mjs"]


def read_by_tinyusdz(folder: Path) -> list[str]:
    """Command that loads files by tinyusdz."""
    (folder / "read.py").write_text(_TINYUSDZ)
    return [needed("PHYSGRAPH_TINYUSDZ_PYTHON"), "read.py"]


READERS = {
    "usd-core": read_by_usd,
    "Blender": read_by_blender,
    "three.js": read_by_three,
    "tinyusdz": read_by_tinyusdz,
}


def row_of(reader: str) -> list[str]:
    """Cells of a reader's row in the table of docs/layers.md, without its name."""
    (row,) = re.findall(rf"^\| {re.escape(reader)}[^|]*\|(.*)\|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return [cell.strip() for cell in row.split("|")]


def found_in(command: Sequence[str], folder: Path) -> list[int]:
    """Most faces of a mesh that a command finds in each of the files, run in their folder."""
    done = subprocess.run([*command, *FILES], cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    numbers = re.findall(r"^(?:faces )?(\d+)$", done.stdout, re.MULTILINE)
    assert len(numbers) == len(FILES), done.stdout
    return [*map(int, numbers)]


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_programs_open_what_the_page_says(tmp_path: Path, reader: str) -> None:
    """Cloth is the refined mesh with all of its faces, empty is no mesh at all."""
    command = READERS[reader](tmp_path)
    refine(cloth_shot(tmp_path / "shot.usda"), tmp_path / "fine.usdc", root=tmp_path / "root.usda")
    stage = Usd.Stage.Open(str(tmp_path / "root.usda"))
    for file in ("flat.usda", "flat.usdc"):
        stage.Export(str(tmp_path / file))
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "flat.usdc"), str(tmp_path / "flat.usdz"))
    faces = len(stage.GetAttributeAtPath(f"{CLOTH}.faceVertexCounts").Get(1.0))
    said = {faces: "cloth", 0: "empty"}
    assert [said.get(each, f"{each} faces") for each in found_in(command, tmp_path)] == row_of(reader)
