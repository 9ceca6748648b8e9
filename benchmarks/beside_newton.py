"""Cost of refined cloth beside Newton's VBD and Style3D, which simulate it on the same mesh and card.

    python -m benchmarks.beside_newton --newton PYTHON [--device cuda] [--level 2]... [--frames 24]
        [-o benchmarks/results/newton.md]

Scenes and fabrics are those of `benchmarks.fidelity` that touch bodies or fold over themselves. The cage that is
refined is simulated by Style3D, at the cage's resolution, as it is there.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks.crossing_count import crossing_count
from benchmarks.fidelity import RATE, garment_of, level_at, problem_of, timed
from benchmarks.fidelity_stages import SCENES, Stage
from benchmarks.rows import say, table
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.level import Level

CHOSEN = ("curtain", "ball", "elbow")
"""Scenes: gathered cloth without a body, cloth over a ball, a sleeve on an arm that bends."""
FABRIC = "jersey"
SIMULATED: dict[str, dict[str, Any]] = {
    "vbd": {"substeps": 10, "iterations": (10, 0)},
    "style3d": {"substeps": 10, "iterations": (4, 10)},
}
"""Steps of a frame of 1/24 s and iterations in each, as in Newton's own examples (VBD: ten, not four)."""
APART = 0.25
"""Contact distance of cloth in Newton's solvers, relative to the mesh's spacing."""
WARM, COUNTED = 2, 4
"""Untimed frames at the start; stride of the frames in which crossings are counted."""
PAGE = Path("benchmarks/results/newton.md")
TEXT = """# Beside Newton's solvers on one mesh

Written by `python -m benchmarks.beside_newton --newton PYTHON`, on {device}, Newton {newton}; fabric {fabric}, {frames}
frames at 24 a second. VBD: 10 steps of 10 iterations a frame. Style3D: 10 steps of 4 iterations of 10 conjugate
gradients. Both simulate the fine sheet, self-contact on, their steps recorded as graphs; `refined` refines a cage of
the same sheet that Style3D simulates (20 steps, 4 iterations of 40). So they answer unlike questions: theirs has a
history.

- **Warm frame**: median of the milliseconds of a frame, after the first two; simulating the cage is not in it, its
  cost and the cage's stretch are in brackets.
- **Stretch**: 99th percentile over edges of their length over the rest length, less one; largest over frames.
- **Cloth through cloth**: edges that pass through triangles, sum over every fourth frame. **In bodies**: vertices, sum
  over frames.
"""


@dataclass(eq=False)
class Run:
    """What a method made of a scene.

    Attributes:
        method: Its name.
        frames: Positions of each frame [m], shape (F, V, 3).
        milliseconds: Of each frame.
        version: Newton's, "" of ours.
    """

    method: str
    frames: list[np.ndarray] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)
    version: str = ""

    @property
    def warm(self) -> float:
        """Median of a warm frame [ms]."""
        return float(np.median(self.milliseconds[WARM:]))


def by_newton(
    python: str, stage: Stage, subdivisions: int, *, solver: str, frames: int, device: str, **options: Any
) -> Run:
    """The sheet simulated by one of Newton's solvers; options replace parts of the problem."""
    substeps = {key: options.pop(key) for key in ("substeps",) if key in options}
    problem = problem_of(stage, PRESETS[FABRIC], subdivisions, frames=frames, **substeps) | options
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder) / "problem.npz", Path(folder) / "result.npz"
        np.savez(given, allow_pickle=False, **{name: np.asarray(value) for name, value in problem.items()})
        script = Path(__file__).with_name("newton_cloth.py")
        command = [python, str(script), str(given), str(result), "--solver", solver, "--device", device]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        found = np.load(result)
        return Run(solver, [*found["frames"].astype(float)], [*found["milliseconds"]], str(found["newton"]))


def runs(python: str, stage: Stage, subdivisions: int, *, frames: int, device: str) -> Iterator[Run]:
    """Each method on a scene; before ours the cage, simulated."""
    level = level_at(garment_of(stage, subdivisions), subdivisions)
    apart = APART * float(level.spacing.min())
    for solver, options in SIMULATED.items():
        yield by_newton(
            python, stage, subdivisions, solver=solver, frames=frames, device=device, apart=apart, **options
        )
    cage = by_newton(python, stage, 0, solver="style3d", frames=frames, device=device)
    found = [*timed(stage, PRESETS[FABRIC], cage.frames, subdivisions, touches=True, device=device)]
    points, spent = zip(*found, strict=True)
    drawn = max(stretch(level_at(garment_of(stage, 0), 0), x) for x in cage.frames)
    yield Run(f"refined (cage: {cage.warm:.0f} ms, {drawn:.1f}%)", [*points], [*spent])


def stretch(level: Level, x: np.ndarray) -> float:
    """99th percentile of the edges' strain [%]."""
    first, second = level.springs.numpy().T
    rest = np.linalg.norm(level.rest.double().numpy()[first] - level.rest.double().numpy()[second], axis=1)
    return float(100.0 * (np.percentile(np.linalg.norm(x[first] - x[second], axis=1) / rest, 99.0) - 1.0))


def inside(stage: Stage, x: np.ndarray, time: float) -> int:
    """Vertices inside bodies at a time [s]."""
    deep = np.zeros(len(x), dtype=bool)
    for body in stage.bodies:
        pose = body.pose(time)
        local = (x - pose.centre) @ pose.turn
        along = local[:, 2] - np.clip(local[:, 2], -body.half, body.half)
        deep |= np.linalg.norm(np.column_stack([local[:, :2], along]), axis=1) < body.radius
    return int(deep.sum())


def row_of(name: str, stage: Stage, level: Level, run: Run) -> list[str]:
    """A row of the table."""
    edges, triangles = level.springs.numpy(), level.triangles.numpy()
    count = partial(crossing_count, edges=edges, triangles=triangles)
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        crossed = sum(pool.map(count, run.frames[COUNTED - 1 :: COUNTED]))
    deep = sum(inside(stage, x, (n + 1) / RATE) for n, x in enumerate(run.frames))
    most = max(stretch(level, x) for x in run.frames)
    return [name, f"{level.vertex_count:,}", run.method, f"{run.warm:.0f}", f"{most:.1f}", f"{crossed:,}", f"{deep:,}"]


HEAD = ("scene", "vertices", "method", "warm frame, ms", "stretch, %", "cloth through cloth", "in bodies")


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=PAGE)
    parser.add_argument("--newton", required=True, metavar="PYTHON", help="A Python that has newton.")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--level", type=int, action="append", help="Subdivisions; may be repeated.")
    parser.add_argument("--scene", choices=CHOSEN, action="append")
    parser.add_argument("--frames", type=int, default=24)
    given = parser.parse_args(arguments)
    device, rows, versions = prepare_device(given.device), [], {""}
    for level, name in ((level, name) for level in given.level or (2, 3) for name in given.scene or CHOSEN):
        stage = SCENES[name]()
        mesh = level_at(garment_of(stage, level), level)
        for run in runs(given.newton, stage, level, frames=given.frames, device=device):
            rows.append(row_of(name, stage, mesh, run))
            versions.add(run.version)
            say(" ".join(rows[-1]))
    text = TEXT.format(device=wp.get_device(device).name, newton=max(versions), fabric=FABRIC, frames=given.frames)
    given.out.write_text("\n".join([text, table(HEAD, rows)]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
