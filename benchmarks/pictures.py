"""The pictures of samples in docs: coarse and refined.

python -m benchmarks.pictures docs/pictures
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from benchmarks.rows import say
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.page.preview import preview
from physgraph_usd.shot.refine import refine_shot

SHOWN = {"tshirt": 36.0}
"""Time code to draw, by sample."""


def main() -> None:
    """Refine each sample up to its time code and draw it."""
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    for name, time in SHOWN.items():
        with tempfile.TemporaryDirectory() as folder:
            shot = write_sample(name, Path(folder))
            layer = Path(folder) / "refined.usdc"
            refine_shot(shot, layer, RefineOptions(frames=(time - 12.0, time)))
            say(str(preview(layer, out / f"{name}.png", times=[time], size=(1280, 640), overwrite=True)))


if __name__ == "__main__":
    main()
