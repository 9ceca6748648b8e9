"""How long an artist waits in `tune`: from a move of a slider to the first new cloth, and to the settled cloth.

    python -m benchmarks.tune [--moves 20] [--shot NAME]... [--folder SHOTS] [--device cuda] [--page | --processor]
    python -m benchmarks.tune --pictures docs

Moves six sliders of a frame in the middle of each shot to random places, one after another, with contact; real shots
where their folder is given. Prints a row a shot: median and longest wall seconds until the first round is handed over
and until the frame is settled; with ``--processor`` seconds of the processor, for a busy machine. With ``--page`` a
browser is driven instead, and the time is from the mouse's press to the new vertices at the graphics card; without a
card the processor draws, on the solver's cores. ``--pictures`` writes the pictures and the film of docs/tune.md; it
takes the program ffmpeg.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir
from pathlib import Path
from statistics import median

import click

from benchmarks import page_driver
from benchmarks.contact_shots import REAL
from benchmarks.rows import say, table
from physgraph_usd.lab.samples import SAMPLES, write_sample
from physgraph_usd.studio.page import TunePage
from physgraph_usd.studio.session import TuneSession
from physgraph_usd.studio.values import TUNABLES, Tunable

MOVED = ("stretchStiffness", "bendStiffness", "density", "guide:stiffness", "rest:weftEase", "contact:offset")
CHOSEN = ("skirt", "dancer", "layers")
"""Samples where none is named."""


@click.command()
@click.option("--moves", default=20, show_default=True)
@click.option("--shot", "names", multiple=True, default=CHOSEN, help="Samples; real shots by first letters.")
@click.option("--folder", type=click.Path(path_type=Path), help="The real shots, which we may not ship.")
@click.option("--device", default="cpu", show_default=True, help="Where to solve: cpu, cuda or auto.")
@click.option("--page", is_flag=True, help="In a browser.")
@click.option("--processor", is_flag=True, help="Processor seconds instead, without the page.")
@click.option("--pictures", type=click.Path(path_type=Path), help="Write the pictures and the film into its folders.")
def main(
    moves: int,
    names: Sequence[str],
    folder: Path | None,
    *,
    device: str,
    page: bool,
    processor: bool,
    pictures: Path | None,
) -> None:
    """Print what each shot takes, or write the pictures."""
    if pictures is not None:
        return draw(pictures)
    head = ["vertices", "first cloth, median [s]", "longest", "settled, median [s]", "longest"]
    say(table(["shot", *head], []))
    with tempfile.TemporaryDirectory() as made:
        for name, session in sessions(names, folder, Path(made), device=device):
            session.set_time(session.times[len(session.times) // 2])
            count = sum(len(each.points) for each in session.settle().garments if each.points is not None)
            chance = random.Random(1)
            tried = [(TUNABLES[MOVED[k % len(MOVED)]], chance.random()) for k in range(moves)]
            clock = time.process_time if processor else time.perf_counter
            found = in_page(session, tried, count) if page else in_session(session, tried, clock)
            first, settled = zip(*found, strict=True)
            cells = [f"{value:.2f}" for each in (first, settled) for value in (median(each), max(each))]
            say(f"| {name} | {count:,} | {' | '.join(cells)} |")
            session.close()


def sessions(
    names: Sequence[str], folder: Path | None, made: Path, *, device: str = "cpu"
) -> Iterator[tuple[str, TuneSession]]:
    """Shots, opened."""
    for name in (each for each in SAMPLES if each in names):
        yield name, TuneSession(write_sample(name, made), out=made / f"{name}.tuned.usda", device=device)
    for name, (garments, bodies, _) in REAL.items():
        if folder is not None and (folder / name).exists() and name.startswith(tuple(names)):
            out = made / f"{Path(name).stem}.tuned.usda"
            yield name, TuneSession(folder / name, garments=garments, colliders=bodies, out=out, device=device)


def in_session(
    session: TuneSession, tried: Sequence[tuple[Tunable, float]], clock: Callable[[], float]
) -> list[tuple[float, float]]:
    """Seconds by a clock of each move to the first new cloth, and to the settled cloth."""
    found = []
    for tunable, place in tried:
        began, seen = clock(), list[float]()
        session.set_value(session.garments[0], tunable.name, tunable.at(place))
        session.solve(lambda _, began=began, seen=seen: seen.append(clock() - began))
        session.settle()
        found.append((seen[0], clock() - began))
    return found


def in_page(session: TuneSession, tried: Sequence[tuple[Tunable, float]], count: int) -> list[tuple[float, float]]:
    """As `in_session`, in a browser, from the press; ``count`` is the cloth's number of vertices."""
    page = TunePage(session)
    try:
        least = count // max(len(session.garments), 1) // 2
        with page_driver.opened(page.url, vertices=least) as shown:
            return [page_driver.waits(shown, tunable, place) for tunable, place in tried]
    finally:
        page.close()


def draw(folder: Path) -> None:
    """Write the pictures and the film of the page, with the skirt; the page names files without a folder."""
    folder = folder.resolve()
    with tempfile.TemporaryDirectory() as made, chdir(made):
        ((_, session),) = sessions(["skirt"], None, Path())
        session.set_time(session.times[len(session.times) // 2])
        page = TunePage(session)
        try:
            with page_driver.opened(page.url, vertices=1) as shown:
                tour = page_driver.Tour(shown)
                tour.go(folder / "pictures")
                tour.write(folder / "films" / "tune.mp4")
        finally:
            page.close()
            session.close()


if __name__ == "__main__":
    main()
