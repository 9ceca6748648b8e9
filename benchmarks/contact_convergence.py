"""Steps to a gap with contact and without it.

    python -m benchmarks.contact_convergence [SAMPLE ...]

Refines one frame of samples from cold with ever more steps, with contact and without, and prints the gap
(Phi - Phi*) / (Phi0 - Phi*) of each. Phi holds the contact energy of planes and pairs found anew at the result, before
anything is pushed out or mended. Phi* is the least energy known: that of many steps in many rounds in float64, and
of Newton steps from there.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.sleeve import CORES, say
from physgraph_usd.contact.settings import ContactSettings
from physgraph_usd.integrate import method_named
from physgraph_usd.pipeline import Refiner
from physgraph_usd.samples import write_sample
from physgraph_usd.scene import Frame
from physgraph_usd.shot import prepare_device
from physgraph_usd.solve_settings import SolveSettings
from physgraph_usd.usd.reader import Shot, open_shot

SAMPLES = {"block": 12.0, "armpit": 15.0, "layers": 8.0, "sleeve": 24.0}
STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 36)
"""Steps at the finest level; four times as many below."""
GAP = 0.03
LEVEL = 1
LONG, SHORT = (600, 30, 30), (100, 10, 3)
"""Steps and rounds of the solve that gives Phi*, and Newton steps from there. Where much cloth touches cloth each round
has so many steps, and the long solve takes hours."""
SETTLED = {"layers": SHORT}
"""Samples with other than the long one."""


def main() -> None:
    """Print a row per sample and number of steps."""
    prepare_device("cpu")
    say("| sample | contact | " + " | ".join(f"{steps}" for steps in STEPS) + " | steps to 3% | Newton below |")
    say("|---" * (len(STEPS) + 4) + "|")
    with tempfile.TemporaryDirectory() as folder:
        for name, time in SAMPLES.items():
            if sys.argv[1:] and name not in sys.argv[1:]:
                continue
            shot = open_shot(str(write_sample(name, Path(folder))))
            needed = {}
            for label, contact in (("off", ContactSettings("off", cloth="off")), ("on", ContactSettings())):
                gaps, confirmed = table_row(shot, shot.frame(time), contact, settled_in=SETTLED.get(name, LONG))
                needed[label] = next((steps for steps, gap in zip(STEPS, gaps, strict=True) if gap <= GAP), None)
                cells = " | ".join(f"{gap:.1%}" for gap in gaps)
                say(f"| {name} | {label} | {cells} | {needed[label]} | {confirmed:.2%} |")


def table_row(
    shot: Shot, frame: Frame, contact: ContactSettings, *, settled_in: tuple[int, int, int]
) -> tuple[list[float], float]:
    """Gaps after each number of steps, and how far Newton got below the least energy of quasi-Newton, as a gap."""
    rough = [energy_after(shot, frame, settings_of(contact, steps))[0] for steps in STEPS]
    steps, rounds, newton_steps = settled_in
    many = replace(contact, rounds=rounds)
    start, settled = energy_after(shot, frame, settings_of(many, steps), dtype=torch.float64)[::-1]
    newton = energy_after(shot, frame, settings_of(many, newton_steps, method="newton"), dtype=torch.float64)[0]
    least = min(newton, settled, *rough)
    return [(energy - least) / (start - least) for energy in rough], (settled - least) / (start - least)


def settings_of(contact: ContactSettings, steps: int, *, method: str = "quasi-newton") -> SolveSettings:
    """A cold solve of a number of steps, nothing pushed out afterwards."""
    contact = replace(contact, projections=0, lifts=0)
    return SolveSettings(method_named(method), steps=steps, tolerance=0.0, temporal="off", contact=contact)


def energy_after(
    shot: Shot, frame: Frame, settings: SolveSettings, *, dtype: torch.dtype = torch.float32
) -> tuple[float, float]:
    """Energy of the result and of the upsampled input [J]."""
    levels = [LEVEL] * len(shot.scene.garments)
    refiner = Refiner(shot.scene, settings, levels=levels, dtype=dtype, lanes=CORES)
    state = refiner.solve(frame)
    fine = [points for points in state.points if points is not None]
    base = [chain[-1] for chain in refiner.refinements]
    coarse = [refinement.linear @ garment.points for refinement, garment in zip(base, frame.garments, strict=True)]
    return refiner.energy(frame, fine), refiner.energy(frame, coarse)


if __name__ == "__main__":
    main()
