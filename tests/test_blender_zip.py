"""The add-on's zip: Blender installs the file by itself, and says what to do where the solver is missing."""

import os
import subprocess
import sys
from pathlib import Path

from blender import NEEDS_BLENDER
from test_docs import ROOT

pytestmark = NEEDS_BLENDER
INSTALL = """
import sys, bpy
import addon_utils
bpy.ops.wm.read_factory_settings(use_empty=True)
addon_utils.enable("bl_pkg")
bpy.ops.extensions.package_install_files(repo="user_default", filepath=sys.argv[1], enable_on_install=True)
name = "bl_ext.user_default.physgraph_usd"
print("usual", bpy.context.preferences.addons[name].preferences.command)
bpy.context.preferences.addons[name].preferences.command = "no-such-physgraph-usd"
mesh = bpy.data.meshes.new("coat")
mesh.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [], [(0, 1, 2)])
coat = bpy.data.objects.new("coat", mesh)
bpy.context.collection.objects.link(coat)
coat.select_set(True)
bpy.context.view_layer.objects.active = coat
try:
    bpy.ops.physgraph.refine()
except RuntimeError as error:
    print("said", str(error).strip())
"""


def test_the_zip_installs_and_a_missing_solver_is_named_with_the_remedy(tmp_path: Path) -> None:
    place = tmp_path / "addon.zip"
    solver = tmp_path / "my solver" / "physgraph-usd"
    solver.parent.mkdir()
    solver.touch()
    line = ["make", "blender", f"ADDON={place}", f"PYTHON={sys.executable}", f"SOLVER={solver}"]
    subprocess.run(line, cwd=ROOT, check=True)
    line = [os.environ["PHYSGRAPH_BPY_PYTHON"], "-c", INSTALL, str(place)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"BLENDER_USER_RESOURCES": str(tmp_path / "user"), "TMPDIR": str(tmp_path)}
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert f"usual {solver}" in done.stdout.splitlines(), "the add-on knows the solver of its zip"
    (said,) = [line for line in done.stdout.splitlines() if line.startswith("said ")]
    assert "cannot run 'no-such-physgraph-usd'" in said
    assert "Install physgraph-usd in a Python of its own" in said
    assert "Edit > Preferences > Add-ons > PhysGraph Cloth" in said
    assert list((tmp_path / "user").rglob("blender_manifest.toml"))
