"""Looking over a stage never raises on a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import UsdGeom
from stages import add_sheet, instanced_shot, new_stage, save, set_matrix

from physgraph_usd.usd.read.survey import survey


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


def test_meshes_inside_instances_are_told(tmp_path: Path) -> None:
    assert [mesh.instanced for mesh in survey(instanced_shot(tmp_path)).meshes] == [True, True]
