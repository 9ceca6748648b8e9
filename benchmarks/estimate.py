"""Memory and layer size of the samples, measured and as `physgraph_usd.shot.estimate` expects them.

    python -m benchmarks.estimate [--short]

Each case refines two frames by the command in a process of its own, for its peak memory and the size of its layer. The
last columns say how many times the estimate is what was measured.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.usd.read.reader import open_shot

CASES = (("sleeve", 1), ("sleeve", 2), ("flag", 2), ("skirt", 2), ("tshirt", 2), ("armpit", 2), ("layers", 2))
LARGE = (("sleeve", 3), ("skirt", 3), ("flag", 4), ("sleeve", 4))


def main() -> None:
    """Print the table."""
    cases = CASES if "--short" in sys.argv else CASES + LARGE
    sys.stdout.write("sample level  vertices  peak MB layer MB  over measured: memory, layer\n")
    with tempfile.TemporaryDirectory() as folder:
        for name, level in cases:
            sys.stdout.write(row(name, level, Path(folder)) + "\n")
            sys.stdout.flush()


def row(name: str, level: int, folder: Path) -> str:
    """One case, measured and estimated."""
    shot = write_sample(name, folder)
    times = open_shot(str(shot)).scene.times
    out, report = shot.with_name("out.usdc"), shot.with_name("report.json")
    line = [sys.executable, "-m", "physgraph_usd", "refine", shot, "-o", out, "--overwrite", "--report", report]
    line += ["--level", level, "--frames", f"{times[0]:g}:{times[1]:g}"]
    subprocess.run([str(part) for part in line], check=True, capture_output=True)
    told = json.loads(report.read_text())
    measured = {"memory_mb": 1.048576 * told["peak_memory_mb"], "layer_mb": out.stat().st_size / 1e6}
    shown = "".join(f"{value:9.2f}" for value in measured.values())
    ratios = "  ".join(f"{told['estimate'][key] / value:.2f}" for key, value in measured.items())
    return f"{name:7}{level:5}{told['estimate']['fine_vertices']:10,}{shown}  {ratios}"


if __name__ == "__main__":
    main()
