"""Two or more checkouts side by side, in turns: time of a warm frame, energy and crossings, shot by shot.

    python -m benchmarks.versions OTHER... [--shot NAME]... [--folder SHOTS] [--frames 8] [--turns 1] [--level 2]
        [--device cuda]
    python -m benchmarks.versions --cores      this version on several cores, and by several processes

Each OTHER is a checkout of another version. Every shot is refined by each of them and by this one in turn, on one core
or a card, in a process of its own, by the command that a user gives. Prints a row a shot: of each version the
milliseconds of the first and of a warm frame on the wall as its report has them (prepared, solved and measured; warm,
the median over frames, the least over turns), the mean energy of warm frames without the tether's, and crossings of all
frames with bodies and with cloth; then the time and the energy of this version over each other's.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from benchmarks.contact_shots import REAL
from benchmarks.contact_shots import SAMPLES as TOUCHING
from benchmarks.cores import compare, groups_of
from benchmarks.rows import say, table
from physgraph_usd.lab.samples import SAMPLES, write_sample
from physgraph_usd.usd.read.reader import open_shot

CHOSEN = ("sleeve", "skirt", "layers")
"""Samples where no shot is named; with a folder, its shots too."""
HERE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Cost:
    """A shot by one version: milliseconds of the first and of a warm frame, its energy [J], crossings of all frames."""

    first: float
    warm: float
    energy: float
    crossings: int

    def __str__(self) -> str:
        """A cell of the table."""
        return f"{self.first:,.0f}, {self.warm:,.0f} ms, {1e3 * self.energy:.4g} mJ, {self.crossings:,}"

    def over(self, other: Cost) -> str:
        """Ratios of time and energy."""
        return f"{self.warm / other.warm:.3f}, {self.energy / other.energy:.4f}"


@click.command()
@click.argument("others", nargs=-1, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--folder", type=click.Path(path_type=Path), help="The real shots, which we may not ship.")
@click.option("--shot", "names", multiple=True, help="Only these: samples, or beginnings of real shots' names.")
@click.option("--frames", default=8, show_default=True, help="Frames of each; 0 for whole shots.")
@click.option("--turns", default=1, show_default=True, help="How often each version refines each shot.")
@click.option("--level", default=2, show_default=True)
@click.option("--device", default="cpu", show_default=True, help="Where to solve: cpu, cuda or auto.")
@click.option("--cores", is_flag=True, help="This version alone, samples on several cores, instead.")
@click.option("--core", default=0, show_default=True, help="The core that all run on.")
def main(
    others: Sequence[Path], folder: Path | None, names: Sequence[str], *, device: str, cores: bool, **numbers: int
) -> None:
    """Print what each version takes for each shot."""
    if cores:
        compare(names or ("dancer", "skirt"), turns=numbers["turns"], level=numbers["level"])
        return
    if not others:
        raise click.UsageError("name a checkout of another version, or give --cores")
    trees = [*(other.resolve() for other in others), HERE]
    head = [*(f"{tree.name}: first and warm frame, energy, crossings" for tree in trees), "time, energy over"]
    say(table(["shot", *head], []))
    with tempfile.TemporaryDirectory() as made:
        for name, given in shots(names, folder, Path(made), numbers["frames"]):
            asked = [*given, "--level", str(numbers["level"]), "--device", device]
            turns = range(numbers["turns"])
            runs = [[taken(tree, asked, Path(made), numbers["core"]) for tree in trees] for _ in turns]
            best = [min(each, key=lambda cost: cost.warm) for each in zip(*runs, strict=True)]
            say(f"| {name} | {' | '.join(map(str, best))} | {'; '.join(best[-1].over(each) for each in best[:-1])} |")


def shots(names: Sequence[str], folder: Path | None, made: Path, frames: int) -> Iterator[tuple[str, list[str]]]:
    """Names of shots, and the arguments of `refine` for each."""
    samples = [name for name in SAMPLES if name in (names or CHOSEN)]
    cases = {name: (write_sample(name, made), [], [], TOUCHING.get(name, 0)) for name in samples}
    for name, case in REAL.items() if folder is not None else ():
        if folder is not None and (folder / name).exists() and (not names or name.startswith(tuple(names))):
            cases[name] = (folder / name, *case)
    for name, (file, garments, bodies, first) in cases.items():
        given = [str(file), *(option for each in garments for option in ("--garment", each))]
        given += [option for each in bodies for option in ("--collider", each)]
        if frames:
            times = open_shot(str(file), garments=garments, colliders=bodies).scene.times
            chosen = times[max(min(first, len(times) - frames), 0) :][:frames]
            given += ["--frames", f"{chosen[0]}:{chosen[-1]}"]
        yield name, given


def taken(tree: Path, arguments: Sequence[str], made: Path, core: int) -> Cost:
    """Refine a shot by a version."""
    out = made / f"{tree.name}.usdc"
    command = ["taskset", "-c", str(core), sys.executable, "-m", "physgraph_usd", "refine", *arguments]
    command += ["-o", str(out), "--report", f"{out}.json", "--overwrite"]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):
        raise click.ClickException(f"{tree.name}: {done.stderr[-500:]}")
    report = json.loads(Path(f"{out}.json").read_text("utf-8"))
    frames = [groups for frame in report["frames"] if (groups := groups_of(frame))]
    warm = frames[1:] or frames
    first, *later = [sum(sum(each["milliseconds"].values()) for each in groups) for groups in frames]
    energies = [sum(sum(each["energy_joules"]["output"].values()) for each in groups) for groups in warm]
    crossings = sum(left for groups in frames for each in groups for left in crossings_of(each.get("contact") or {}))
    return Cost(first, statistics.median(later or [first]), statistics.mean(energies), crossings)


def crossings_of(contact: dict[str, Any]) -> Iterator[int]:
    """Crossings that are left with each body and with cloth."""
    cloth = contact.get("cloth")
    for each in [*(contact.get("bodies") or {}).values(), *([cloth] if cloth else [])]:
        yield each["after"]["crossings"]


if __name__ == "__main__":
    main()
