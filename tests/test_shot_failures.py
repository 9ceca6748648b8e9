"""Shots that are broken: frames that fail, points that are repaired, files that are no stage."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bodies import ball
from pxr import Sdf
from shots import CLOTH, TIMES, cloth_shot, faults, fine, only, refine, sample_times
from stages import COLLIDER_API, add_mesh, add_sheet, new_stage, save, sheet_points, vec3

from physgraph_usd.errors import GarmentError, UsageError


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "shot.usdc")


class TestFramesThatFail:
    """Points of 1e25 m: finite in the file, not in the energy."""

    def test_one_is_named_and_the_others_are_written(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc", broken={3.0: 1e25})
        out, told = tmp_path / "fine.usdc", tmp_path / "fine.json"
        report = refine(shot, out, report=told)
        assert report.exit_code == 3
        assert list(report.failed) == ["3"]
        assert CLOTH in report.failed["3"]
        assert "time code 3" in report.failed["3"]
        assert sample_times(out) == (1.0, 2.0, 4.0, 5.0, 6.0)
        assert json.loads(told.read_text())["failed"].keys() == {"3"}
        assert faults(out, shot) == []

    def test_all_of_them_leave_no_layer(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc", broken=dict.fromkeys(TIMES, 1e25))
        with pytest.raises(GarmentError, match="at time code 6: point 0 is at"):
            refine(shot, tmp_path / "fine.usdc")
        assert only(tmp_path, "shot.usdc")


CUT = """
import os, sys
from pathlib import Path
from physgraph_usd import PhysGraphError, RefineOptions, refine_shot
shot = Path(sys.argv[1])
def cut(done, total):
    os.truncate(shot, int(float(sys.argv[2]) * shot.stat().st_size))
try:
    refine_shot(shot, shot.with_name("fine.usdc"), RefineOptions(level=1, steps=2, progress=cut))
except PhysGraphError as error:
    sys.stdout.write(str(error))
"""


@pytest.mark.parametrize("part", [pytest.param(0.0, marks=pytest.mark.slow), 0.6])
def test_a_shot_that_is_cut_short_while_it_is_read_is_named(tmp_path: Path, part: float):
    """In a process of its own: where layers are mapped into memory, it dies of SIGBUS."""
    shot = cloth_shot(tmp_path / "shot.usdc", size=(24, 24))
    line = [sys.executable, "-c", CUT, str(shot), str(part)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "shot.usdc" in done.stdout
    assert "\n" not in done.stdout
    assert only(tmp_path, "shot.usdc", "fine.usdc.frames")


EACH = """
import sys
from physgraph_usd import PhysGraphError, refine_shot
for shot in sys.argv[1:]:
    try:
        refine_shot(shot, "fine.usdc")
    except PhysGraphError as error:
        print(error)
"""


def test_damaged_crates_are_named(tmp_path: Path):
    """A child that is not there, names that are none, a value that is none: USD ends the process, or raises."""
    shot = tmp_path / "shot.usdc"
    layer = Sdf.Layer.CreateNew(str(shot))
    layer.customLayerData = {"a": {"b": Sdf.AssetPath("a.usd"), "active": 1.0, "nested": {"x": {"y": 2}}}}
    Sdf.PrimSpec(layer, "A", Sdf.SpecifierDef)
    layer.Save()
    data, names = shot.read_bytes(), []
    for place, patch in ((248, b"\x01"), (244, bytes(8)), (128, bytes(8))):
        names.append(f"damaged{place}.usdc")
        (tmp_path / names[-1]).write_bytes(data[:place] + patch + data[place + len(patch) :])
    line = [sys.executable, "-c", EACH, *names]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(names), "each is an error of one line"
    assert only(tmp_path, "shot.usdc", *names)


@pytest.mark.parametrize(("below", "why"), [(0.02, "deep in </World/body>"), (0.0226, "from its cage")])
def test_one_garment_that_cannot_be_solved_follows_its_cage(tmp_path: Path, below: float, why: str):
    """A patch of 2 cm that a ball of 10 cm swallows, or pushes by more than it is large, beside one in the air."""
    stage = new_stage(tmp_path / "shot.usda", metres=1.0)
    for name, size, aside in (("patch", 0.005, 0.0), ("cloth", 0.05, 1.0)):
        points = size * (np.asarray(sheet_points(1.0), np.float64) - sheet_points(1.0).mean(axis=0))[:, [0, 2, 1]]
        mesh = add_sheet(stage, f"/World/{name}", times=(1.0, 2.0), default=False)
        for time in (1.0, 2.0):
            mesh.GetPointsAttr().Set(vec3(points + np.array([aside, 0.001 * time, 0.0])), time)
    points, faces = ball(0.05)
    body = add_mesh(stage, "/World/body", points - [0.0, below, 0.0], faces, schema=COLLIDER_API)
    body.CreateSubdivisionSchemeAttr("none")
    shot, out = Path(save(stage)), tmp_path / "fine.usdc"
    report = refine(shot, out)
    assert (report.exit_code, report.failed) == (3, {})
    assert {entry["path"] for entry in report.unsettled if entry["error"]} == {"/World/patch"}
    (warning,) = (each for each in report.warnings if "follows its cage" in each)
    assert warning.startswith("</World/patch> at time code ")
    assert why in warning
    assert faults(out, shot) == []
    assert fine(shot, out, 2.0, prim="/World/patch")[:, 1].max() < 0.01
    assert report.frames[1]["garments"][1]["levels"]
    with pytest.raises(UsageError, match="exists"):  # What was done in part is not taken as done.
        refine(shot, out, resume=True)
