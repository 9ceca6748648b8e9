"""What contact leaves in shots: vertices in bodies and crossings, before and after.

    python -m benchmarks.contact_shots [--frames 5] [--whole] [--level 2] [--shot NAME] [FOLDER]

Refines some frames in a row of each sample about contact and, where FOLDER holds real shots, of those with bodies.
Prints a row a shot: the sums over frames and garments.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.crossing_count import crossing_count
from benchmarks.judge_shot import groups_of
from benchmarks.rows import say
from benchmarks.temporal import detail_of
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.usd.read.reader import Shot, open_shot

SAMPLES = {"block": 8, "torus": 16, "armpit": 12, "layers": 6, "hood": 9, "crossing": 1, "skirt": 20, "tshirt": 30}
"""Samples and the number of their first frame here."""
REAL = {
    "01_newton_shirt_dab_cm.usdc": (["/shot/char/shirt_geo"], ["/shot/char/body_geo"], 36),
    "02_makehuman_usdskel_dm.usdc": (["/shot/char/top", "/shot/char/shorts"], ["/shot/char/body"], 20),
    "04_tiered_dress_kick_zup.usdc": (["/shot/tiered_dress"], ["/shot/mannequin"], 0),
    "06_torus_pull.usda": (["/shot/cloth"], ["/shot/torus"], 36),
    "08_sphere_spin_xformcollider.usdc": (["/shot/set/cloth"], ["/shot/set/rig/sphere"], 30),
    "09_cesiumman_kilt/shot.usda": (["/shot/kilt"], ["/shot/CesiumMan"], 30),
    "10_style3d_skirt_twist.usdc": (["/shot/skirt"], ["/shot/avatar"], 20),
}
"""Real shots: garments, bodies and the number of the first frame here."""
THREADS = 2
JUMP = 0.02
"""Second difference of a vertex's detail from frame to frame beyond which it jumps [m]."""


@dataclass
class Sums:
    """What a run left, summed over frames.

    Attributes:
        vertices: Free fine vertices.
        inside: Vertices deeper than 0.1 mm in closed bodies, before and after.
        deepest: Deepest of them after [mm].
        pinched: Those between overlapping parts of a body, after.
        body: Crossings of cloth and bodies, before and after.
        cloth: Crossings of cloth and cloth, before and after.
        counted: The latter counted by other means than the solver's.
        between: Those of different garments, before and after.
        worse: Frames with more crossings of cloth than before.
        strain: Largest 99th percentile of the edges' extension.
        seconds: Median of the frames' times.
        jumps: Vertices that jump, over all frames.
    """

    vertices: int = 0
    inside: tuple[int, int] = (0, 0)
    deepest: float = 0.0
    pinched: int = 0
    body: tuple[int, int] = (0, 0)
    cloth: tuple[int, int] = (0, 0)
    counted: int = 0
    between: tuple[int, int] = (0, 0)
    worse: int = 0
    strain: float = 0.0
    seconds: float = 0.0
    jumps: int = 0

    @property
    def percent(self) -> float:
        """Share of the vertices that are inside, after [%]."""
        return 100.0 * self.inside[1] / max(self.vertices, 1)

    def add(self, entry: dict[str, Any]) -> None:
        """Take one group's frame."""
        contact = entry.get("contact", {})
        for values in contact.get("bodies", {}).values():
            before, after = values["before"], values["after"]
            self.inside = _plus(self.inside, before["inside"], after["inside"])
            self.body = _plus(self.body, before["crossings"], after["crossings"])
            self.deepest = max(self.deepest, after["deepest_mm"])
            self.pinched += after["pinched"]
        cloth = contact.get("cloth")
        if cloth:
            before, after = cloth["before"], cloth["after"]
            self.cloth = _plus(self.cloth, before["crossings"], after["crossings"])
            self.between = _plus(self.between, before["between_garments"], after["between_garments"])
            self.worse += after["crossings"] > before["crossings"]
        self.strain = max(self.strain, entry["strain"]["p99"])


