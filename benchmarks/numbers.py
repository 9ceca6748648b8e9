"""What each number of the solver does: half and double of it, over short scenes, against the noise of ripples.

    python -m benchmarks.numbers [--only NAME]... [--jobs 16] [--json FIGURES.json]
        [--out benchmarks/results/numbers.md]
    python -m benchmarks.numbers --count        numbers by room only
    python -m benchmarks.numbers --path         files and kinds of records of a warm frame only

Numbers of contact, collide, frame and integrate (`benchmarks.constants`) are halved and doubled, one at a time, in a
running process; whole numbers stay 1 or more. Every variant refines some frames of each scene with three ripples, and
its means are compared with those of nine ripples of the solver as it is, beyond the noise that `benchmarks.verdicts`
pools over all variants; counts vary at least as counts of chance do. A variant whose first ripple gives equal figures
to the bit has no effect in the scene, and its other ripples are left out.
With `--json` an interrupted command goes on.

Scenes are a few frames at level 1: a coat over a shirt whose cages cross, a dancer, trims sewn on a garment, cloth
pulled over a torus and over a block, cloth pinched by an armpit, a cage that crosses itself, and a folded sleeve
whose cage stands but for movements of 0.1% of an edge, as in noise.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from pxr import Usd, UsdGeom, Vt

from benchmarks.constants import Number, changed, numbers_in
from benchmarks.effects import BASE_RIPPLES, TIMES, counted, key_of, page
from benchmarks.frame_path import text_of_path
from benchmarks.judge_shot import RIPPLES, Job, judged, layer_over, offsets, rippled
from benchmarks.rows import code_of, say
from benchmarks.verdicts import Values
from physgraph_usd.errors import PhysGraphError
from physgraph_usd.lab.samples import SAMPLES, write_sample
from physgraph_usd.usd.read.reader import open_shot

HERE = Path(__file__).resolve().parents[1]
ROOMS = ("contact", "collide", "frame", "integrate")
SCENES = {
    "overcoat": ("overcoat", 6, 2),
    "dancer": ("dancer", 20, 5),
    "trims": ("trims", 5, 3),
    "torus": ("torus", 15, 3),
    "armpit": ("armpit", 11, 3),
    "crossing": ("crossing", 0, 3),
    "block": ("block", 7, 3),
    "still": ("sleeve", 23, 4),
}
"""Sample, number of the first frame and number of frames of each scene; long scenes first."""
STANDING, JITTER = "still", 1e-3
"""The scene whose cage stands in the first frame's pose, and the size of its cage's movements [mean edges]."""
FAILURES = (ArithmeticError, AssertionError, LookupError, OSError, PhysGraphError, RuntimeError, TypeError, ValueError)
"""Errors of runs with a number out of range, and of runs over the time limit."""
_SEEN: set[str] = set()
"""Scenes already refined in this process. A first refinement loads kernels and is not measured."""


@dataclass(frozen=True)
class Variant:
    """A number with another value, or the solver as it is, in one scene.

    Attributes:
        scene: Name of the scene.
        jobs: A run per ripple.
        number: The number, or None.
        kind: "half" or "double"; without a number "base" and the ripple.
    """

    scene: str
    jobs: tuple[Job, ...]
    number: Number | None = None
    kind: str = "base"

    @property
    def key(self) -> str:
        """Identity in a file of figures."""
        return key_of(self.scene, self.number, self.kind)


@click.command()
@click.option("--only", "names", multiple=True, help="Only numbers of this name.")
@click.option("--scene", "scenes", multiple=True, help="Only these scenes.")
@click.option("--jobs", type=int, help="Processes.  [default: number of cores]")
@click.option("--limit", default=240.0, show_default=True, help="Longest variant of a scene [s].")
@click.option("--json", "file", type=click.Path(path_type=Path), help="Keep raw figures here, and go on from them.")
@click.option("--out", type=click.Path(path_type=Path), help="Write the tables here too.")
@click.option("--count", "only_count", is_flag=True, help="Print numbers by room only.")
@click.option("--path", "only_path", is_flag=True, help="Print files and records of a warm frame only.")
def main(
    names: Sequence[str],
    *,
    scenes: Sequence[str],
    out: Path | None,
    only_count: bool,
    only_path: bool,
    **options: Any,
) -> None:
    """Print, and write, what each number does."""
    if only_path:
        say(text_of_path())
        return
    every = numbers_in(HERE)
    numbers = [each for each in every if each.room in ROOMS and (not names or each.name in names)]
    text = counted(every)
    if not only_count:
        chosen = [name for name in SCENES if (not scenes or name in scenes) and is_there(name)]
        text = page(numbers, measured(numbers, chosen, **options), chosen) + "\n\n" + text
    say(text)
    if out is not None:
        out.write_text(text + "\n", "utf-8")


def is_there(scene: str) -> bool:
    """Whether the sample of a scene exists; a missing one is named."""
    sample = SCENES[scene][0]
    if sample not in SAMPLES:
        click.echo(f"{scene} is left out: there is no sample {sample}", err=True)
    return sample in SAMPLES


def measured(
    numbers: Sequence[Number], scenes: Sequence[str], *, file: Path | None, jobs: int | None, limit: float
) -> dict[str, Any]:
    """Figures of each variant by key: a list of one entry per ripple, or the reason why there are none."""
    code = code_of(HERE / "physgraph_usd")
    kept = json.loads(file.read_text("utf-8")) if file is not None and file.exists() else {}
    found: dict[str, Any] = kept["variants"] if kept.get("code") == code else {}
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [*range(os.cpu_count() or 1)]
    count = jobs or len(cores)
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder, _pool(count, cores) as pool:
        ripples = {name: ripples_of(name, Path(folder)) for name in scenes}
        # The solver as it is comes first: variants are compared with it.
        base = [Variant(name, (job,), kind=f"base {k}") for name, each in ripples.items() for k, job in enumerate(each)]
        changes = [
            Variant(name, each[: len(RIPPLES)], number, kind)
            for name, each in ripples.items()
            for number in numbers
            for kind in number.variants
        ]
        for variants in (base, changes):
            left = [each for each in variants if each.key not in found]
            first = {name: (found.get(f"{name}: base 0") or [None])[0] for name in scenes}
            futures = {pool.submit(run_variant, each, first[each.scene], limit): each for each in left}
            for done, future in enumerate(as_completed(futures), 1):
                variant, runs = futures[future], future.result()
                if variant.number is None and isinstance(runs, str):
                    raise click.ClickException(f"{variant.key}: the solver as it is fails: {runs}")
                found[variant.key] = runs
                click.echo(f"{done} of {len(left)}: {variant.key}", err=True)
                if file is not None:
                    file.write_text(json.dumps({"code": code, "variants": found}), "utf-8")
    return found


def _pool(count: int, cores: Sequence[int]) -> ProcessPoolExecutor:
    """Fresh processes, each on its own core."""
    context = multiprocessing.get_context("spawn")
    free = context.SimpleQueue()
    for k in range(count):
        free.put(cores[k % len(cores)])
    return ProcessPoolExecutor(count, mp_context=context, initializer=_pin, initargs=(free,))


def _pin(free: Any) -> None:
    """Keep this process on one core of a queue of cores."""
    core = free.get()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})


def ripples_of(scene: str, folder: Path) -> tuple[Job, ...]:
    """Write a scene's rippled shots, and return a job for each."""
    sample, first, count = SCENES[scene]
    shot = folder / f"{sample}.usdc"
    if not shot.exists():
        write_sample(sample, folder)
    opened = open_shot(str(shot))
    prims, times = [str(source.path) for source in opened.sources], opened.scene.times
    opened.close()
    if scene == STANDING:
        shot = standing(shot, prims, folder / f"{scene}.usdc", times=(times[first], times[:count]))
        first = 0
    jobs = []
    for k in range(BASE_RIPPLES):
        file = folder / f"{scene}_{k}.usdc"
        rippled(shot, prims, file, size=RIPPLES[k % len(RIPPLES)] / 100.0, seed=k + 1)
        jobs.append(Job(str(file), first=first, count=count, level=1))
    return tuple(jobs)


