"""Measurements of the stability report that run a solve: each takes a method's name and gives whether it held."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from cloth import FABRIC, GUIDE, Watched, base_of, frame_of, group_of, refiner_of, rms, sheet, solved, total, wave
from meshes import mesh_of
from sheets import garment_of, rotation
from test_forces_needles import needle_sheet
from test_jumps import JUMPS, jumping, still
from test_meshes import ALMOST_NOTHING, CORNERS, FAULTS, faulty, hung
from test_starts import ball, squeezed

from physgraph_usd.errors import SolveError
from physgraph_usd.lab.methods import METHODS
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.frame.problem import begin
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.integrate.base import Carry
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.guard import Guard
from physgraph_usd.solver.integrate.stop import Budget
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.rigid import best_motion
from physgraph_usd.solver.scene import GarmentFrame

EDGE = 0.05
LONG = {"steps": 200, "tolerance": 1e-6}
"""Enough that what is left is the method's own fault."""


class Result(NamedTuple):
    """What a case came to.

    Attributes:
        held: Whether it passed.
        figure: What was measured, in the words of the table.
    """

    held: bool
    figure: str


def under(value: float, most: float, unit: str = "") -> Result:
    """A figure that must not be over a bound; NaN is."""
    return Result(value <= most, f"{value:.2g}{unit}")


def s1_almost_nothing(method: str) -> Result:
    """Meshes of next to nothing whose result is not finite."""
    bad = 0
    for faces, count in ALMOST_NOTHING.values():
        mesh = mesh_of(faces, count)
        moved = CORNERS[: mesh.vertex_count] * [0.9, 1.0, 1.0]
        out = solved(mesh, CORNERS[: mesh.vertex_count], moved, level=1, integrator=method).points[0]
        isolated = np.setdiff1d(np.arange(mesh.vertex_count), mesh.indices)
        bad += not (np.isfinite(out).all() and np.array_equal(out[isolated], moved[isolated]))
    return Result(bad == 0, f"{bad} of {len(ALMOST_NOTHING)} bad")


def s2_faults(method: str) -> Result:
    """Largest change away from a fault, over the displacement of the clean sheet."""
    clean, rest = sheet(8, 6)
    good = solved(clean, rest, hung(rest), integrator=method, **LONG).points[0][: len(rest)]
    worst = 0.0
    for kind in FAULTS:
        mesh, worse, at, _ = faulty(kind)
        bad = solved(mesh, worse, hung(worse), integrator=method, **LONG).points[0][: len(rest)]
        away = np.setdiff1d(np.arange(len(rest)), at)
        worst = max(worst, np.linalg.norm(bad - good, axis=1)[away].max() / rms(good - hung(rest)))
    return under(100.0 * worst, 1.0, " %")


def s3_needles(method: str) -> Result:
    """Longest step on needles of aspect 1e4, in edges."""
    points, triangles = needle_sheet(1e4)
    mesh = PolygonMesh(np.full(len(triangles), 3), triangles.ravel(), len(points))
    group = group_of(mesh, points, level=0)
    systems, coarse = group.systems(
        [GarmentFrame(points * [0.95, 1.0, 1.0] + 0.01 * np.sin(20 * points), FABRIC, GUIDE)]
    )
    seen: list[Carry] = []
    solve_level(systems[-1], Watched(METHODS[method].build(), seen.append), coarse, level=0, budget=Budget(30))
    moves = [float((b.x - a.x).norm(dim=1).max()) for a, b in pairwise(seen)]
    finite = all(bool(carry.x.isfinite().all()) for carry in seen)
    return under(max(moves, default=0.0) / 0.1 if finite else math.nan, 1.0, " edges")


def s4_fins(method: str) -> Result:
    """Energy after over before on a sheet with a fin, a bow-tie and a face wound the other way."""
    mesh, rest = sheet(4, 3)
    count = len(rest)
    faces = mesh.indices.reshape(-1, 3).tolist()
    faces[3] = faces[3][::-1]
    more = np.vstack([rest, [[0.05, 0.05, 0.05], [0.3, 0.3, 0.0], [0.3, 0.35, 0.0]]])
    broken = mesh_of([*faces, [6, 7, count], [count - 1, count + 1, count + 2]])
    state = solved(broken, more, wave(more), integrator=method, level=1)
    finite = bool(np.isfinite(state.points[0]).all())
    return Result(finite and _ratio(state) <= 1.0, f"energy x {_ratio(state):.3g}")


def _ratio(state: Any) -> float:
    """Elastic and other energy after over before, gravity counted from the input's."""
    energy = state.telemetry[0]["energy_joules"]
    before, after = (sum(energy[which].values()) - energy["input"]["gravity"] for which in ("input", "output"))
    return after / before if before else 0.0


