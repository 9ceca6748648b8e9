"""The paper's figure of forces put in one after another, and each of ours left out.

The shirt of the sample `armpit`, pinched between side and hanging arm: the upsampled input, then elastic forces and the
tie to the input alone, then with the body, then with cloth on itself and gravity; then everything but one. Every result
is judged by all forces. Crossings are edges through faces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch

from benchmarks.rows import Row
from benchmarks.shots import CORES, frames_of, opened, problem_of
from physgraph_usd.lab.chart.problem import COLD, Judgement, Problem, with_garments
from physgraph_usd.usd.read.reader import Shot

SAMPLE, TIME = "armpit", 15.0
LEVEL = {True: 1, False: 2}
"""Subdivisions, by whether the form is the short one."""


@dataclass(frozen=True)
class Forces:
    """Which forces a solve has besides springs and guide."""

    bending: bool = True
    gravity: bool = True
    body: bool = True
    cloth: bool = True


STEPS = {
    "stretch and bending": Forces(gravity=False, body=False, cloth=False),
    "with the body": Forces(gravity=False, cloth=False),
    "with itself and gravity: all": Forces(),
}
"""The paper's order."""
WITHOUT = {
    "all but bending": Forces(bending=False),
    "all but gravity": Forces(gravity=False),
    "all but the body": Forces(body=False),
    "all but self contact": Forces(cloth=False),
}


def measure(short: bool) -> list[Row]:
    """The rows."""
    shot = opened(SAMPLE, LEVEL[short])
    judge = problem_of(shot, torch.float64)
    [frame] = frames_of(shot, [TIME])
    found = {"input, upsampled": judge.judge(frame, judge.upsampled(frame, smooth=False))}
    found |= {name: judge.judge(frame, solved(shot, forces)) for name, forces in (STEPS | WITHOUT).items()}
    order = ["input, upsampled", *STEPS]
    counts = [crossing(found[name]) for name in order]
    every = found[order[-1]]
    rows = [
        Row(
            "crossings: input, elastic, with the body, all",
            ", ".join(map(str, counts)),
            "fewer each time",
            "falls from elastic on",
            all(b <= a for a, b in pairwise(counts[1:])) and counts[-1] < counts[0],
        ),
        Row("crossings that are left with all forces", f"{counts[-1]}", "none seen", "0", counts[-1] == 0),
    ]
    for name in WITHOUT:
        rise = 1e3 * (found[name].energy - every.energy)
        rows.append(
            Row(f"{name}: energy more than with all", f"{rise:.3g} mJ", "-", "above 0", bool(rise > 0.0)),
        )
    return rows


def crossing(found: Judgement) -> int:
    """Crossings of cloth with cloth and with bodies."""
    return found.tangles + found.crossings


def solved(shot: Shot, forces: Forces) -> tuple[np.ndarray, ...]:
    """Fine positions [m] with some forces."""
    scene = shot.scene if forces.gravity else replace(shot.scene, gravity=np.zeros(3))
    [frame] = frames_of(shot, [TIME])
    if not forces.bending:
        frame = with_garments(frame, lambda each: replace(each, fabric=replace(each.fabric, bend=0.0)))
    contact = replace(
        COLD.contact,
        form=COLD.contact.form if forces.body else "off",
        cloth=COLD.contact.cloth if forces.cloth else "off",
    )
    problem = Problem(scene, [garment.level for garment in scene.garments], device="cpu", threads=CORES)
    return problem.solve(frame, replace(COLD, contact=contact)).points
