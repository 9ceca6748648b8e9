"""Levels that a bound on time would choose for each garment, beside refine's default of 2.

    python -m benchmarks.auto_level [FOLDER] [--bound 2]

For samples and, where FOLDER holds the real shots, for those: the cage's mean edge, the fabric's shortest folds, the
level that resolves them, estimated seconds a frame of one core at levels 1 to 3, and a choice. This is garment by
garment the level that the folds ask for, from 1 to 3; while the whole shot's estimate is over the bound, the garment
with most vertices gets a level less. Nothing is solved. Times are `physgraph_usd.shot.estimate`'s; `benchmarks.costs`
measures them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import click

from physgraph_usd.lab.samples import SAMPLES, write_sample
from physgraph_usd.shot.estimate import estimate
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import open_for
from physgraph_usd.solver.contact.crowding import Crowding, CrowdingMeter
from physgraph_usd.solver.mesh.subdivide import fine_count
from physgraph_usd.solver.resolution import LevelChoice, choose_levels, sample_frames
from physgraph_usd.solver.scene import Garment

from .contact_shots import REAL
from .rows import say

FLAG = "07_flag_quads_nocollider.usda"
LEAST, MOST, DEFAULT = 1, 3, 2
HEAD = (
    "| shot | cage, mm | folds, mm | resolved at | s a frame at 1, 2, 3 | chosen | vertices | at level 2 |\n"
    "|---|---|---|---|---|---|---|---|"
)


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--bound", default=2.0, show_default=True, help="Most seconds a frame of one core.")
def main(folder: Path | None, bound: float) -> None:
    """Print a row a shot."""
    say(HEAD)
    with tempfile.TemporaryDirectory() as made:
        for name in SAMPLES:
            say(f"| {name} | {row(write_sample(name, Path(made)), RefineOptions(), bound)} |")
    for name, (garments, colliders, _) in (REAL | {FLAG: (["/shot/flag"], [], 0)}).items() if folder else ():
        options = RefineOptions(garments=tuple(garments), colliders=tuple(colliders))
        say(f"| {name} | {row(Path(folder or '') / name, options, bound)} |")


def row(file: Path, options: RefineOptions, bound: float) -> str:
    """Cells of a shot's row, but for its name."""
    with closing(open_for(str(file), options)) as shot:
        frames, garments = sample_frames(shot.every_time, shot.frame), shot.scene.garments
        choices, meter = choose_levels(shot.scene, frames), CrowdingMeter(shot.scene)
        crowding = [meter.measure(frame) for frame in frames]
    times = [seconds(garments, [level] * len(garments), crowding) for level in range(LEAST, MOST + 1)]
    levels = bounded(garments, choices, crowding, bound=bound)
    cells = (
        ", ".join(f"{1e3 * each.edge * 2**each.level:.0f}" for each in choices),
        ", ".join(f"{1e3 * each.wavelength:.1f}" for each in choices),
        ", ".join(str(each.needed) for each in choices),
        ", ".join(f"{each:.2g}" for each in times),
        ", ".join(map(str, levels)),
        f"{vertices(garments, levels):,}",
        f"{vertices(garments, [DEFAULT] * len(garments)):,}",
    )
    return " | ".join(cells)


def bounded(
    garments: Sequence[Garment], choices: Sequence[LevelChoice], crowding: Sequence[Crowding], *, bound: float
) -> list[int]:
    """Level of each garment by its folds, and by the most seconds a frame that the whole shot may take."""
    levels = [min(max(choice.needed, LEAST), MOST) for choice in choices]
    while seconds(garments, levels, crowding) > bound and max(levels) > LEAST:
        finer = [index for index, level in enumerate(levels) if level > LEAST]
        levels[max(finer, key=lambda index: fine_count(garments[index].mesh, levels[index]))] -= 1
    return levels


def seconds(garments: Sequence[Garment], levels: Sequence[int], crowding: Sequence[Crowding]) -> float:
    """Estimated time of one core for a frame [s]."""
    return estimate(garments, levels, crowding=crowding).seconds or 0.0


def vertices(garments: Sequence[Garment], levels: Sequence[int]) -> int:
    """Fine vertices of all garments."""
    return sum(fine_count(each.mesh, level) for each, level in zip(garments, levels, strict=True))


if __name__ == "__main__":
    main()