def s6_mirror(method: str) -> Result:
    """A mirrored sheet against the mirror image of the answer, in edges."""
    mesh, rest = sheet(6, 4)
    points, mirror = wave(rest, height=0.02), np.array([-1.0, 1.0, 1.0])
    one = solved(mesh, rest, points, level=2, integrator=method).points[0]
    other = replace(garment_of(mesh, rest * mirror), flipped=True)
    two = refiner_of([other], level=2, integrator=method).solve(frame_of(points * mirror)).points[0]
    return under(rms(one * mirror - two) / (EDGE / 4), 1e-5, " edges")


def s7_units(method: str) -> Result:
    """The same cloth at a hundredth of the size, scaled back, in edges."""
    mesh, rest = sheet(6, 4)
    points, scale = wave(rest), 0.01
    one = solved(mesh, rest, points, level=2, integrator=method).points[0]
    thickness = FABRIC.thickness * scale
    fabric = Fabric(FABRIC.stretch, FABRIC.bend * scale**2, FABRIC.density / scale, thickness)
    frame = frame_of(scale * points, fabric=fabric, guide=GUIDE / scale**2)
    two = refiner_of([garment_of(mesh, scale * rest)], level=2, integrator=method).solve(frame).points[0]
    return under(rms(two / scale - one) / (EDGE / 4), 1e-4, " edges")


def gap_of(method: str, *, level: int, fabric: Fabric = FABRIC) -> float:
    """(Phi - Phi*) / (Phi0 - Phi*) after `LONG`; Phi* is the least that any method here found."""
    mesh, rest = sheet(4, 3)
    runs = {
        name: solved(mesh, rest, wave(rest), level=level, fabric=fabric, integrator=name, **options).telemetry[0]
        for name, options in {method: LONG, "newton": {"steps": 60, "tolerance": 1e-7}}.items()
    }
    least = min(total(run, "output") for run in runs.values())
    before = total(runs[method], "input")
    return (total(runs[method], "output") - least) / (before - least)


def s8_stiffness(method: str) -> Result:
    """Worst gap over stiffnesses times 1e-3 to 1e3."""
    factors = (1e-3, 1e-1, 1e1, 1e3)
    gaps = [
        gap_of(method, level=1, fabric=Fabric(FABRIC.stretch * f, FABRIC.bend * f, FABRIC.density)) for f in factors
    ]
    return under(100.0 * max(gaps), 10.0, " % gap")


def s9_resolution(method: str) -> Result:
    """Worst gap over levels 0 to 3."""
    return under(100.0 * max(gap_of(method, level=level) for level in range(4)), 10.0, " % gap")


def s10_patch(method: str) -> Result:
    """A patch alone and in one garment with a hundred times its area: difference over displacement."""
    small, rest = sheet(6, 6)
    big, far = sheet(60, 60)
    shift = np.array([10.0, 0.0, 0.0])
    both = PolygonMesh(
        np.concatenate([small.counts, big.counts]),
        np.concatenate([small.indices, big.indices + len(rest)]),
        len(rest) + len(far),
    )
    options = {"level": 0, "integrator": method, **LONG}
    alone = solved(small, rest, hung(rest), **options).points[0]
    joined = solved(both, np.vstack([rest, far + shift]), np.vstack([hung(rest), hung(far) + shift]), **options)
    return under(100.0 * rms(joined.points[0][: len(rest)] - alone) / rms(alone - hung(rest)), 1.0, " %")


def s11_far_and_turned(method: str) -> Result:
    """Turned and carried 3e5 m away against here, float32, in edges."""
    mesh, rest = sheet(8, 6)
    points, turn, far = wave(rest), rotation(1), np.array([1e5, -2e5, 3e5])
    options = {"level": 2, "dtype": torch.float32, "steps": 6, "tolerance": 0.0, "integrator": method}
    here = solved(mesh, rest, points, **options).points[0]
    gravity = turn @ np.array([0.0, -9.81, 0.0])
    turned = refiner_of([garment_of(mesh, rest @ turn.T + far)], gravity=gravity, **options)
    there = turned.solve(frame_of(points @ turn.T + far)).points[0]
    return under(rms((there - far) @ turn - here) / (EDGE / 4), 2e-2, " edges")


def s12_forces(method: str) -> Result:
    """Move without any force, in edges; and whether weight times 1e6 stays finite, or is refused by the prim's name."""
    mesh, rest = sheet(8, 6)
    still = refiner_of([garment_of(mesh, rest)], level=2, gravity=np.zeros(3), integrator=method)
    moved = np.abs(still.solve(frame_of(rest, guide=0.0)).points[0] - base_of(mesh, rest, 2)).max() / (EDGE / 4)
    heavy = refiner_of([garment_of(mesh, rest)], level=2, gravity=np.array([0, -9.81e6, 0]), integrator=method)
    try:
        finite = bool(np.isfinite(heavy.solve(frame_of(rest)).points[0]).all())
    except SolveError as error:
        finite = "/World/Sheet" in str(error)
    return under(moved if finite else math.nan, 1e-5, " edges")


def s13_saddle(method: str) -> Result:
    """Stretch energy left of a flat sheet squeezed by a tenth, over that of the flat state."""
    state, _ = squeezed(0.1, integrator=method, steps=40)
    flat = 0.5 * 30.0 * 0.1**2 * 0.4 * 0.4 * 0.9
    return under(100.0 * state.telemetry[0]["energy_joules"]["output"]["stretch"] / flat, 50.0, " %")


