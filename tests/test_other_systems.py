"""Starting where POSIX is not, with no extra but usd: no module of such systems is needed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from shots import cloth_shot

POSIX_ONLY = ("fcntl", "grp", "pwd", "resource", "termios")
EXTRAS = ("matplotlib", "plotly", "viser", "PIL", "distributed")
"""Libraries that a farm node can do without."""
BLOCKED = f"""
import sys
# What others do on other systems is their business.
import torch, warp, scipy.sparse.linalg, click._termui_impl, filelock, pxr.Usd
sys.modules.update(dict.fromkeys({(*POSIX_ONLY, *EXTRAS)!r}))
from physgraph_usd.cli import main
main()
"""


def test_inspect_and_refine_start_without_posix_and_extras(tmp_path: Path) -> None:
    """The peak of memory is not known there."""
    shot, out, report = cloth_shot(tmp_path / "s.usda", times=(1.0, 2.0)), tmp_path / "o.usdc", tmp_path / "r.json"
    line = [sys.executable, "-c", BLOCKED]
    inspected = subprocess.run([*line, "inspect", str(shot)], capture_output=True, text=True, check=False)
    assert inspected.returncode == 0, inspected.stderr
    words = ["refine", shot, "-o", out, "--level", "0", "--report", report]
    refined = subprocess.run([*line, *map(str, words)], capture_output=True, text=True, check=False)
    assert refined.returncode == 0, refined.stderr
    assert '"peak_memory_mb": null' in report.read_text(encoding="utf-8")
