"""Whether cold frames settle, and whether the cage's triangles show in them.

    python -m benchmarks.cold_frames [--count 12] [--level 2] [--steps 12] [--integrator physgraph] [--shot NAME]
        [--linear] [--whole] [FOLDER]

Solves frames spread over each sample and, where FOLDER holds real shots, over those, each by itself. Prints a row a
shot: frames that did not settle (`shot/settled.py`), those that ended with no step that lowers the energy, the
largest remaining move in tolerances, edges of cloth through cloth in the input and after, evaluations, the part of them
that line searches spent in vain, the RMS angle between triangles at the cage's edges over that elsewhere (median and
largest; of the smooth upsampled cage in brackets), and the median time. With --whole each frame has a row, and its
energy. With --linear levels start from linear positions on the level below, facets and all.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import click
import numpy as np
import torch

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.settled import unsettled
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.frame import level_forces
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.level import hinge_geometry
from physgraph_usd.usd.read.reader import Shot, open_shot

from .contact_shots import REAL, SAMPLES, THREADS, groups_of

MORE_SAMPLES = ("sleeve", "flag", "swatch")
FREE = {"07_flag_quads_nocollider.usda": (["/shot/flag"], [])}
"""Real shots without bodies."""
UNSEEN = np.radians(1.0)
"""RMS angle elsewhere that counts at least: of cloth that is flat no facet shows."""


@dataclass
class Row:
    """Figures of some cold frames.

    Attributes:
        open: Frames that did not settle.
        stalled: Frames that ended with no step that lowers the energy.
        remaining: Remaining move of each at its finest level, in tolerances.
        crossings: Edges of cloth through cloth, in the input and after.
        evaluations: All of them.
        failed: Those of line searches that found no step.
        folds: Fold angle at the cage's edges over that elsewhere, of each.
        plain: The same of the smooth upsampled cage.
        energy: Of each frame [mJ].
        seconds: Of each frame.
    """

    open: int = 0
    stalled: int = 0
    remaining: list[float] = field(default_factory=list)
    crossings: tuple[int, int] = (0, 0)
    evaluations: int = 0
    failed: int = 0
    folds: list[float] = field(default_factory=list)
    plain: list[float] = field(default_factory=list)
    energy: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def told(self, name: str) -> str:
        """As a row of the table."""
        failed = 100.0 * self.failed / max(self.evaluations, 1)
        folds = f"{np.median(self.folds):.2f} | {max(self.folds):.2f} ({max(self.plain):.2f})"
        last = f"{np.median(self.seconds):.2f}"
        counts = f"{len(self.folds)} | {self.open} | {self.stalled} | {max(self.remaining):.1f}"
        counts += f" | {self.crossings[0]} -> {self.crossings[1]}"
        return f"| {name} | {counts} | {self.evaluations} | {failed:.1f} | {folds} | {last} |"


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--count", default=12, show_default=True, help="Frames of each shot.")
@click.option("--level", default=2, show_default=True)
@click.option("--steps", default=12, show_default=True)
@click.option("--integrator", default="physgraph", show_default=True)
@click.option("--shot", "shots", multiple=True, help="Only these.")
@click.option("--whole", is_flag=True, help="A row a frame.")
@click.option("--linear", is_flag=True, help="Levels start with the facets of the level below.")
def main(
    folder: Path | None,
    count: int,
    level: int,
    steps: int,
    integrator: str,
    shots: Sequence[str],
    whole: bool,
    linear: bool,
) -> None:
    """Print the table."""
    prepare_device("cpu")
    settings = replace(RefineOptions(integrator=integrator, steps=steps).solve_settings(), temporal="off")
    click.echo(
        "| shot | frames | unsettled | stalled | remaining | crossings | evaluations | failed % | folds | most | s |"
    )
    click.echo("|" + "---|" * 11)
    with ExitStack() as during:
        place = during.enter_context(tempfile.TemporaryDirectory())
        if linear:
            during.enter_context(mock.patch.object(level_forces, "facets", lambda level, x, *_: torch.zeros_like(x)))
        for name in [*SAMPLES, *MORE_SAMPLES, *([*REAL, *FREE] if folder else ())]:
            if shots and not any(each in name for each in shots):
                continue
            shot, short = _opened(name, Path(place), folder), Path(name).parts[0].split(".")[0]
            times = shot.scene.times
            picks = np.unique(np.linspace(0, len(times) - 1, min(count, len(times))).round().astype(int))
            refiner = Refiner(shot.scene, settings, levels=[level] * len(shot.scene.garments), threads=THREADS)
            row = Row()
            for pick in picks:
                own = Row() if whole else row
                _add(own, refiner, shot, times[pick], settings)
                if whole:
                    click.echo(f"{own.told(f'{short} {times[pick]:g}')} {own.energy[0]:.4g} mJ |")
            if not whole:
                click.echo(row.told(short))


def _opened(name: str, place: Path, folder: Path | None) -> Shot:
    if name in (*SAMPLES, *MORE_SAMPLES):
        return open_shot(str(write_sample(name, place)))
    garments, colliders, *_ = (REAL | FREE)[name]
    return open_shot(str(Path(folder or "") / name), garments=garments, colliders=colliders)


def _add(row: Row, refiner: Refiner, shot: Shot, at: float, settings: SolveSettings) -> None:
    """Solve one frame and take its figures."""
    frame = shot.frame(at)
    refiner.forget()
    began = time.perf_counter()
    state = refiner.solve(frame)
    row.seconds.append(time.perf_counter() - began)
    entries = groups_of(state.telemetry)
    verdicts = [unsettled(entry, settings.tolerance) for entry in entries]
    levels = [level for entry in entries for level in entry["levels"]]
    row.open += any(verdicts)
    row.stalled += any(each.stopped == "stalled" for each in verdicts if each)
    row.remaining.append(max(entry["levels"][-1]["remaining_move"] for entry in entries) / settings.tolerance)
    row.evaluations += sum(level["evaluations"] for level in levels)
    row.failed += sum(level["failed"] for level in levels)
    told = [entry.get("contact", {}).get("cloth", {}) for entry in entries]
    before, after = (sum(each[name]["crossings"] for each in told if each) for name in ("before", "after"))
    row.crossings = (row.crossings[0] + before, row.crossings[1] + after)
    row.energy.append(1e3 * sum(sum(entry["energy_joules"]["output"].values()) for entry in entries))
    parts = refiner.parts_of(frame)
    solved = {part: np.concatenate([_there(state.points[index]) for index in part]) for part in parts}
    smooth = {
        part: refiner.group_of(part).levels[-1].smooth_from_coarse
        @ np.concatenate([frame.garments[index].points for index in part])
        for part in parts
    }
    for points, found in ((solved, row.folds), (smooth, row.plain)):
        found.append(max(folds_on_cage(refiner.group_of(part), x) for part, x in points.items()))


def _there(points: np.ndarray | None) -> np.ndarray:
    assert points is not None
    return points


def folds_on_cage(group: Group, x: np.ndarray) -> float:
    """RMS angle between triangles at fine edges that lie on edges of the cage, over that at all others.

    Args:
        group: The garments.
        x: Their finest vertices [m], shape (V, 3).
    """
    level = group.levels[-1]
    hinges = level.hinges.cpu().numpy()
    support = abs(level.from_coarse).sign()
    ends = support[hinges[:, 0]] + support[hinges[:, 1]]
    on_cage = ends.getnnz(axis=1) <= 2
    bent = hinge_geometry(x, hinges)[0] - level.rest_angle.double().cpu().numpy()
    there, elsewhere = (float(np.sqrt((bent[each] ** 2).mean())) for each in (on_cage, ~on_cage))
    return there / max(elsewhere, UNSEEN)


if __name__ == "__main__":
    main()
