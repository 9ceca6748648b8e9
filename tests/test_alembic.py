"""Alembic by way of Blender: a refined garment out, and a cage in, as docs/handoff.md and the first tutorial say."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from blender import NEEDS_BLENDER
from layers import world_metres
from pxr import Usd, UsdGeom
from shots import TIMES, cloth_shot, fine, refine

from physgraph_usd.shot.refine import inspect_shot

pytestmark = NEEDS_BLENDER
TRIP = """
import sys, bpy
root, cache, out = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=root)
bpy.ops.wm.alembic_export(filepath=cache, start=1, end=6)
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.alembic_import(filepath=cache, as_background_job=False)
bpy.ops.wm.usd_export(filepath=out, export_animation=True)
"""


def test_refined_cloth_goes_through_alembic_and_back_to_usd(tmp_path: Path) -> None:
    shot, layer, root = cloth_shot(tmp_path / "shot.usda"), tmp_path / "fine.usdc", tmp_path / "root.usda"
    refine(shot, layer, root=root)
    cache, out = tmp_path / "fine.abc", tmp_path / "back.usdc"
    line = [os.environ["PHYSGRAPH_BPY_PYTHON"], "-c", TRIP, *map(str, (root, cache, out))]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    stage = Usd.Stage.Open(str(out))
    (cloth,) = (str(prim.GetPath()) for prim in stage.Traverse() if UsdGeom.Mesh(prim))
    for time in (TIMES[0], TIMES[-1]):
        sizes = [np.sort(np.ptp(each, axis=0)) for each in (fine(shot, layer, time), world_metres(stage, cloth, time))]
        assert sizes[1] == pytest.approx(sizes[0], rel=1e-4)
    (found,) = inspect_shot(out, garments=[cloth])["garments"]
    assert (found["path"], found["points"]) == (cloth, len(fine(shot, layer, 1.0)))
