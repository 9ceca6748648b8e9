"""CUDA: the same kernels give the CPU's answer, and the same bits each time (S33, S34)."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from cloth import frame_of, settings_of, sheet, wave
from folds import sewn
from pxr import Usd
from sheets import garment_of

from physgraph_usd.cli import main
from physgraph_usd.lab.methods.paper_network import PaperConfig, has_triton
from physgraph_usd.lab.methods.paper_steps import LearnedPaper
from physgraph_usd.lab.methods.random_networks import random_network
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.problem import begin
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.integrate import METHODS
from physgraph_usd.solver.integrate.ahead import STEPS_AHEAD
from physgraph_usd.solver.integrate.base import Carry
from physgraph_usd.solver.integrate.descend import LevelReport, descend
from physgraph_usd.solver.integrate.stop import SEEN_STEPS, Budget
from physgraph_usd.solver.integrate.weights import shipped_network
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import GarmentFrame

EDGE = 0.02

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


def cloth(device: str, dtype: torch.dtype, **options: Any) -> tuple[Group, list[GarmentFrame]]:
    """A waved sheet at level 2."""
    mesh, rest = sheet(8, 8, EDGE)
    garments = [garment_of(mesh, rest)]
    chains = refine_garments(garments, [2])
    down = np.array([0.0, 0.0, -9.81])
    one = Group.of(garments, chains, down, settings_of(**options), dtype=dtype, device=device)
    return one, list(frame_of(wave(rest, height=0.005, squeeze=0.02)).garments)


@pytest.mark.parametrize(("dtype", "most"), [(torch.float64, 1e-13), (torch.float32, 2e-6)])
def test_forces_energies_and_metrics_agree(dtype: torch.dtype, most: float) -> None:
    """Forces within rounding of stiffness times edge length: that is what their differences of lengths lose."""
    answers = []
    scale = 0.0
    for device in ("cpu", "cuda"):
        one, frames = cloth(device, dtype)
        systems, coarse = one.systems(frames)
        x = one.levels[-1].base.apply(coarse)
        energy, force = systems[-1].energy_and_force(x)
        again = systems[-1].energy_and_force(x)[1]
        assert torch.equal(force, again)
        move = systems[-1].apply_metric_inverse(force)
        scale = float((systems[-1].diagonal(x) * one.levels[-1].spacing).max())
        answers.append((energy, force.cpu().double().numpy(), move.cpu().double().numpy()))
    (energy, force, move), (other_energy, other_force, other_move) = answers
    assert other_energy == pytest.approx(energy, rel=100 * most)
    assert np.abs(other_force - force).max() < most * scale
    assert np.abs(other_move - move).max() < most * EDGE


def test_s33_a_solved_frame_agrees_and_repeats() -> None:
    answers = []
    for device in ("cpu", "cuda", "cuda"):
        one, frames = cloth(device, torch.float64, steps=60, tolerance=1e-7)
        answers.append(solve_frame(begin(one, frames))[0].points)
    here, there, again = answers
    assert there.tobytes() == again.tobytes()
    assert np.abs(here - there).max() < 1e-3 * EDGE / 4


@pytest.mark.parametrize("latent", [32, 128])
def test_the_papers_step_is_the_same_by_its_kernel(latent: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Triton's kernel against the layers in torch: a thousandth of the displacement, for its factors have 10 bits."""
    if not has_triton():
        pytest.skip("no Triton")
    one, frames = cloth("cuda", torch.float32)
    systems, coarse = one.systems(frames)
    system, x = systems[-1], one.levels[-1].base.apply(coarse)
    paper = LearnedPaper(shipped_network("physgraph-paper"))
    if latent != PaperConfig().latent:
        paper = LearnedPaper(random_network(PaperConfig(latent), seed=3, scale=0.3))
    carry = paper.start(system, x)
    fused, again = paper.propose(system, carry), paper.propose(system, carry)
    monkeypatch.setattr("physgraph_usd.lab.methods.paper_network.has_triton", lambda: False)
    plain = paper.propose(system, carry)
    assert torch.equal(fused, again)
    assert 0.0 < float((fused - plain).norm()) < 3e-3 * float(plain.norm())


