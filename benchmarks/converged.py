"""How far frames are from rest, as seen: each frame beside its own rest, and whole runs beside converged ones.

    python -m benchmarks.converged [OTHER...] [--folder SHOTS] [--keep FOLDER] [--ripples] [--out TABLE.md]

The unit is the angle between the vertex normals of two shapes of the same cloth (`physgraph_usd/solver/seen.py`). Each
OTHER is a checkout of another version. There are two measures.

Own rest: each frame of the last half of a default run is solved on until nothing moves, with contact found anew, and
the run goes on as if it had not been. This says what more steps in that frame would have changed, whatever folds the
frames before chose.

Converged run: a whole run of the same frames with `CONVERGED`, by this version. The table gives the angle, the amount
of folds relative to that run's, and the RMS difference in acceleration, as second differences in time. Folds differ
where first frames differ, so two converged runs, by two integrators, differ too: their row is the floor.

Positions of converged runs are kept in files in the folder `--keep`, by content of the shot, garments, frames, level
and ripple, and by `PHYSICS`, but not by version. So each is made once, and later tables take minutes.

By default: four samples, a sheet over a block, and with `--folder` the real shots 10 and 21, which is looked for in
the folder `real` beside. `--shot` takes other samples too.
"""

from __future__ import annotations

import hashlib
import json
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.judge_shot import RIPPLES, Job
from benchmarks.rows import say, table
from benchmarks.verdicts import Band
from benchmarks.versions import HERE, Row, Task, chosen, job_of, names_of, run_all
from physgraph_usd.solver.seen import folding, normal_angles

CONVERGED = {"steps": 200, "tolerance": 1.2e-4, "frame_limit": 3600.0}
"""Options of converged runs: 17 times the default's steps. Contact may take three times as many."""
INTEGRATORS = ("physgraph", "quasi-newton")
"""Integrators of the two converged runs; versions are compared with the first."""
CONVERGED_NAMES = tuple(f"converged, {name}" for name in INTEGRATORS)
PHYSICS = 1
"""Number of the physics. Raise it when forces, contact or the guide change the shape of cloth at rest: converged runs
are then made anew."""
REST_STEPS = 1000
"""Most steps of a frame to its own rest; most end before by the tolerance. See `judge_shot.REST_STEPS`."""
COAT = "../real/21_open_coat_skinned.usdc"
FRAMES = 5
"""Frames of samples that are not among the default shots."""


NOT_IN_KEY = {"shot", "device", "positions", "rest", "rest_steps"}
"""Fields of a job that do not change which converged run it is; the shot counts by content."""
COLUMNS = {
    "warm [s]": (("warm",), 2),
    "own rest: angle [deg]": (("rest_angle",), 1),
    "90% [deg]": (("rest_angle90",), 1),
    "distance [mm]": (("rest_distance",), 2),
    "folding": (("rest_folding",), 3),
    "energy [mJ]": (("rest_before", "rest_after"), 1),
    "converged run: angle [deg]": (("angle",), 1),
    "90% [deg] ": (("angle90",), 1),
    "folding ": (("folding",), 3),
    "second difference [mm]": (("second",), 2),
}
"""Columns of the table: names of figures, and digits."""
SCALE = {"warm": 1e-3, "rest_before": 1e3, "rest_after": 1e3}
"""Factors from the figures' units to the table's."""


SHOTS = (
    Row("dancer", "dancer", count=10),
    Row("skirt", "skirt", count=10),
    Row("sleeve", "sleeve", count=10),
    Row("layers", "layers", count=5),
    Row("block", "block", first=8, count=6),
    Row("10", "10_style3d_skirt_twist.usdc", first=19, count=10),
    Row("coat", COAT, first=9, count=7, prims=(("/shot/hero/geo/coat",), ("/shot/hero/geo/body",))),
)
"""Shots that are judged by default. The sheet over a block stands for a poncho, which hangs over a body as it does."""


@dataclass(frozen=True)
class Run:
    """One run that was made or kept.

    Attributes:
        row: Name of the shot's row.
        version: Name of the version, or of the converged run.
        ripple: The ripple [% of the mean edge].
        positions: File of the positions.
        figures: Figures by name; empty for a run that failed.
        error: Why it failed, or "".
        over: Time limit that it exceeded [s], or 0.
    """

    row: str
    version: str
    ripple: float
    positions: Path
    figures: Mapping[str, float | None] = field(default_factory=dict)
    error: str = ""
    over: float = 0.0

    @property
    def failed(self) -> str:
        """Why the run has no figures, or ""."""
        return f"over {self.over:g} s" if self.over else self.error