def s15_crumpled(method: str) -> Result:
    """How many times the energy of a crumpled ball has fallen after 200 steps."""
    system, x = ball()
    _, report = solve_level(system, Guard(METHODS[method].build()), x, level=0, budget=Budget(200))
    factor = report.energy_before / report.energy_after
    return Result(factor >= 10.0, f"/ {factor:.3g}")


def s17_pins(method: str) -> Result:
    """Whether a pin, and all pins, keep their bits."""
    mesh, rest = sheet(6, 4)
    points, one = wave(rest), np.zeros(len(rest))
    one[9] = 1.0
    held = solved(mesh, rest, points, integrator=method, painted={"pin": one}).points[0][9]
    every = solved(mesh, rest, points, integrator=method, painted={"pin": np.ones(len(rest))}).points[0]
    kept = np.array_equal(held, points[9]) and np.array_equal(every[: len(rest)], points)
    return Result(kept, "to the bit" if kept else "moved")


def s29_teleport(method: str) -> Result:
    """A cage that jumps 2 m or turns by half: difference from cloth whose cage stays, in edges."""
    mesh, rest = sheet(8, 6)
    worst = 0.0
    for name in JUMPS:
        frames = jumping(name)
        options = {"level": 1, "times": tuple(range(1, 7)), "dtype": torch.float32, "integrator": method}
        there = list(refiner_of([garment_of(mesh, rest)], **options).refine(frames))[3].points[0]
        stays = [frame_of(still(time), float(time)) for time in range(1, 7)]
        here = list(refiner_of([garment_of(mesh, rest)], **options).refine(stays))[3].points[0]
        back = best_motion(JUMPS[name](still(4.0)), still(4.0))
        worst = max(worst, rms(back(there) - here) / EDGE)
    return under(worst, 1e-3, " edges")


def s33_precision(method: str) -> Result:
    """Single against double precision on the CPU after six steps, in edges."""
    mesh, rest = sheet(8, 6)
    options = {"level": 2, "steps": 6, "tolerance": 0.0, "integrator": method}
    one, two = (solved(mesh, rest, wave(rest), dtype=t, **options).points[0] for t in (torch.float32, torch.float64))
    return under(rms(one - two) / (EDGE / 4), 1e-4, " edges")


def s34_repeats(method: str) -> Result:
    """Different results among five runs and 1 to 4 threads."""
    mesh, rest = sheet(40, 40)
    options = {"level": 1, "dtype": torch.float32, "steps": 3, "integrator": method}
    runs = {
        solved(mesh, rest, wave(rest), threads=threads, **options).points[0].tobytes() for threads in (1, 1, 1, 2, 4)
    }
    return Result(len(runs) == 1, f"{len(runs)} result" + "s" * (len(runs) > 1))


def s35_frozen(method: str) -> Result:
    """Different results among a hundred equal frames."""
    mesh, rest = sheet(8, 6)
    refiner = refiner_of([garment_of(mesh, rest)], level=1, dtype=torch.float32, integrator=method)
    runs = {state.points[0].tobytes() for state in refiner.refine(frame_of(wave(rest), float(t)) for t in range(100))}
    return Result(len(runs) == 1, f"{len(runs)} result" + "s" * (len(runs) > 1))


def s36_drift(method: str) -> Result:
    """Ten passes over its own output: last change over the first; the energy must not rise."""
    mesh, rest = sheet(8, 6)
    group = group_of(mesh, rest, level=2, integrator=method, steps=12, tolerance=0.0)
    frame, state, outputs, energies = GarmentFrame(wave(rest), FABRIC, GUIDE), None, [], []
    for _ in range(11):
        state, telemetry = solve_frame(begin(group, [frame], state))
        outputs.append(state.points)
        energies.append(total(telemetry, "output"))
    changes = [rms(after - before) for before, after in pairwise(outputs)]
    risen = any(after > before + 1e-9 * abs(before) for before, after in pairwise(energies))
    ratio = changes[-1] / changes[0] if changes[0] else 0.0
    return Result(not risen and ratio < 1.0, f"change x {ratio:.2g}" + (", energy rises" if risen else ""))


def s37_guard(method: str) -> Result:
    """Steps that raise the energy among 25, guarded, from a squeezed sheet in single precision."""
    mesh, rest = sheet(6, 4)
    systems, coarse = group_of(mesh, rest, level=1, dtype=torch.float32).systems(
        [GarmentFrame(wave(rest), FABRIC, GUIDE)]
    )
    seen: list[Carry] = []
    base = group_of(mesh, rest, level=1, dtype=torch.float32).levels[-1].base.apply(coarse)
    guarded = Guard(METHODS[method].build())
    solve_level(systems[-1], Watched(guarded, seen.append), base, level=0, budget=Budget(25))
    rises = sum(after.energy > before.energy for before, after in pairwise(seen))
    return Result(rises == 0, f"{rises} rises")
