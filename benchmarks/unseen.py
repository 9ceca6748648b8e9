"""Garments that no network was trained on, the energies between which they move, and descents through their levels."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physgraph_usd.lab.chart.problem import ALONE, Problem
from physgraph_usd.lab.chart.reference import Reference, find_reference
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.integrate.base import Integrator, System
from physgraph_usd.solver.integrate.saddle import leave_saddle
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Scene
from physgraph_usd.usd.read.reader import open_shot

SHOTS: dict[str, tuple[str, float | None]] = {
    "sleeve": ("", None),
    "tshirt": ("", None),
    "flag": ("", 12.0),
    "skirt": ("", None),
    "swatch": ("", None),
    "01_newton_shirt_dab_cm.usdc": ("/shot/char/shirt_geo", 1030.0),
    "02_makehuman_usdskel_dm.usdc": ("/shot/char/shorts", 30.0),
    "06_torus_pull.usda": ("/shot/cloth", 30.0),
    "09_cesiumman_kilt/shot.usda": ("/shot/kilt", 24.0),
    "10_style3d_skirt_twist.usdc": ("/shot/skirt", 10.0),
}
"""Samples and, where the folder of real assets is there, shots: garment and time code (None: the last)."""
FABRICS = ("jersey", "denim", "silk")
LEVEL = 2
THREADS = os.cpu_count() or 1


@dataclass(eq=False)
class Case:
    """One garment in one frame and one fabric.

    Attributes:
        name: Shot and fabric.
        group: Its levels, float32.
        frame: Its pose and fabric.
        systems: One a level.
        coarse: Recentred cage [m].
        reference: The least energy known.
    """

    name: str
    group: Group
    frame: GarmentFrame
    systems: list[System]
    coarse: torch.Tensor
    reference: Reference


def cases(
    *,
    shots: Sequence[str] = tuple(SHOTS),
    fabrics: Sequence[str] = FABRICS,
    device: str = "cpu",
    cache: Path | None = None,
    level: int = LEVEL,
    short: bool = False,
) -> Iterator[Case]:
    """Cases one after another; real shots are left out where they are not there.

    Args:
        shots: Names out of `SHOTS`.
        fabrics: Presets.
        device: "cpu" or "cuda".
        cache: JSON file that keeps the least energies, or None.
        level: Subdivisions.
        short: Whether the least energies are looked for from fewer starts.
    """
    known: dict[str, Any] = json.loads(cache.read_text()) if cache and cache.exists() else {}
    for name in shots:
        opened = opened_garment(name)
        if opened is None:
            continue
        garment, gravity, points = opened
        for fabric in fabrics:
            frame = replace(points, fabric=PRESETS[fabric])
            label = f"{name.partition('/')[0].partition('.')[0]}, {fabric}"
            group = plain_group(garment, gravity, torch.float32, level=level, device=device)
            key = f"{label}, level {level}{', short' if short else ''}"
            if not isinstance(known.get(key), dict):
                known[key] = reference_of(garment, gravity, frame, level=level, device=device, short=short).plain()
                if cache:
                    cache.write_text(json.dumps(known, indent=1))
            systems, coarse = group.systems([frame])
            yield Case(label, group, frame, systems, coarse, Reference.of(known[key]))


def reference_of(
    garment: Garment, gravity: np.ndarray, frame: GarmentFrame, *, level: int, device: str = "cpu", short: bool = False
) -> Reference:
    """The least energy known of a garment that touches nothing, in one frame."""
    scene = Scene((garment,), gravity, ())
    problem = Problem(scene, [level], device=device, threads=THREADS, dtype=torch.float64)
    return find_reference(problem, Frame(None, (frame,)), settings=ALONE, short=short)


@dataclass(frozen=True)
class Descent:
    """What a descent came to.

    Attributes:
        energy: [J].
        milliseconds: Time of the steps: wall time on CUDA; on the CPU that of all threads together, which other work on
            the machine does not lengthen.
        movers: Steps by who made them.
    """

    energy: float
    milliseconds: float
    movers: dict[str, int]


def descend(
    group: Group, systems: Sequence[System], coarse: torch.Tensor, integrator: Integrator, *, steps: Sequence[int]
) -> Descent:
    """Walk the levels with so many force evaluations at each, the one at its start not counted.

    The upsampled cage is taken off its saddle first, as the solver does it; that is not counted either.
    """
    x = group.levels[-len(steps)].base.apply(coarse)
    energy, spent = math.inf, 0.0
    movers: dict[str, int] = {}
    clock = time.perf_counter if x.is_cuda else time.process_time
    for level, system, count in zip(group.levels[-len(steps) :], systems[-len(steps) :], steps, strict=True):
        x = x if level.from_below is None or x.shape[0] == level.vertex_count else level.from_below.apply(x)
        x = leave_saddle(system, level, x, outward=torch.ones(1, device=x.device))
        before, began = system.evaluations, clock()
        carry = integrator.start(system, x)
        while system.evaluations - before <= count and carry.mover != "stayed":
            carry = integrator.step(system, carry)
            movers[carry.mover] = movers.get(carry.mover, 0) + 1
        if x.is_cuda:
            torch.cuda.synchronize()
        spent += clock() - began
        x, energy = carry.x, carry.energy
    return Descent(energy, 1e3 * spent, movers)


def opened_garment(name: str) -> tuple[Garment, np.ndarray, GarmentFrame] | None:
    """Garment, gravity and frame of a shot, or None where it is not there."""
    prim, time_code = SHOTS[name]
    with tempfile.TemporaryDirectory() as folder:
        if prim:
            data = Path(os.environ.get("PHYSGRAPH_DATA", "../shared/data")) / "shots" / name
            if not data.exists():
                return None
            shot = open_shot(str(data), garments=[prim])
        else:
            shot = open_shot(str(write_sample(name, Path(folder))))
        frame = shot.frame(time_code if time_code is not None else shot.scene.times[-1])
        garment = shot.scene.garments[0]
        return replace(garment, colliders=()), shot.scene.gravity, frame.garments[0]


def plain_group(garment: Garment, gravity: np.ndarray, dtype: torch.dtype, *, level: int, device: str) -> Group:
    """One garment's levels, without contact."""
    settings = SolveSettings(method_named("quasi-newton"))
    chains = refine_garments([garment], [level])
    return Group.of([garment], chains, gravity, settings, dtype=dtype, device=device, threads=THREADS)
