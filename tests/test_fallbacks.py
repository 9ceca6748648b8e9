"""Without what a machine may lack the same cloth comes out: cholespy (Linux on ARM), POSIX, the extras but usd."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf
from shots import CLOTH, FAST, TIMES, cloth_shot, refine

APART = 1e-4
"""Most that positions may differ [m]: 2 thousandths of an edge of the cage, from sums in another order."""
POSIX_ONLY = ("fcntl", "grp", "pwd", "resource", "termios")
EXTRAS = ("matplotlib", "plotly", "viser", "PIL", "distributed")
WITHOUT = f"""
import sys
sys.modules["cholespy"] = None
# What others do on other systems is their business.
import torch, warp, scipy.sparse.linalg, click._termui_impl, filelock, pxr.Usd
sys.modules.update(dict.fromkeys({(*POSIX_ONLY, *EXTRAS)!r}))
from physgraph_usd.cli import main
main()
"""


def without(*words: object) -> str:
    """What the command says on stderr in a Python that lacks them."""
    line = [sys.executable, "-c", WITHOUT, *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.slow
def test_scipy_factorises_and_the_peak_of_memory_is_not_known(tmp_path: Path) -> None:
    shot, out, report = cloth_shot(tmp_path / "shot.usda"), tmp_path / "without.usdc", tmp_path / "report.json"
    assert not any("scipy" in warning for warning in refine(shot, tmp_path / "with.usdc").warnings)
    asked = ("--level", FAST["level"], "--steps", FAST["steps"])
    assert without("refine", shot, "-o", out, *asked, "--report", report).count("scipy") == 1
    told = json.loads(report.read_text(encoding="utf-8"))
    assert told["peak_memory_mb"] is None
    assert any("scipy" in warning for warning in told["warnings"])
    layers = [Sdf.Layer.FindOrOpen(str(tmp_path / f"{name}.usdc")) for name in ("with", "without")]
    for time in TIMES:
        one, other = (np.asarray(layer.QueryTimeSample(f"{CLOTH}.points", time)) for layer in layers)
        assert np.abs(one - other).max() * layers[0].pseudoRoot.GetInfo("metersPerUnit") < APART
