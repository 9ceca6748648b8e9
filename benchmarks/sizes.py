"""Lines of Python by room of the package, beside the sizes that are aimed at.

python -m benchmarks.sizes [ROOT]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.rows import say

AIMS = {
    ("contact", "collide", "colliders"): 4_500,
    ("frame",): 1_500,
    ("integrate",): 2_600,
    ("",): 12_500,
}
"""Rooms of the solver, "" for all of it, and the lines that each is to have at most."""
PACKAGE, TESTS = 29_000, 20_000
"""The same of the package and of the tests."""


def lines_in(folder: Path) -> int:
    """Lines of all Python files under a folder."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in folder.rglob("*.py"))


def rows_of(root: Path) -> list[tuple[str, int, int]]:
    """Name, lines and aim of each part of a checkout."""
    solver = root / "physgraph_usd" / "solver"
    rooms = [
        (" + ".join(f"{name or 'solver'}/" for name in names), sum(lines_in(solver / name) for name in names), aim)
        for names, aim in AIMS.items()
    ]
    whole = (("physgraph_usd/", PACKAGE), ("tests/", TESTS))
    return rooms + [(name, lines_in(root / name), aim) for name, aim in whole]


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    root = Path(arguments[0]) if arguments else Path(__file__).parents[1]
    for name, lines, aim in rows_of(root):
        say(f"{name:36} {lines:7,} {aim:7,}")


if __name__ == "__main__":
    main(sys.argv[1:])
