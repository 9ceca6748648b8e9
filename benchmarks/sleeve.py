"""Speed and accuracy of one frame: the sleeve at about 26,000 fine vertices.

    python -m benchmarks.sleeve

Prints the gap (Phi - Phi*) / (Phi0 - Phi*) of nested quasi-Newton against milliseconds, on the wall and of processor
time, of all threads together, which other work on the machine lengthens less; force evaluation against torch autograd;
and the whole frame's time, reading and writing included, against its solver time. Times are medians of one run; compare
them as ratios. Phi* is that of `physgraph_usd.lab.chart.reference`, as in every benchmark.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from pathlib import Path

import torch

from benchmarks.rows import say
from benchmarks.unseen import reference_of
from physgraph_usd.lab.chart.reference import Reference
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.solve import Budget, solve_level
from physgraph_usd.solver.level import Level, refine_garments
from physgraph_usd.usd.read.reader import open_shot

REPEATS = 5
CORES = os.cpu_count() or 1
SCHEDULES = (
    (5, 5, 5),
    (10, 10, 5),
    (20, 20, 4),
    (40, 10, 4),
    (40, 20, 6),
    (20, 40, 6),
    (20, 60, 6),
    (20, 80, 8),
    (20, 100, 10),
    (48, 48, 12),
    (20, 160, 16),
)


def main() -> None:
    """Print the tables."""
    prepare_device("cpu")
    with tempfile.TemporaryDirectory() as folder:
        shot_path = write_sample("sleeve", Path(folder))
        shot = open_shot(str(shot_path))
        frame = shot.frame(shot.scene.times[-1]).garments
        refinements = refine_garments(shot.scene.garments, [g.level for g in shot.scene.garments])
        settings = SolveSettings(method_named("quasi-newton"))
        single = Group.of(
            shot.scene.garments,
            refinements,
            shot.scene.gravity,
            settings,
            dtype=torch.float32,
            device="cpu",
            threads=CORES,
        )
        finest = single.levels[-1]
        say(f"sleeve, last frame: {finest.vertex_count} fine vertices, {len(finest.edges)} edges")
        known = reference_of(shot.scene.garments[0], shot.scene.gravity, frame[0], level=shot.scene.garments[0].level)
        front = schedule_table(single, frame, known)
        say_ratio(front)
        evaluation_table(single, frame)
        frame_table(shot_path, Path(folder))


def descend(group: Group, frame, steps) -> tuple[float, float, float]:
    """Solve a frame through all levels; returns its energy [J], seconds and those of processor time."""
    systems, coarse = group.systems(frame)
    began, worked = time.perf_counter(), time.process_time()
    x = group.levels[0].base.apply(coarse)
    energy = 0.0
    for level, system, count in zip(group.levels, systems, steps, strict=True):
        x = x if level.from_below is None else level.from_below.apply(x)
        x, report = solve_level(system, QuasiNewton(), x, level=level.index, budget=Budget(count))
        energy = report.energy_after
    return energy, time.perf_counter() - began, time.process_time() - worked


def schedule_table(group: Group, frame, known: Reference) -> list[tuple[float, float]]:
    """Print gap against time; returns (gap, seconds of processor time) for each schedule."""
    runs = {steps: [descend(group, frame, steps) for _ in range(REPEATS)] for steps in SCHEDULES}
    for steps, made in runs.items():
        known = known.lowered({"all": made[0][0]}, f"quasi-Newton, {steps} steps")
    say(f"Phi0 {1e3 * known.start:.5g} mJ, {known}")
    say("\n| steps per level | gap | ms | of processor time |\n|---|---|---|---|")
    front = []
    for steps, made in runs.items():
        gap, seconds, worked = known.gap(made[0][0]), *(statistics.median(run[k] for run in made) for k in (1, 2))
        say(f"| {steps} | {gap:.2%} | {1e3 * seconds:.0f} | {1e3 * worked:.0f} |")
        front.append((gap, worked))
    return front


def say_ratio(front: list[tuple[float, float]]) -> None:
    """Print the time to a gap of 1% over the time to 3%."""
    times = {bound: min((s for gap, s in front if gap <= bound), default=float("nan")) for bound in (0.03, 0.01)}
    say(f"\ntime to 1% / time to 3%: {times[0.01] / times[0.03]:.2f}")


def evaluation_table(group: Group, frame) -> None:
    """Print the time of one force and energy evaluation against torch autograd of the same energy."""
    systems, coarse = group.systems(frame)
    level = group.levels[-1]
    x = level.base.apply(coarse)
    whole_module = group.modules(frame)[0][-1]
    elastic = ForceModule([term for term in whole_module.forces if term.name in {"stretch", "bending"}])
    ours, whole = (median_seconds(lambda f=f: f(x)) for f in (elastic.energy_and_force, systems[-1].energy_and_force))
    torch.set_num_threads(CORES)
    theirs = median_seconds(lambda: autograd_evaluation(level, x))
    torch.set_num_threads(1)
    say(f"energy and force of all terms {1e3 * whole:.2f} ms; of stretch and bending {1e3 * ours:.2f} ms,")
    say(f"by torch autograd {1e3 * theirs:.2f} ms, both on {CORES} cores; ratio {theirs / ours:.1f}")


def autograd_evaluation(level: Level, x: torch.Tensor) -> torch.Tensor:
    """Stretch and bending of jersey in plain torch, their force by reverse mode."""
    x = x.detach().requires_grad_()
    ends, hinge = level.springs.long(), level.hinges.long()
    length = (x[ends[:, 1]] - x[ends[:, 0]]).norm(dim=1)
    stiffness = 90.0 * level.spring_area / level.spring_length**2
    stretch = 0.5 * (stiffness * (length - level.spring_length) ** 2).sum()
    i, j = (x[hinge[:, corner]] for corner in (0, 1))
    k, ell = (x[hinge[:, corners]].mean(dim=1) for corners in ([2, 3], [4, 5]))
    n1, n2 = torch.linalg.cross(j - i, k - i), torch.linalg.cross(ell - i, j - i)
    sine = (torch.linalg.cross(n1, n2) * (j - i)).sum(dim=1) / (j - i).norm(dim=1)
    angle = torch.atan2(sine, (n1 * n2).sum(dim=1))
    bending = 0.5 * (4.7e-6 * level.hinge_shape * (angle - level.rest_angle) ** 2).sum()
    return torch.autograd.grad(stretch + bending, x)[0]


def frame_table(shot: Path, folder: Path) -> None:
    """Print the whole frame's time over its solver time, in one process."""
    report = refine_shot(shot, folder / "out.usdc", RefineOptions(temporal="off"))
    solve = sum(garment["milliseconds"]["solve"] for f in report.frames[1:] for garment in f["garments"])
    first = report.frames[0]["garments"][0]["milliseconds"]
    frames = 1e3 * report.seconds["frames"] - sum(first.values())
    say(f"\n{len(report.frames)} frames: {frames:.0f} ms of which {solve:.0f} ms solving (the first frame left out)")
    say(f"frame / solver: {frames / solve:.2f}; peak memory {report.peak_memory_mb:.0f} MB")


def median_seconds(call, repeats: int = 30) -> float:
    """Median wall time of a call after a warm-up."""
    call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


if __name__ == "__main__":
    main()
