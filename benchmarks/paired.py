"""Refined cloth beside the fine simulation of which the cage is a part: its every fourth vertex.

    python -m benchmarks.paired [--guide 2000] [-o benchmarks/results/paired.md]

The sheets of `benchmarks.fidelity` are simulated at two subdivisions by the solver's own potential and inertia. The
vertices that subdivision keeps from the cage are the animation that is refined, so the simulation shows where the folds
of this animation were. What is between these vertices is not in the input: that the refined cloth is nearer to the
simulation than the subdivided cage says that its folds are the animation's. Means over the last half of the frames.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import click
import numpy as np
import scipy.sparse as sp

from benchmarks.fidelity import BANDS, GRAVITY, LEVEL, Judge, garment_of, level_at, simulated
from benchmarks.fidelity_stages import SCENES
from benchmarks.rows import say, table
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.scene import Frame, GarmentFrame, Scene

CASES = [(scene, fabric) for scene in ("curtain", "flag", "skirt") for fabric in ("jersey", "denim")]
FRAMES = 24
PAGE = Path("benchmarks/results/paired.md")
TEXT = """# Beside the fine simulation that the cage is every fourth vertex of

Written by `python -m benchmarks.paired`; `benchmarks/paired.py` says what it does.

- **Distance** [mm]: RMS, of the subdivided cage and of the refined cloth, from the simulation.
- **Correlation** of the detail, the difference from the linearly upsampled cage, with the simulation's.
- **Bands**: RMS of the detail in each band of wavelengths, refined / simulated.
"""


def row_of(case: tuple[str, str, float]) -> list[str]:
    """A row of the table, of a scene, a fabric and the guide's stiffness [N/m^3]."""
    prepare_device("cpu")
    scene, fabric, guide = case
    stage, values = SCENES[scene](), PRESETS[fabric]
    level = level_at(garment_of(stage, LEVEL), LEVEL)
    truth = np.array(list(simulated(stage, values, LEVEL, frames=FRAMES)))
    cages = truth[:, kept_from_cage(level.from_coarse)]
    refiner = Refiner(Scene((garment_of(stage, LEVEL),), GRAVITY), SolveSettings())
    frames = [Frame(float(n), (GarmentFrame(cage, values, guide=guide),)) for n, cage in enumerate(cages)]
    fine = np.array([state.points[0] for state in refiner.refine(frames)])
    late, judge = slice(FRAMES // 2, None), Judge(level, level.from_coarse @ stage.flat)
    linear, smooth = (
        np.array([each @ cage for cage in cages[late]]) for each in (level.from_coarse, level.smooth_from_coarse)
    )
    detail, true_detail = fine[late] - linear, truth[late] - linear
    bands = [np.mean([judge.amplitudes(x) for x in each], axis=0) for each in (detail, true_detail)]
    far = [1e3 * np.sqrt(((each - truth[late]) ** 2).sum(axis=2).mean()) for each in (smooth, fine[late])]
    correlation = (detail * true_detail).sum() / np.sqrt((detail**2).sum() * (true_detail**2).sum())
    return [scene, fabric, *(f"{each:.2f}" for each in (*far, correlation, *(bands[0] / bands[1])))]


def kept_from_cage(from_coarse: sp.csr_matrix) -> np.ndarray:
    """The fine vertex at each vertex of the cage, shape (C,): it depends on that one alone."""
    matrix = sp.coo_matrix(from_coarse)
    alone = matrix.data == 1.0
    out = np.empty(from_coarse.shape[1], np.int64)
    out[matrix.col[alone]] = matrix.row[alone]
    return out


@click.command()
@click.option("--guide", default=2000.0, show_default=True, help="Stiffness of the guide [N/m^3].")
@click.option("-o", "--out", type=click.Path(path_type=Path), default=PAGE, show_default=True)
@click.option("--jobs", default=2, show_default=True, help="Rows made at once.")
def main(guide: float, out: Path, jobs: int) -> None:
    """Write the page."""
    ends = [f"{1e3 * a:g}-{1e3 * b:g} mm" for a, b in pairwise(BANDS)]
    head = ["scene", "fabric", "subdivided, mm", "refined, mm", "correlation", *ends]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        rows = list(pool.map(row_of, [(*case, guide) for case in CASES]))
    text = f"{TEXT}\n{table([*head, f'under {1e3 * BANDS[-1]:g} mm'], rows)}\n"
    say(text)
    out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