def standing(shot: Path, prims: Sequence[str], out: Path, *, times: tuple[float, Sequence[float]]) -> Path:
    """Write a layer over a shot in which the first samples of some meshes are one pose with small random movements.

    Args:
        shot: Path of the shot.
        prims: Prim paths of the meshes.
        out: Path of the layer to write.
        times: Time code of the pose, and time codes of the samples.
    """
    layer = layer_over(shot, out)
    stage = Usd.Stage.Open(layer)
    random = np.random.default_rng(0)
    for prim in prims:
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(prim))
        pose = np.asarray(mesh.GetPointsAttr().Get(times[0]), np.float64)
        moves = [offsets(mesh, pose, JITTER, random) for _ in times[1]]
        for code, move in zip(times[1], moves, strict=True):
            mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy((pose + move).astype(np.float32)), code)
    layer.Save()
    return out


def run_variant(variant: Variant, base: Values | None, limit: float) -> Any:
    """Figures of a variant, one entry per ripple; one entry only if nothing changes; a text if a run fails.

    Args:
        variant: The variant.
        base: Figures of the solver as it is, of the first ripple.
        limit: Longest time [s].
    """
    number = variant.number
    context = nullcontext() if number is None else changed(number, number.variants[variant.kind])
    if variant.scene not in _SEEN:
        _SEEN.add(variant.scene)
        judged(replace(variant.jobs[0], count=1))
    found: list[Values] = []
    try:
        with _limited(limit), context:
            for job in variant.jobs:
                found.append(judged(job))
                if base is not None and number is not None and not _differs(found[0], base):
                    break
    except FAILURES as error:
        return f"{type(error).__name__}: {error}"
    return found


def _differs(one: Values, base: Values) -> bool:
    """Whether two runs of one ripple differ in a figure other than a time."""
    return any(one[name] != base[name] for name in base if name not in TIMES)


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise TimeoutError after some seconds, where the system has alarms."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def late(*_: object) -> None:
        raise TimeoutError(f"over {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


if __name__ == "__main__":
    main()