def _plus(pair: tuple[int, int], before: int, after: int) -> tuple[int, int]:
    return pair[0] + before, pair[1] + after


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--frames", default=5, show_default=True)
@click.option("--whole", is_flag=True, help="All frames of each shot.")
@click.option("--level", default=2, show_default=True)
@click.option("--shot", "shots", multiple=True, help="Only these.")
def main(folder: Path | None, frames: int, whole: bool, level: int, shots: Sequence[str]) -> None:
    """Print the table."""
    prepare_device("cpu")
    say(f"{'all frames' if whole else f'{frames} frames in a row'}, level {level}; a -> b: before and after")
    say(
        "| shot | vertices | inside | % | deepest mm | pinched | body crossings | cloth crossings | counted "
        "| garments | frames worse | jumps | strain p99 | s/frame |"
    )
    say("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place:
        for name in [*SAMPLES, *(REAL if folder else ())]:
            if shots and not any(each in name for each in shots):
                continue
            shot, first = open_one(name, Path(place), folder)
            first, count = (0, len(shot.scene.times)) if whole else (first, frames)
            say(_row(name, run(shot, first, count, level=level)))


def open_one(name: str, place: Path, folder: Path | None) -> tuple[Shot, int]:
    """A shot and the number of its first frame here."""
    if name in SAMPLES:
        return open_shot(str(write_sample(name, place))), SAMPLES[name]
    garments, colliders, first = REAL[name]
    return open_shot(str(Path(folder or "") / name), garments=garments, colliders=colliders), first


def run(shot: Shot, first: int, count: int, *, level: int) -> Sums:
    """Refine so many frames in a row, from the number of the first one, at a level."""
    levels = [level] * len(shot.scene.garments)
    refiner = Refiner(shot.scene, RefineOptions().solve_settings(), levels=levels, device="cpu", threads=THREADS)
    sums, spent, details = Sums(), list[float](), list[np.ndarray]()
    for time_code in shot.scene.times[first : first + count]:
        frame = shot.frame(time_code)
        began = time.perf_counter()
        garments = refiner.solve(frame).garments
        points = [garment.points for garment in garments]
        spent.append(time.perf_counter() - began)
        details.append(detail_of(refiner, frame, points))
        sums.counted += _counted(refiner, points)
        for entry in groups_of([garment.telemetry for garment in garments]):
            sums.add(entry)
        sums.vertices += sum(len(x) for x in points if x is not None)
    sums.seconds = sorted(spent)[len(spent) // 2]
    sums.jumps = jumps(np.array(details))
    return sums


def _counted(refiner: Refiner, points: Sequence[np.ndarray | None]) -> int:
    """Crossings of cloth with cloth, all garments taken together."""
    own = [each for each in points if each is not None]
    finest = refiner.group_of(tuple(range(len(points)))).levels[-1]
    edges, triangles = finest.edges.cpu().numpy(), finest.triangles.cpu().numpy()
    return crossing_count(np.concatenate(own), edges, triangles) if len(own) == len(points) else 0


def jumps(details: np.ndarray) -> int:
    """How often a vertex jumps.

    Args:
        details: [m], shape (frames, vertices, 3).
    """
    if len(details) < 3:
        return 0
    return int((np.linalg.norm(np.diff(details, 2, axis=0), axis=2) > JUMP).sum())


def _row(name: str, sums: Sums) -> str:
    arrows = [f"{a} -> {b}" for a, b in (sums.inside, sums.body, sums.cloth, sums.between)]
    return (
        f"| {Path(name).parts[0].split(chr(46))[0]} | {sums.vertices} | {arrows[0]} | {sums.percent:.3f} "
        f"| {sums.deepest:.2f} | {sums.pinched} | {arrows[1]} | {arrows[2]} | {sums.counted} | {arrows[3]} "
        f"| {sums.worse} | {sums.jumps} | {sums.strain:.3f} | {sums.seconds:.2f} |"
    )


if __name__ == "__main__":
    main()
