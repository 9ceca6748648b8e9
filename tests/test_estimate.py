"""What refining costs is said before it begins, and what cannot fit is refused with the level that can."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cloth import sheet
from sheets import garment_of
from shots import cloth_shot, command, fine, refine
from stages import add_sheet, new_stage, save

from physgraph_usd.errors import GarmentError
from physgraph_usd.estimate import cannot_fit, estimate, memory_there
from physgraph_usd.mesh.subdivide import fine_count, subdivide_times
from physgraph_usd.mesh.topology import PolygonMesh
from physgraph_usd.shot import inspect_shot


@pytest.mark.parametrize("kind", ["quads", "triangles", "ngons", "mixed"])
def test_the_number_of_fine_vertices_is_exact(tmp_path: Path, kind: str):
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0,), kind=kind)
    report = refine(shot, tmp_path / "out.usdc", level=2)
    assert report.estimate["fine_vertices"] == len(fine(shot, tmp_path / "out.usdc", 1.0))


def test_it_is_exact_where_faces_share_edges_and_corners_oddly():
    mesh = PolygonMesh(np.array([3, 4, 3, 5]), np.array([0, 1, 2, 2, 1, 3, 4, 1, 2, 5, 4, 8, 6, 7, 0]), 10)
    for level in range(4):
        chain = subdivide_times(mesh, level)
        assert fine_count(mesh, level) == (chain[-1].mesh if chain else mesh).vertex_count


def test_dry_runs_and_inspect_say_what_it_costs(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usda")
    dry = refine(shot, tmp_path / "out.usdc", level=3, dry_run=True)
    assert inspect_shot(shot, level=3)["estimate"] == dry.estimate
    assert list(dry.estimate) == ["fine_vertices", "memory_mb", "layer_mb", "first_frame_seconds", "seconds_a_frame"]
    done = command("refine", shot, "-o", tmp_path / "out.usdc", "--level", 1, "--dry-run")
    assert json.loads(done.stdout)["estimate"]["fine_vertices"] == 117


def test_the_estimate_is_within_a_factor_of_two_of_what_a_run_takes(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usda", size=(60, 40))
    done = command("refine", shot, "-o", tmp_path / "out.usdc", "--level", 2, "--report", tmp_path / "report.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert 0.5 < report["estimate"]["memory_mb"] / report["peak_memory_mb"] < 2.0
    assert 0.5 < report["estimate"]["layer_mb"] / ((tmp_path / "out.usdc").stat().st_size / 1e6) < 2.0


def test_what_cannot_fit_is_refused_with_the_level_that_can():
    garment = garment_of(*sheet(20, 20, kind="quads"))
    there = estimate([garment], [3]).memory + 1.0
    assert cannot_fit([garment], [3], memory=there) is None
    error = cannot_fit([garment], [5], memory=there)
    assert isinstance(error, GarmentError)
    assert str(error).startswith("</World/Sheet>: level 5 makes 410,881 fine vertices, which need about ")
    assert str(error).endswith("; use --level 3")
    assert "fewer --workers" in str(cannot_fit([garment], [3], memory=there, frames=8, workers=2))
    assert str(cannot_fit([garment], [3], memory=1e6)).endswith("reduce the cage")


@pytest.mark.skipif(memory_there() > 1e11, reason="this machine could hold it")
def test_sixty_thousand_quads_at_level_five_are_refused_before_anything_is_made(tmp_path: Path):
    stage = new_stage(tmp_path / "shot.usda", metres=0.01)
    add_sheet(stage, times=(1.0,), size=(250, 248))
    shot = save(stage)
    assert "use --level " in inspect_shot(shot, level=5)["problem"]
    for dry_run in (False, True):
        with pytest.raises(GarmentError, match=r"</World/cloth>: level 5 makes 63,503,937 fine.*; use --level \d"):
            refine(Path(shot), tmp_path / "out.usdc", level=5, dry_run=dry_run)
    assert not (tmp_path / "out.usdc").exists()