def test_sewn_cloth_agrees_and_repeats() -> None:
    """A box of faces that only its seams hold together, pressed."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    points, mesh = (
        0.05 * np.concatenate([corner[list(side)] for side in sides]),
        PolygonMesh(np.full(6, 4), np.arange(24), 24),
    )
    garments, frames = sewn([garment_of(mesh, points)], points), frame_of(points * [0.95, 0.9, 1.0]).garments
    chains, down, answers = refine_garments(garments, [4]), np.array([0.0, -9.81, 0.0]), []
    for device in ("cpu", "cuda", "cuda"):
        settings = settings_of(steps=60, tolerance=1e-6)
        one = Group.of(garments, chains, down, settings, dtype=torch.float32, device=device)
        answers.append(solve_frame(begin(one, frames))[0])
    assert not any(answer.crossing.any() for answer in answers)
    assert np.abs(answers[1].points - answers[0].points).max() < 1e-3 * 0.05
    assert np.array_equal(answers[1].points, answers[2].points)
    pairs = np.argwhere(np.triu(np.linalg.norm(points[:, None] - points, axis=2) < 1e-9, 1))
    assert np.array_equal(answers[1].points[pairs[:, 0]], answers[1].points[pairs[:, 1]])


def descended(budget: Budget) -> tuple[Carry, LevelReport]:
    """A descent of the waved sheet by the learned method on the card."""
    one, frames = cloth("cuda", torch.float32)
    systems, coarse = one.systems(frames)
    x = one.levels[-1].base.apply(coarse)
    return descend(systems[-1], METHODS["physgraph"].build(), x, level=0, budget=budget)


@pytest.mark.parametrize("budget", [Budget(22), Budget(60, 1e-2), Budget(60, warm=True)])
def test_steps_ahead_are_those_made_one_at_a_time(budget: Budget, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = []
    for most in (1, 2, SEEN_STEPS):
        monkeypatch.setitem(STEPS_AHEAD, "cuda", most)
        carry, report = descended(budget)
        answers.append((carry.x.cpu().numpy().tobytes(), carry.energy, vars(report) | {"milliseconds": 0.0}))
    assert answers[0] == answers[1] == answers[2]


@pytest.mark.parametrize(("warm", "more"), [(False, 3), (True, 9)])
def test_a_descent_waits_once_for_several_steps(warm: bool, more: int) -> None:
    """Further waits: for the start's energy and for whether its and the end's positions are finite, and for motion."""
    steps = 6 * SEEN_STEPS
    one, frames = cloth("cuda", torch.float32)
    systems, coarse = one.systems(frames)
    system, x, integrator = systems[-1], one.levels[-1].base.apply(coarse), METHODS["physgraph"].build()
    for _ in range(2):  # What is kept is made, and what is recorded is recorded.
        descend(system, integrator, x, level=0, budget=Budget(steps, warm=warm))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")  # Warns that it is a prototype, too.
        try:
            _, report = descend(system, integrator, x, level=0, budget=Budget(steps, warm=warm))
        finally:
            torch.cuda.set_sync_debug_mode("default")
    waits = [warning for warning in caught if "called a synchronizing" in str(warning.message)]
    assert report.movers == {"physgraph": report.steps}
    assert 0 < len(waits) <= report.steps // SEEN_STEPS + more, [str(wait.message) for wait in waits]


@pytest.mark.parametrize("integrator", ["quasi-newton", "physgraph"])
@pytest.mark.parametrize("sample", ["block", "layers", "crossing", "sleeve"])
def test_samples_are_refined_alike(tmp_path: Path, sample: str, integrator: str) -> None:
    """Contact, cloth on itself and several garments; twice the same bytes, and the CPU's shape.

    Layers and crossing cloth do not settle: jitters of 1e-7 m differ as much there as two processors.
    """
    stage = write_sample(sample, tmp_path)
    points = {}
    for name, device in (("cpu", "cpu"), ("cuda", "cuda"), ("again", "cuda")):
        out = tmp_path / f"{name}.usda"
        options = ["--device", device, "--integrator", integrator, "--frames", "1:2", "--level", "1"]
        result = CliRunner().invoke(main, ["refine", str(stage), "-o", str(out), *options])
        assert result.exit_code == 0, result.output
        points[name] = points_of(out)
    assert points["cuda"].keys() == points["cpu"].keys()
    for path, found in points["cuda"].items():
        assert found.tobytes() == points["again"][path].tobytes()
        size = np.ptp(points["cpu"][path], axis=(0, 1)).max()
        apart = np.median(np.linalg.norm(found - points["cpu"][path], axis=-1))
        assert apart < 2e-3 * size or sample in ("layers", "crossing")


def points_of(layer: Path) -> dict[str, np.ndarray]:
    """Points at every time sample of all that the layer has some of, by path; it holds overs alone."""
    stage = Usd.Stage.Open(str(layer))
    found = {}
    for prim in stage.TraverseAll():
        points = prim.GetAttribute("points")
        if points and (times := points.GetTimeSamples()):
            found[str(prim.GetPath())] = np.array([points.Get(t) for t in times], dtype=np.float64)
    assert found
    return found
