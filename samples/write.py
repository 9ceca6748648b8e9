"""Writes every sample shot into a folder: python samples/write.py [FOLDER]."""

from __future__ import annotations

import sys
from pathlib import Path

from physgraph_usd.lab.samples import SAMPLES, write_sample


def main(folder: Path) -> None:
    """Write all samples and say where they are.

    Args:
        folder: Where to; created when missing.
    """
    for name in SAMPLES:
        sys.stdout.write(f"{write_sample(name, folder)}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/samples"))
