"""How long an artist waits in `tune`: from a slider to the cloth, by median, at 25,000 vertices or more.

    python -m benchmarks.tune [--quick]

Moves the stretch, bending, density and guide sliders of a frame of the skirt to random places, one after another, with
contact and without. Prints wall and processor seconds of the quick solve from where the cloth was, and of the solve as
`refine` makes it at rest. Other work on the machine lengthens wall seconds alone.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.rows import say
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.studio.session import Shown, TuneSession
from physgraph_usd.studio.values import TUNABLES

MOVED = ("stretchStiffness", "bendStiffness", "density", "guide:stiffness")
MOVES, SHORT_MOVES = 24, 8
SETTLED = 3
"""How often the solve at rest is timed."""


def main() -> None:
    """Measure both and print the medians."""
    moves = SHORT_MOVES if "--quick" in sys.argv else MOVES
    with tempfile.TemporaryDirectory() as folder:
        session = TuneSession(write_sample("skirt", Path(folder)))
        session.set_time(session.times[len(session.times) // 2])
        points = session.solve().points[0]
        count = 0 if points is None else len(points)
        say(f"skirt, {count:,} vertices, one move of a slider; medians in seconds")
        for contact in (False, True):
            session.set_contact(contact)
            session.solve()
            soon, rest = measure(session, moves)
            words = "with contact" if contact else "without contact"
            say(f"{words}: quick {told(soon)}; at rest, as refine does, {told(rest)}")
        session.close()


def measure(session: TuneSession, moves: int) -> tuple[list[Shown], list[Shown]]:
    """Quick solves after so many moves, and some solves at rest."""
    chance, garment = random.Random(1), session.garments[0]
    soon, rest = [], []
    for move in range(moves):
        name = MOVED[move % len(MOVED)]
        session.set_value(garment, name, TUNABLES[name].at(chance.random()))
        soon.append(session.solve())
        if (move + 1) % (moves // SETTLED) == 0:
            settled = session.settle()
            assert settled is not None
            rest.append(settled)
    return soon, rest


def told(solves: list[Shown]) -> str:
    """Medians, and the longest."""
    wall, cpu = [each.seconds for each in solves], [each.cpu_seconds for each in solves]
    return f"{median(wall):.2f} wall, {median(cpu):.2f} processor, longest {max(wall):.2f} wall"


if __name__ == "__main__":
    main()
