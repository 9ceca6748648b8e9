"""Whole shots by this version and by another one in a folder of its own, in the same run.

    python -m benchmarks.beside CHECKOUT [FOLDER] [--shot NAME] [--frames N] [--level 2] [--jobs 1] [--limit 3600]

FOLDER holds the real shots. Each shot is walked by either version in a process of its own, in turns with one job.
Frames that both have solved within the limit are compared. Crossings are counted by `crossing_count`, which shares no
code with either solver; inside are vertices deeper than 0.1 mm, those that a body lets through included.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import click
import numpy as np

HERE = Path(__file__).resolve()
JUMP = 0.02
"""Second difference of a vertex's detail from frame to frame beyond which it jumps [m]."""


@click.command()
@click.argument("checkout", type=click.Path(path_type=Path, exists=True))
@click.argument("folder", required=False, type=click.Path(path_type=Path, exists=True))
@click.option("--shot", "shots", multiple=True, help="Only these.")
@click.option("--frames", default=1000, show_default=True, help="Most frames of a shot, from its first.")
@click.option("--level", default=2, show_default=True)
@click.option("--jobs", default=1, show_default=True, help="Processes at a time.")
@click.option("--limit", default=3600, show_default=True, help="Most seconds of a process.")
def main(
    checkout: Path, folder: Path | None, shots: Sequence[str], frames: int, level: int, jobs: int, limit: int
) -> None:
    """Print a table: the other version -> this one."""
    from benchmarks.contact_shots import REAL, SAMPLES, say  # noqa: PLC0415

    names = [name for name in [*(REAL if folder else ()), *SAMPLES] if not shots or any(s in name for s in shots)]
    say("| shot | frames | crossings | inside | jumps | energy mJ | strain p99 | s/frame | slowest / median |")
    say("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(jobs) as pool:

        def walk(name: str, version: Path) -> list[dict[str, Any]]:
            out = Path(place) / f"{title(name)}_{'before' if version == checkout else 'after'}"
            given: dict[str, Any] = {"sample": name, "level": level, "frames": frames, "out": str(out)}
            if name in REAL and folder is not None:
                garments, colliders, _ = REAL[name]
                given |= {"shot": str(folder.resolve() / name), "garments": garments, "colliders": colliders}
            paths = {"PYTHONPATH": os.pathsep.join([str(version.resolve()), os.environ.get("PYTHONPATH", "")])}
            command = [sys.executable, str(HERE), json.dumps(given)]
            with contextlib.suppress(subprocess.TimeoutExpired):  # What it has written counts.
                subprocess.run(command, env={**os.environ, **paths}, cwd=place, timeout=limit, check=False, stdout=2)
            lines = Path(f"{out}.json").read_text(encoding="utf-8").splitlines()
            return [json.loads(line) | {"detail": np.load(f"{out}.{n}.npy")} for n, line in enumerate(lines)]

        both = [[pool.submit(walk, name, version) for version in (checkout, HERE.parents[1])] for name in names]
        for name, pair in zip(names, both, strict=True):
            say(row(name, *(each.result() for each in pair)))


def row(name: str, before: Sequence[dict[str, Any]], after: Sequence[dict[str, Any]]) -> str:
    """One shot's line of the table: frames that both have."""
    count = min(len(before), len(after))
    told = [list(_figures(frames[:count])) for frames in (before, after)]
    pairs = (f"{a:,.3g} -> {b:,.3g}" if isinstance(a, float) else f"{a:,} -> {b:,}" for a, b in zip(*told, strict=True))
    return f"| {title(name)} | {count} | {' | '.join(pairs)} |"


def title(name: str) -> str:
    """A shot's name without folders and endings."""
    return Path(name).parts[0].split(".")[0]


def _figures(frames: Sequence[dict[str, Any]]) -> Iterator[float]:
    """Of some frames: crossings, vertices inside, jumps, mean energy, largest strain, median time, slowest over it."""
    spent = [each["seconds"] for each in frames]
    detail = np.array([each["detail"] for each in frames])
    yield sum(each["crossings"] for each in frames)
    yield sum(each["inside"] for each in frames)
    yield int((np.linalg.norm(np.diff(detail, 2, axis=0), axis=2) > JUMP).sum()) if len(detail) > 2 else 0
    yield float(np.mean([each["energy"] for each in frames]))
    yield float(max(each["strain"] for each in frames))
    yield float(np.median(spent))
    yield float(max(spent[1:], default=0.0) / np.median(spent))


def walk_shot(*, sample: str, level: int, frames: int, out: str, shot: str | None = None, **given: Any) -> None:
    """Solve a shot's frames in order by whatever version is on the path, and write a line and the detail of each."""
    from benchmarks.contact_shots import groups_of  # noqa: PLC0415
    from benchmarks.temporal import detail_of  # noqa: PLC0415
    from physgraph_usd.lab.samples import write_sample  # noqa: PLC0415
    from physgraph_usd.shot.options import RefineOptions  # noqa: PLC0415
    from physgraph_usd.solver.frame.pipeline import Refiner  # noqa: PLC0415
    from physgraph_usd.usd.read.reader import open_shot  # noqa: PLC0415

    sys.path.append(str(HERE.parent))
    from crossing_count import crossing_count  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as place:
        opened = open_shot(str(write_sample(sample, place)) if shot is None else shot, **given)
        levels = [level] * len(opened.scene.garments)
        refiner = Refiner(opened.scene, RefineOptions().solve_settings(), levels=levels)
        finest = refiner.group_of(tuple(range(len(levels)))).levels[-1]
        edges, triangles = finest.edges.cpu().numpy(), finest.triangles.cpu().numpy()
        with Path(f"{out}.json").open("w", encoding="utf-8") as file:
            for number, code in enumerate(opened.scene.times[:frames]):
                frame = opened.frame(code)
                began = time.process_time()
                state = refiner.solve(frame)
                seconds = time.process_time() - began
                entries: list[Any] = groups_of(state.telemetry)
                bodies = [b["after"] for e in entries for b in e.get("contact", {}).get("bodies", {}).values()]
                points = np.concatenate(list(state.points))
                np.save(f"{out}.{number}.npy", detail_of(refiner, frame, state.points).astype(np.float32))
                told = {
                    "seconds": seconds,
                    "crossings": crossing_count(points, edges, triangles),
                    "inside": sum(each["inside"] + each.get("passing", 0) for each in bodies),
                    "energy": 1e3 * refiner.energy(frame, list(state.points)),
                    "strain": max((each["strain"]["p99"] for each in entries), default=0.0),
                }
                file.write(json.dumps(told) + "\n")
                file.flush()


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        walk_shot(**json.loads(sys.argv[1]))
    else:
        main()
