"""Crease memory: what is left of an elbow's folds when it is straight again, and what a frame costs.

    python -m benchmarks.crease [--fabric worn-denim] [--level 2]

A sleeve without an arm bends by 100 degrees in half a second, stays so for one, straightens in half a second and is
held for three. **Folds** are the RMS differences of the hinges' angles at the elbow from those in the first frame, in
degrees: before it straightens, as soon as it is straight, one second later and three. **Jump** is the RMS second
difference of the positions of all frames; the time is the mean of the frames that move.
"""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from benchmarks.rows import say
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.level import hinge_geometry
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Grain, Scene

ROWS, AROUND, LENGTH, RADIUS = 25, 24, 0.5, 0.065
"""Vertices along the sleeve and around it, and its size [m]."""
BENT, MOVES, HELD, STRAIGHT = np.radians(100.0), 12, 24, 48
"""Angle, frames of each move, frames in which it stays bent, and the first that is straight; 24 a second."""
ELBOW = 0.12
"""Distance from the middle of the sleeve up to which hinges are the elbow's [m]."""
TIMES = (0.0, 0.5, 2.0, 8.0)
HEAD = (
    "| creaseTime, s | folds: bent | straight | 1 s later | 3 s later | jump, mm | a frame, ms |",
    "|" + "---|" * 7,
)


@dataclass(frozen=True, eq=False)
class Worn:
    """An elbow that was refined.

    Attributes:
        folds: RMS fold of each frame [degrees].
        fine: Positions [m], shape (frames, V, 3).
        seconds: Processor time of each frame [s].
        joules: Elastic energy at the end of each frame; that of the one before where it was not solved.
    """

    folds: np.ndarray
    fine: np.ndarray
    seconds: np.ndarray
    joules: np.ndarray

    @property
    def jumps(self) -> np.ndarray:
        """RMS second difference of the positions about each frame but the ends [m]."""
        return np.sqrt((np.diff(self.fine, 2, axis=0) ** 2).sum(axis=2).mean(axis=1))


def sleeve(level: int) -> Garment:
    """A tube along x whose ends are pinned, its warp along it."""
    v, u = np.meshgrid(np.linspace(-0.5, 0.5, ROWS), 2 * np.pi * np.arange(AROUND) / AROUND, indexing="ij")
    rest = np.stack([LENGTH * v, RADIUS * np.cos(u), RADIUS * np.sin(u)], axis=-1).reshape(-1, 3)
    first = np.arange((ROWS - 1) * AROUND)
    beside = first + np.where(first % AROUND == AROUND - 1, 1 - AROUND, 1)
    faces = np.stack([first, first + AROUND, beside + AROUND, beside], axis=1)
    one = np.ones(len(rest))
    grain = Grain(np.tile([1.0, 0.0, 0.0], (len(faces), 1)), one, 0 * one)
    pin = np.arange(len(rest)) // AROUND % (ROWS - 1) == 0
    return replace(Garment.of("/Sleeve", faces, rest, level=level), grain=grain, pin=pin.astype(float))


def posed(rest: np.ndarray, frame: int) -> np.ndarray:
    """The cage in a frame [m]: skinned to two bones, blended over 20 cm."""
    up, down = (np.clip(each / MOVES, 0.0, 1.0) for each in (frame, frame - MOVES - HELD))
    angle = BENT * (up * up * (3.0 - 2.0 * up) - down * down * (3.0 - 2.0 * down))
    weight = np.clip(0.5 + rest[:, :1] / 0.2, 0.0, 1.0)
    weight = weight * weight * (3.0 - 2.0 * weight)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return (1.0 - weight) * rest + weight * rest @ turn.T


def worn(fabric: Fabric, *, level: int = 2, frames: int = STRAIGHT + 73) -> Worn:
    """Refine the sleeve from frame to frame."""
    garment = sleeve(level)
    scene = Scene((garment,), np.array([0.0, 0.0, -9.81]), tuple(map(float, range(frames))))
    refiner = Refiner(scene, SolveSettings())
    fine, seconds, joules = [], [], []
    for number in range(frames):
        began = clock.process_time()
        state = refiner.solve(Frame(float(number), (GarmentFrame(posed(garment.rest, number), fabric),)))
        seconds.append(clock.process_time() - began)
        fine.append(state.points[0])
        joules.append(elastic(state.telemetry[0]) if "levels" in state.telemetry[0] else joules[-1])
    mesh = refiner.groups[0].levels[-1]
    hinges = mesh.hinges.numpy()
    hinges = hinges[np.abs(mesh.rest.numpy()[hinges[:, 0], 0]) < ELBOW]
    angles = np.array([hinge_geometry(x, hinges)[0] for x in fine])
    folds = np.degrees(np.sqrt(((angles - angles[0]) ** 2).mean(axis=1)))
    return Worn(folds, np.array(fine), np.array(seconds), np.array(joules))


def elastic(telemetry: dict[str, object]) -> float:
    """Energy of stretch, shear and bending [J] in a frame's telemetry."""
    energies = telemetry["energy_joules"]
    assert isinstance(energies, dict)
    return sum(value for name, value in energies["output"].items() if name in ("stretch", "membrane", "bending"))


def rows(fabric: Fabric, level: int, times: Sequence[float] = TIMES) -> None:
    """Print the table."""
    say("\n".join(HEAD))
    for time in times:
        found = worn(replace(fabric, crease_time=time), level=level)
        at = (STRAIGHT - MOVES - 1, STRAIGHT, STRAIGHT + 24, STRAIGHT + 72)
        cells = [f"{found.folds[frame]:.2f}" for frame in at]
        jump, frame = np.sqrt((found.jumps**2).mean()), found.seconds[1:STRAIGHT]
        moving = np.r_[frame[:MOVES], frame[MOVES + HELD :]].mean()
        say(f"| {time:g} | {' | '.join(cells)} | {1e3 * jump:.2f} | {1e3 * moving:.0f} |")


def main() -> None:
    """Print the table of a fabric."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fabric", choices=PRESETS, default="worn-denim")
    parser.add_argument("--level", type=int, default=2)
    given = parser.parse_args()
    torch.set_num_threads(1)
    prepare_device("cpu")
    rows(PRESETS[given.fabric], given.level)


if __name__ == "__main__":
    main()
