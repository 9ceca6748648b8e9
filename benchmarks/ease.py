"""What ease adds: curvature, crossings and time of cloth that is 0, 2 and 4% longer than its cage shows.

    python -m benchmarks.ease [tshirt|skirt] [--pictures docs/pictures]       the sample T-shirt and a simulated skirt
    python -m benchmarks.ease SHOT --garment PATH --collider PATH [--frames 1:6] [--along warp] [--pictures FOLDER]

Curvature is the total absolute mean curvature at two subdivisions in metres, mean over frames; what refining adds is
the difference to Loop subdivision, and the last columns set it and the time a frame over those without ease. The skirt
is that of `benchmarks.fidelity`: its cage is simulated in silk and hardly folds, and beside it stands the fine
simulation. The T-shirt has none. Pictures show Loop subdivision, each ease, and what was simulated.
"""

from __future__ import annotations

import argparse
import statistics
import time as clock
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.drawing import Thing, still, upright
from benchmarks.fidelity import Judge, garment_of, level_at, refined, simulated
from benchmarks.fidelity_stages import SCENES
from benchmarks.rows import say
from benchmarks.shots import opened
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.solver.scene import Result
from physgraph_usd.usd.read.reader import Shot, open_shot

EASES = (0.0, 2.0, 4.0)
"""Per cent."""
LEVEL = 2
HEAD = (
    "| | ease | Loop, m | refined, m | added | added, over none | crossings left | time, over none |",
    "|" + "---|" * 8,
)


@dataclass(frozen=True, eq=False)
class Eased:
    """Cloth refined with one ease.

    Attributes:
        loop, fine: Positions in each frame by Loop subdivision and refined [m], shape (F, V, 3).
        seconds: Median processor time of a frame but the first [s].
        crossings: Edges through faces of cloth in all frames.
    """

    loop: np.ndarray
    fine: np.ndarray
    seconds: float
    crossings: int


def crossings_of(result: Result, when: str = "after") -> int:
    """Edges through faces of cloth in a frame."""
    contacts = [garment.telemetry.get("contact", {}) for garment in result.garments]
    return sum(each["cloth"][when]["crossings"] for each in contacts if "cloth" in each)


def of_shot(shot: Shot, times: Sequence[float], level: Level) -> Eased:
    """A shot's first garment, solved as `refine` does; level is its fine mesh."""
    refiner = Refiner(shot.scene, RefineOptions().solve_settings())
    loop, fine, seconds, crossings = [], [], [], 0
    for time in times:
        frame = shot.frame(time)
        began = clock.process_time()
        result = refiner.solve(frame)
        seconds.append(clock.process_time() - began)
        loop.append(level.smooth_from_coarse @ frame.garments[0].points)
        fine.append(result.garments[0].points)
        crossings += crossings_of(result)
    return Eased(np.array(loop), np.array(fine), statistics.median(seconds[1:] or seconds), crossings)


def say_rows(name: str, level: Level, found: dict[float, Eased]) -> None:
    """Print a row for each ease."""
    judge = Judge(level, level.rest.double().numpy()[:, :2])
    curvature = {
        ease: [np.mean([judge.curvature(x) for x in side]) for side in (each.loop, each.fine)]
        for ease, each in found.items()
    }
    none, plain = curvature[EASES[0]], found[EASES[0]]
    for ease, each in found.items():
        loop, fine = curvature[ease]
        ratio = (fine - loop) / (none[1] - none[0])
        cells = [f"{loop:.1f}", f"{fine:.1f}", f"{fine - loop:.1f}", f"{ratio:.2f}", f"{each.crossings}"]
        say(f"| {name} | {ease:g}% | {' | '.join(cells)} | {each.seconds / plain.seconds:.2f} |")


def opened_with(name: str, ease: float, given: argparse.Namespace) -> Shot:
    """A shot, or the sample T-shirt, with ease."""
    ways = ("warp", "weft") if given.along == "both" else (given.along,)
    overrides = [f"rest:{way}Ease={ease:g}" for way in ways]
    if name == "tshirt":
        return opened(name, LEVEL, overrides=overrides)
    return open_shot(name, garments=given.garment, colliders=given.collider, level=LEVEL, overrides=overrides)


def shot_rows(name: str, given: argparse.Namespace) -> None:
    """A shot's rows, and its picture."""
    first, last = (float(each) for each in given.frames.split(":"))
    with closing(opened_with(name, 0.0, given)) as shot:
        times = [each for each in shot.scene.times if first <= each <= last]
        poses = [pose for pose in shot.frame(times[-1]).colliders if pose]
        turn = upright if shot.scene.gravity[2] < -1.0 else np.asarray
        [garment, *_] = shot.scene.garments
    level, found = build_levels([garment], refine_garments([garment], [garment.level]))[-1], {}
    for ease in EASES:
        with closing(opened_with(name, ease, given)) as shot:
            found[ease] = of_shot(shot, times, level)
    title = Path(name).stem
    say_rows(title, level, found)
    if given.pictures:
        triangles = level.triangles.numpy()
        bodies = [Thing(turn(pose.points), pose.triangles, cloth=False) for pose in poses]
        panels = [("Loop subdivision", found[EASES[0]].loop[-1])]
        panels += [(f"refined, {ease:g}% ease", each.fine[-1]) for ease, each in found.items()]
        shown = [(text, [Thing(turn(x), triangles), *bodies]) for text, x in panels]
        still(shown, given.pictures / f"ease_{title}.png", camera=(20.0, 5.0))


def skirt_rows(pictures: Path | None, frames: int = 20) -> None:
    """Rows and picture of the skirt that is simulated, in silk."""
    stage, silk = SCENES["skirt"](), PRESETS["silk"]
    cages = list(simulated(stage, silk, 0, frames=frames))
    truth = list(simulated(stage, silk, LEVEL, frames=frames))
    level = level_at(garment_of(stage, LEVEL), LEVEL)
    loop, found = np.array([level.smooth_from_coarse @ cage for cage in cages]), {}
    for ease in EASES:
        began = clock.process_time()
        fine = np.array(refined(stage, replace(silk, weft_ease=ease / 100.0), cages, LEVEL))
        late = slice(frames // 2, None)
        found[ease] = Eased(loop[late], fine[late], (clock.process_time() - began) / frames, 0)
    say_rows("simulated skirt, silk", level, found)
    judge = Judge(level, level.from_coarse @ stage.flat)
    say(f"simulated finely: {np.mean([judge.curvature(x) for x in truth[frames // 2 :]]):.1f} m")
    if pictures:
        panels = [("Loop subdivision", loop[-1])]
        panels += [(f"refined, {ease:g}% ease", each.fine[-1]) for ease, each in found.items()]
        panels += [("simulated finely", truth[-1])]
        shown = [(text, [Thing(upright(x), level.triangles.numpy())]) for text, x in panels]
        still(shown, pictures / "ease_skirt.png", camera=stage.camera)


def main() -> None:
    """Print the table and draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", nargs="?")
    parser.add_argument("--garment", action="append", default=[])
    parser.add_argument("--collider", action="append", default=[])
    parser.add_argument("--frames", default="21:24", metavar="FIRST:LAST")
    parser.add_argument("--along", choices=("weft", "warp", "both"), default="weft")
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    prepare_device("cpu")
    say("\n".join(HEAD))
    if given.shot != "skirt":
        shot_rows(given.shot or "tshirt", given)
    if given.shot in (None, "skirt"):
        skirt_rows(given.pictures)


if __name__ == "__main__":
    main()
