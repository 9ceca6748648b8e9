"""The ease that gives a skinned sleeve the curvature of a simulated one, by fabric.

    python -m benchmarks.ease_skinned [--fabrics jersey silk denim] [--eases 0 1 2 4 6]

The sleeve of `benchmarks.fidelity`'s elbow on an arm that bends by 90 degrees in 0.7 s and is held. The truth is its
simulation at two subdivisions by the solver's own potential and inertia, pressed by the arm, without friction and cloth
on cloth: with a cuff that moves with the forearm, and with one that is free and slides up. The cage that is refined was
never simulated: it is skinned to two bones. It is refined with bodies and contact, with each ease along the weft
(around the arm) and along the warp. Curvature is the total absolute mean curvature [m], mean over the last
half of 24 frames; the last columns are the eases at which it is first that of either simulation, between two that were
tried.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from benchmarks.fidelity import FABRICS, RATE, Judge, garment_of, level_at, refined, simulated
from benchmarks.fidelity_stages import Stage, elbow
from benchmarks.rows import say
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS, Fabric

FRAMES, LEVEL, BENT = 24, 2, 90.0
BLEND = 0.2
"""Length of the sleeve over which one bone's weight gives way to the other's [m]."""
EASES = (0.0, 1.0, 2.0, 4.0, 6.0)
ALONG = {"weft": (0.0, 1.0), "warp": (1.0, 0.0)}
"""Parts of the ease along warp and weft."""


def skinned() -> Stage:
    """The elbow, its whole sleeve moved by linear-blend skinning; both ends are held."""
    stage = elbow(BENT)
    weight = np.clip(0.5 + stage.rest[:, :1] / BLEND, 0.0, 1.0)
    weight = weight * weight * (3.0 - 2.0 * weight)

    def motion(time: float) -> np.ndarray:
        _, axis = stage.bodies[1].ends(time)
        turn = np.array([[axis[0], 0.0, -axis[2]], [0.0, 1.0, 0.0], [axis[2], 0.0, axis[0]]])
        return (1.0 - weight) * stage.rest + weight * stage.rest @ turn.T

    along = stage.rest[:, 0]
    return replace(stage, motion=motion, held=(along == along.min()) | (along == along.max()))


def rows(name: str, eases: Sequence[float]) -> None:
    """Print a fabric's rows."""
    stage, fabric = skinned(), PRESETS[name]
    level = level_at(garment_of(stage, LEVEL), LEVEL)
    judge, late = Judge(level, level.from_coarse @ stage.flat), slice(FRAMES // 2, None)
    cages = [stage.motion((number + 1) / RATE) for number in range(FRAMES)]

    def curvature(frames: Sequence[np.ndarray]) -> float:
        return float(np.mean([judge.curvature(x) for x in frames[late]]))

    free = replace(stage, held=stage.held & (stage.rest[:, 0] < 0.0))
    truths = [curvature(list(simulated(each, fabric, LEVEL, frames=FRAMES, touches=True))) for each in (stage, free)]
    loop = curvature([level.smooth_from_coarse @ cage for cage in cages])
    known: dict[Fabric, float] = {}
    for along, (warp, weft) in ALONG.items():
        kinds = [eased(fabric, warp * ease, weft * ease) for ease in eases]
        for kind in kinds:
            if kind not in known:
                known[kind] = curvature(refined(stage, kind, cages, LEVEL, touches=True))
        found = [known[kind] for kind in kinds]
        cells = [f"{each:.2f}" for each in (loop, *truths, *found)]
        say(f"| {name} | {along} | {' | '.join(cells + [crossing(eases, found, truth) for truth in truths])} |")


def eased(fabric: Fabric, warp: float, weft: float) -> Fabric:
    """A fabric with ease along warp and weft [%]."""
    return replace(fabric, warp_ease=0.01 * warp, weft_ease=0.01 * weft)


def crossing(eases: Sequence[float], found: Sequence[float], truth: float) -> str:
    """The least ease [%] at which curvature reaches what was simulated, or on which side it stays."""
    if found[0] >= truth:
        return f"{eases[0]:g}%, {found[0] / truth:.2f} times"
    for index in range(1, len(eases)):
        if found[index] >= truth:
            part = (truth - found[index - 1]) / (found[index] - found[index - 1])
            return f"{eases[index - 1] + part * (eases[index] - eases[index - 1]):.1f}%"
    return f"over {eases[-1]:g}%"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fabrics", nargs="+", choices=sorted(PRESETS), default=list(FABRICS))
    parser.add_argument("--eases", nargs="+", type=float, default=list(EASES), metavar="PERCENT")
    given = parser.parse_args()
    torch.set_num_threads(1)
    prepare_device("cpu")
    tried = [f"{each:g}%" for each in given.eases]
    names = ["fabric", "ease along", "Loop, m", "simulated, m", "cuff free", *tried, "equal at", "cuff free"]
    say(f"| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for name in given.fabrics:
        rows(name, given.eases)


if __name__ == "__main__":
    main()
