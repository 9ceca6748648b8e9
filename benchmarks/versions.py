"""A judge that knows its noise: this checkout beside others, over whole shots, with three ripples each.

    python -m benchmarks.versions OTHER... [--folder SHOTS] [--jobs 16] [--json FIGURES.json] [--out TABLE.md]
    python -m benchmarks.versions --from-json FIGURES.json      print again what was measured
    python -m benchmarks.versions --device cpu --device cuda    this version on a core beside a card

Each OTHER is a checkout of another version. Every shot is refined by each version with three ripples: invisible
displacements of the cage by 0.15, 0.20 and 0.25% of its mean edge (`benchmarks.judge_shot`). Figures of one version
that differ between ripples are noise, and a difference between versions counts only beyond the noise
(`benchmarks.verdicts`). Times are processor times on the CPU, and the report's times on a card. The last two frames of
each run are solved on until nothing moves: the angle between normals says how far from their rest frames end.

Each run is a process of its own on a core of its own, with one thread. Long shots go first, and runs of one shot by
all versions start side by side, so that they share the machine's load. With `--json`, finished runs are kept, and the
same command goes on after an interruption; runs of changed code are made again.

By default samples are whole shots at level 2, and with `--folder` so are the real shots, except: 02 and 04 are refined
at level 1, because 02 takes 14 to 28 s a frame at level 2 and 04 about as long. Two versions take under ten minutes on
sixteen cores. Runs that take more than `--limit` are stopped, and their row says so.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click

from benchmarks import judge_shot
from benchmarks.contact_shots import REAL
from benchmarks.contact_shots import SAMPLES as TOUCHING
from benchmarks.judge_shot import RIPPLES, Job
from benchmarks.rows import code_of, say
from benchmarks.verdicts import Band, bands, overall, shot_table
from physgraph_usd.lab import samples
from physgraph_usd.lab.samples import SAMPLES, write_sample

HERE = Path(__file__).resolve().parents[1]
REST_FRAMES = 2
"""Last frames of each run that are solved on to their own rest. A frame takes as long as some 30 default frames."""


@dataclass(frozen=True)
class Row:
    """A shot to judge.

    Attributes:
        name: Name in the tables.
        source: Name of the sample, or path of the real shot below the folder.
        first: Number of the first frame.
        busy: Number of the first frame when only some frames are refined, where cloth touches.
        count: Number of frames, where a judge has a number of its own; 0 for all.
        level: Subdivisions.
        seconds: Rough time of one run [s], to start long runs first.
        prims: Prim paths of garments and of bodies of a real shot that `benchmarks.contact_shots` has not.
    """

    name: str
    source: str
    first: int = 0
    busy: int = 0
    count: int = 0
    level: int = 2
    seconds: float = 60.0
    prims: tuple[Sequence[str], Sequence[str]] = ((), ())

    @property
    def is_real(self) -> bool:
        """Whether it is a real shot, and no sample."""
        return self.source in REAL or bool(self.prims[0])


SHOTS = (
    Row("sleeve", "sleeve", seconds=10),
    Row("skirt", "skirt", seconds=20),
    Row("skirt@36", "skirt", first=35, busy=35, seconds=10),
    Row("tshirt", "tshirt", seconds=200),
    Row("layers", "layers", seconds=120),
    Row("dancer", "dancer", seconds=30),
    Row("overcoat", "overcoat", seconds=120),
    Row("01", "01_newton_shirt_dab_cm.usdc", seconds=70),
    Row("02", "02_makehuman_usdskel_dm.usdc", level=1, seconds=150),
    Row("04", "04_tiered_dress_kick_zup.usdc", level=1, seconds=40),
    Row("06", "06_torus_pull.usda", seconds=30),
    Row("08", "08_sphere_spin_xformcollider.usdc", seconds=15),
    Row("09", "09_cesiumman_kilt/shot.usda", seconds=70),
    Row("10", "10_style3d_skirt_twist.usdc", seconds=12),
)
"""Shots that are judged by default; "skirt@36" is the skirt from time code 36 on, begun cold."""


@dataclass(frozen=True)
class Task:
    """A job by one version.

    Attributes:
        row: Name of the row.
        version: Name of the version.
        tree: Checkout of the version.
        code: Hash of the code of the version, the samples and the judge.
        job: The job.
    """

    row: str
    version: str
    tree: Path
    code: str
    job: Job

    @property
    def asked(self) -> dict[str, Any]:
        """The run's identity in a file of figures: runs of equal identity have equal figures."""
        job = asdict(self.job) | {"shot": Path(self.job.shot).name}
        return {"row": self.row, "version": self.version, "code": self.code, "job": json.loads(json.dumps(job))}