@dataclass(frozen=True)
class Asked:
    """What to measure.

    Attributes:
        frames: Frames of each shot; None for the row's own number.
        level: Subdivisions.
        device: "cpu" or "cuda".
        rest: Whether to measure the angle to the frames' own rest.
        rest_steps: Most steps of a frame to its own rest.
        whole: Whether to compare whole runs with converged ones.
        ripples: Whether to refine each shot with three ripples, and not as it is.
    """

    frames: int | None = None
    level: int = 2
    device: str = "cpu"
    rest: bool = True
    rest_steps: int = REST_STEPS
    whole: bool = True
    ripples: bool = False


@click.command()
@click.argument("others", nargs=-1, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--folder", type=click.Path(path_type=Path), help="The real shots, which we may not ship.")
@click.option("--shot", "names", multiple=True, help="Only these: names of rows, or of other samples.")
@click.option("--frames", type=click.IntRange(min=2), help="Frames of each.  [default: the row's]")
@click.option("--level", default=2, show_default=True, help="Subdivisions.")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda.")
@click.option("--rest/--no-rest", default=True, help="Whether to measure the angle to the frames' own rest.")
@click.option("--rest-steps", default=REST_STEPS, show_default=True, help="Most steps of a frame to its own rest.")
@click.option("--whole/--no-whole", default=True, help="Whether to compare whole runs with converged ones.")
@click.option("--ripples", is_flag=True, help="Each shot with three ripples, as in benchmarks.versions.")
@click.option("--keep", type=click.Path(path_type=Path), help="Folder of converged runs.  [default: none are kept]")
@click.option("--jobs", default=1, show_default=True, help="Runs at a time.")
@click.option("--limit", default=3600.0, show_default=True, help="Longest run [s].")
@click.option("--out", type=click.Path(path_type=Path), help="Write the table here too.")
def main(
    others: Sequence[Path],
    names: Sequence[str],
    *,
    folder: Path | None,
    keep: Path | None,
    jobs: int,
    limit: float,
    out: Path | None,
    **asked: Any,
) -> None:
    """Print how far this version's frames are from rest, beside other versions'."""
    trees = [*(other.resolve() for other in others), HERE]
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        kept = place / "kept" if keep is None else keep.resolve()
        kept.mkdir(parents=True, exist_ok=True)
        tasks = tasks_of(trees, chosen(names, folder, SHOTS, count=FRAMES), Asked(**asked), place=place, folder=folder)
        runs = run_tasks(tasks, kept, place=place, jobs=jobs, limit=limit)
    text = result_table(runs)
    say(text)
    if out is not None:
        out.write_text(text + "\n", "utf-8")


def tasks_of(
    trees: Sequence[Path], rows: Sequence[Row], asked: Asked, *, place: Path, folder: Path | None
) -> list[Task]:
    """All runs, shot by shot: the converged ones, then each version's.

    Args:
        trees: Checkouts of the versions, this one last.
        rows: The shots.
        asked: What to measure.
        place: Folder for samples.
        folder: Folder of the real shots.
    """
    tasks = []
    for row in rows:
        job = replace(job_of(row, place, folder, 0), count=asked.frames or row.count)
        job = replace(job, level=asked.level, device=asked.device)
        rest = {"rest": job.count - job.count // 2 if asked.rest else 0, "rest_steps": asked.rest_steps}
        for seed, ripple in enumerate(RIPPLES, 1) if asked.ripples else [(0, 0.0)]:
            own = replace(job, ripple=ripple, seed=seed)
            for name, integrator in zip(CONVERGED_NAMES, INTEGRATORS, strict=True) if asked.whole else ():
                solve = CONVERGED | {"integrator": integrator}
                tasks.append(Task(row.name, name, HERE, "", replace(own, solve=solve)))
            pairs = zip(names_of(trees), trees, strict=True)
            tasks += [Task(row.name, name, tree, "", replace(own, **rest)) for name, tree in pairs]
    return tasks


def key_of(job: Job) -> str:
    """Name of a converged run's files: equal for equal content of the shot and equal options, whatever the version."""
    asked = {name: value for name, value in asdict(job).items() if name not in NOT_IN_KEY}
    digest = hashlib.sha256(Path(job.shot).read_bytes())
    digest.update(json.dumps([PHYSICS, asked], sort_keys=True).encode())
    return f"{Path(job.shot).stem}-{digest.hexdigest()[:16]}"


def run_tasks(tasks: Sequence[Task], kept: Path, *, place: Path, jobs: int, limit: float) -> list[Run]:
    """Run what is not kept. A run's figures are written after its positions, so a run cut short is made again.

    Args:
        tasks: The runs.
        kept: Folder of converged runs.
        place: Folder for other files.
        jobs: Runs at a time.
        limit: Longest run [s].
    """
    files = [(kept / key_of(t.job) if t.version in CONVERGED_NAMES else place / f"run{k}") for k, t in enumerate(tasks)]
    positions = [file.with_name(f"{file.name}.npz") for file in files]
    named = [
        replace(task, job=replace(task.job, positions=str(each))) for task, each in zip(tasks, positions, strict=True)
    ]
    ended = {each: each.with_suffix(".json") for each in positions}
    found = {str(each): json.loads(file.read_text("utf-8")) for each, file in ended.items() if file.exists()}
    left = [task for task in named if task.job.positions not in found]
    for run in run_all(left, [None] * jobs, limit=limit, place=place):
        file = run["job"]["positions"]
        found[file] = {name: run[name] for name in ("figures", "error", "over") if name in run}
        click.echo(f"{len(found)} of {len(tasks)}: {run['row']}, {run['version']}", err=True)
        if "figures" in run:
            Path(file).with_suffix(".json").write_text(json.dumps(found[file]), "utf-8")
    runs = [
        Run(task.row, task.version, task.job.ripple, Path(task.job.positions), **found[task.job.positions])
        for task in named
    ]
    return [replace(run, figures={**run.figures, **beside(run, reference_of(run, runs))}) for run in runs]


def reference_of(run: Run, runs: Sequence[Run]) -> Run | None:
    """The converged run of the same shot and ripple; None for that run itself, or without one that ended."""
    place = run.row, run.ripple, CONVERGED_NAMES[0]
    found = next((each for each in runs if (each.row, each.ripple, each.version) == place and each.figures), None)
    return None if found is run else found


def beside(run: Run, reference: Run | None) -> dict[str, float]:
    """What is seen of a run beside a converged one: means over the last half of the frames; empty without both.

    Angles are percentiles over all vertices of those frames [degrees], folding is relative to the converged run's, and
    the second difference is the RMS difference of second differences in time [mm].
    """
    if reference is None or not run.figures:
        return {}
    with np.load(run.positions) as own, np.load(reference.positions) as other:
        x, y, triangles = own["points"].astype(np.float64), other["points"].astype(np.float64), own["triangles"]
    half = range(len(x) // 2, len(x))
    angles = np.concatenate([normal_angles(x[k], y[k], triangles) for k in half])
    middle, high = np.percentile(angles, (50.0, 90.0))
    found = {"angle": float(middle), "angle90": float(high)}
    found["folding"] = statistics.fmean(folding(x[k], triangles) / max(folding(y[k], triangles), 1e-30) for k in half)
    second = np.diff(x - y, 2, axis=0)[max(half.start - 1, 0) :]
    if len(second):
        found["second"] = 1e3 * float(np.sqrt((second**2).sum(axis=2).mean(axis=1)).mean())
    return found


def result_table(runs: Sequence[Run]) -> str:
    """The table in Markdown, one row per shot and version, after a line for each run that did not end."""
    lines = [f"{each.row}, {each.version}, ripple {each.ripple:g}%: {each.failed}" for each in runs if each.failed]
    rows = []
    for row, version in dict.fromkeys((each.row, each.version) for each in runs):
        own = [each.figures for each in runs if (each.row, each.version) == (row, version)]
        cells = []
        for names, digits in COLUMNS.values():
            known = [(Band.of([each.get(name) for each in own]), SCALE.get(name, 1.0)) for name in names]
            cells.append(" -> ".join("-" if band is None else _text(band, scale, digits) for band, scale in known))
        rows.append([row, version, *cells])
    return "\n\n".join([*lines, table(["shot", "version", *COLUMNS], rows)])


def _text(band: Band, scale: float, digits: int) -> str:
    """A mean in the table's unit, with half the range over the ripples where there are several."""
    spread = f" ± {scale * band.spread:.{digits}f}" if band.spread else ""
    return f"{scale * band.mean:.{digits}f}{spread}"


if __name__ == "__main__":
    main()
