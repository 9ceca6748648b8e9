"""Without cholespy, of which Linux on ARM has no wheel, the same cloth comes out."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from pxr import Sdf
from shots import CLOTH, TIMES, cloth_shot, refine

APART = 1e-4
"""Most that positions may differ [m]: 2 thousandths of an edge of the cage, from sums in another order."""
WITHOUT = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "cholespy":
            raise ModuleNotFoundError(f"no {name}", name=name)
sys.meta_path.insert(0, Missing())
from physgraph_usd.cli import main
main()
"""


def test_scipy_factorises_where_cholespy_is_not(tmp_path: Path) -> None:
    shot = cloth_shot(tmp_path / "shot.usda")
    assert not any("scipy" in warning for warning in refine(shot, tmp_path / "with.usdc").warnings)
    out, report = tmp_path / "without.usdc", tmp_path / "report.json"
    words = ["refine", shot, "-o", out, "--level", "1", "--steps", "6", "--report", report]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, *map(str, words)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("scipy") == 1
    assert any("scipy" in warning for warning in json.loads(report.read_text(encoding="utf-8"))["warnings"])
    layers = [Sdf.Layer.FindOrOpen(str(tmp_path / f"{name}.usdc")) for name in ("with", "without")]
    for time in TIMES:
        one, other = (np.asarray(layer.QueryTimeSample(f"{CLOTH}.points", time)) for layer in layers)
        assert np.abs(one - other).max() * layers[0].pseudoRoot.GetInfo("metersPerUnit") < APART