@click.command()
@click.argument("others", nargs=-1, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--folder", type=click.Path(path_type=Path), help="The real shots, which we may not ship.")
@click.option("--shot", "names", multiple=True, help="Only these: names of rows, or of other samples.")
@click.option(
    "--frames", default=0, show_default=True, help="Most frames of each, from where cloth touches; 0 for all."
)
@click.option("--level", type=int, help="Subdivisions of all.  [default: 2, of 02 and 04 1]")
@click.option("--device", "devices", multiple=True, default=("cpu",), help="cpu, cuda or both.  [default: cpu]")
@click.option("--jobs", type=int, help="Runs at a time.  [default: number of cores, one on a card]")
@click.option("--limit", default=600.0, show_default=True, help="Longest run [s].")
@click.option("--json", "file", type=click.Path(path_type=Path), help="Keep raw figures here, and go on from them.")
@click.option("--from-json", "made", type=click.Path(exists=True, path_type=Path), help="Print such a file only.")
@click.option("--out", type=click.Path(path_type=Path), help="Write the tables here too.")
def main(
    others: Sequence[Path],
    names: Sequence[str],
    *,
    made: Path | None,
    out: Path | None,
    level: int | None,
    **options: Any,
) -> None:
    """Judge this version beside others."""
    if made is not None:
        runs = json.loads(made.read_text("utf-8"))["runs"]
    elif others or len(options["devices"]) > 1:
        runs = measured([*(other.resolve() for other in others), HERE], names, level=level, **options)
    else:
        raise click.UsageError("name a checkout of another version, two devices or --from-json")
    text = tables(runs)
    say(text)
    if out is not None:
        out.write_text(text + "\n", "utf-8")


def measured(
    trees: Sequence[Path],
    names: Sequence[str],
    *,
    folder: Path | None,
    frames: int,
    level: int | None,
    devices: Sequence[str],
    jobs: int | None,
    limit: float,
    file: Path | None,
) -> list[dict[str, Any]]:
    """Runs of all shots by all versions with all ripples, each as plain values."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    count = jobs or (len(cores) if list(devices) == ["cpu"] else 1)
    with tempfile.TemporaryDirectory() as place:
        rows = [replace(row, level=row.level if level is None else level) for row in chosen(names, folder)]
        found = [replace(job_of(row, Path(place), folder, frames), rest=REST_FRAMES) for row in rows]
        tasks = [
            task for device in devices for task in tasks_of(trees, rows, [replace(j, device=device) for j in found])
        ]
        if len(devices) > 1:
            tasks = [replace(task, version=f"{task.version}, {task.job.device}") for task in tasks]
        known = kept_runs(file)
        runs = [run for task in tasks if (run := known.get(json.dumps(task.asked))) is not None]
        left = [task for task in tasks if json.dumps(task.asked) not in known]
        for device in {task.job.device for task in left}:
            warm_up(trees, device)
        for run in run_all(left, [cores[k % len(cores)] for k in range(count)], limit=limit, place=Path(place)):
            runs.append(run)
            _note(f"{len(runs)} of {len(tasks)}: {run['row']}, {run['version']}, {run['job']['ripple']}%")
            if file is not None:
                file.write_text(json.dumps({"runs": runs}, indent=1), "utf-8")
    order = {json.dumps(task.asked): k for k, task in enumerate(tasks)}
    return sorted(runs, key=lambda run: order[identity(run)])


def _note(line: str) -> None:
    """Tell the progress, on the error stream: tables alone go to the output."""
    click.echo(line, err=True)


def chosen(names: Sequence[str], folder: Path | None, shots: Sequence[Row] = SHOTS, *, count: int = 0) -> list[Row]:
    """The shots to judge. Missing samples and shots are named and left out.

    Args:
        names: Names of the shots, or of other samples; empty for all shots that are there.
        folder: Folder of the real shots.
        shots: The judge's shots.
        count: Number of frames of other samples, from where cloth touches; 0 for all.
    """
    other = [Row(name, name, first=TOUCHING.get(name, 0) if count else 0, count=count) for name in SAMPLES]
    by_name = {row.name: row for row in (*other, *shots)}
    asked = names or [row.name for row in shots if folder is not None or not row.is_real]
    rows = []
    for name in asked:
        row = by_name.get(name)
        if row is None or not _is_there(row, folder):
            _note(f"{name} is left out: there is no such sample or real shot")
        else:
            rows.append(replace(row, busy=max(row.busy, _first_contact(row))))
    return rows


def _is_there(row: Row, folder: Path | None) -> bool:
    return row.source in SAMPLES or (row.is_real and folder is not None and (folder / row.source).exists())


def _first_contact(row: Row) -> int:
    """Number of the frame from which `benchmarks.contact_shots` looks at a shot."""
    return REAL[row.source][2] if row.source in REAL else TOUCHING.get(row.source, 0)


def job_of(row: Row, place: Path, folder: Path | None, frames: int) -> Job:
    """The run of a shot without ripple; samples are written into a folder, once."""
    first = row.busy if frames else row.first
    if row.is_real:
        garments, bodies = REAL[row.source][:2] if row.source in REAL else row.prims
        shot = (folder or Path()) / row.source
        return Job(str(shot.resolve()), garments, bodies, first=first, count=frames, level=row.level)
    file = place / f"{row.source}.usdc"
    if not file.exists():
        write_sample(row.source, place)
    return Job(str(file), first=first, count=frames, level=row.level)


def tasks_of(trees: Sequence[Path], rows: Sequence[Row], jobs: Sequence[Job]) -> list[Task]:
    """All runs in starting order: long shots first, all versions of a shot side by side."""
    shared = code_of(Path(samples.__file__).parent) + code_of(Path(judge_shot.__file__))
    codes = [code_of(tree / "physgraph_usd") + shared for tree in trees]
    pairs = sorted(zip(rows, jobs, strict=True), key=lambda pair: -pair[0].seconds)
    return [
        Task(row.name, name, tree, code, replace(job, ripple=ripple, seed=seed))
        for row, job in pairs
        for seed, ripple in enumerate(RIPPLES, 1)
        for name, tree, code in zip(names_of(trees), trees, codes, strict=True)
    ]


def names_of(trees: Sequence[Path]) -> list[str]:
    """Names of the folders of checkouts, numbered where a name is there already."""
    names = [tree.name for tree in trees]
    return [f"{name} ({k})" if name in names[:k] else name for k, name in enumerate(names)]


def identity(run: Mapping[str, Any]) -> str:
    """The identity of a finished run, as `Task.asked` gives it."""
    return json.dumps({name: run[name] for name in ("row", "version", "code", "job")})


def kept_runs(file: Path | None) -> dict[str, dict[str, Any]]:
    """Finished runs of a file of figures by identity; runs that failed are made again."""
    if file is None or not file.exists():
        return {}
    runs = json.loads(file.read_text("utf-8"))["runs"]
    return {identity(run): run for run in runs if "error" not in run}


def warm_up(trees: Sequence[Path], device: str) -> None:
    """Compile the kernels of each version before the measured runs."""

    def one(tree: Path) -> None:
        command = [sys.executable, "-m", "physgraph_usd", "warm-up", "--device", device]
        done = subprocess.run(command, cwd=tree, env=_environment(tree), capture_output=True, text=True, check=False)
        if done.returncode:
            raise click.ClickException(f"{tree.name}: {done.stderr[-500:]}")

    with ThreadPoolExecutor() as pool:
        list(pool.map(one, trees))


def _environment(tree: Path) -> dict[str, str]:
    """Environment of a process with one thread and the package of a checkout."""
    return os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def run_all(
    tasks: Sequence[Task], cores: Sequence[int | None], *, limit: float, place: Path
) -> Iterator[dict[str, Any]]:
    """Run tasks in order, one at a time on each core, and yield each run as it ends.

    Args:
        tasks: The tasks.
        cores: Core of each process that runs at a time; None for any.
        limit: Longest run [s].
        place: Folder for the files of the runs.
    """
    free: queue.SimpleQueue[int | None] = queue.SimpleQueue()
    for core in cores:
        free.put(core)

    def one(number: int, task: Task) -> dict[str, Any]:
        core = free.get()
        try:
            return task.asked | run_one(task, core, limit=limit, files=place / f"run{number}")
        finally:
            free.put(core)

    with ThreadPoolExecutor(len(cores)) as pool:
        futures = [pool.submit(one, number, task) for number, task in enumerate(tasks)]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def run_one(task: Task, core: int | None, *, limit: float, files: Path) -> dict[str, Any]:
    """Run a task in a process: its figures, its limit if time ran out, or its error."""
    asked, figures = files.with_suffix(".job.json"), files.with_suffix(".figures.json")
    asked.write_text(json.dumps(asdict(task.job)), "utf-8")
    pinned = ["taskset", "-c", str(core)] if core is not None and shutil.which("taskset") else []
    command = [*pinned, sys.executable, "-P", judge_shot.__file__, str(asked), str(figures)]
    try:
        done = subprocess.run(
            command,
            cwd=task.tree,
            env=_environment(task.tree),
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"over": limit}
    if done.returncode:
        return {"error": (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]}
    return {"figures": json.loads(figures.read_text("utf-8"))}


def tables(runs: Sequence[Mapping[str, Any]]) -> str:
    """The tables in Markdown: over all shots, then shot by shot."""
    versions = list(dict.fromkeys(run["version"] for run in runs))
    shots = {name: [run for run in runs if run["row"] == name] for name in dict.fromkeys(run["row"] for run in runs)}
    found = {name: {v: bands_of(each, v) for v in versions} for name, each in sorted(shots.items())}
    *others, last = versions
    parts = []
    for other in others:
        pairs = {name: (each[other], each[last]) for name, each in found.items()}
        parts += [f"## {last} against {other}, over all shots", overall(pairs)]
    parts += [f"{name}: {line}" for name, each in sorted(shots.items()) for line in odd_runs(each)]
    parts.append("## Shot by shot: mean ± half the range of three ripples")
    for name, each in found.items():
        job = shots[name][0]["job"]
        frames = f"frames {job['first'] + 1} to {job['first'] + job['count']}" if job["count"] else "whole"
        frames = f"from frame {job['first'] + 1} on" if job["first"] and not job["count"] else frames
        parts += [f"### {name} ({frames}, level {job['level']})", *odd_runs(shots[name]), shot_table(each)]
    return "\n\n".join(parts)


def bands_of(runs: Sequence[Mapping[str, Any]], version: str) -> dict[str, Band | None]:
    """Bands of a version's figures in one shot; none if a run did not end."""
    own = [run for run in runs if run["version"] == version]
    return bands([run["figures"] for run in own]) if all("figures" in run for run in own) else {}


def odd_runs(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each run that did not end."""
    lines = []
    for run in runs:
        if "figures" not in run:
            why = f"over {run['over']:g} s" if "over" in run else f"failed: {run['error']}"
            lines.append(f"{run['version']}, ripple {run['job']['ripple']:g}%: {why}")
    return lines


if __name__ == "__main__":
    main()
