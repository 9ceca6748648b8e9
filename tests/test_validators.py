"""The rules as validators of UsdValidation: found by name, with the prim's path, and the extent's fixer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from layers import COAT, dress_up, make_shot, write_layer
from pxr import Sdf, Usd, Vt

from physgraph_usd.usd.check.rules import LAYER_RULES, RULES
from physgraph_usd.usd.check.validators import PLUGIN

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


def test_an_older_usd_registers_nothing_and_says_so() -> None:
    hide = "import sys; sys.modules['pxr.UsdValidation'] = None; import physgraph_validators"
    done = run(hide)
    assert done.returncode == 0, done.stderr
    assert "it takes 26.5 or newer" in done.stderr
