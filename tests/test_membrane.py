"""The triangle membrane: when it takes over, what it keeps, and how it sits beside edge springs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from energies import evaluate
from meshes import grid
from sheets import equilateral, garment_of, level_of
from test_forces import crumple

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.forces.membrane import Membrane, in_plane_terms
from physgraph_usd.solver.forces.stretch import Stretch
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.frame.values import FrameInput
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.solver.mesh.elements import QUAD_SPRING
from physgraph_usd.solver.scene import GarmentFrame

SPRINGS, TRIANGLES = Fabric(30.0), Fabric(30.0, shear=7.0)


def pair() -> Level:
    """Two garments of quads and triangles side by side, refined once."""
    mesh, points = grid(4, 3, "mixed")
    garments = [garment_of(mesh, 0.1 * points), garment_of(mesh, 0.1 * points + [1.0, 0.0, 0.0])]
    return build_levels(garments, refine_garments(garments, [1, 1]), dtype=torch.float64)[-1]


@pytest.mark.parametrize(
    ("fabrics", "kinds"),
    [
        ((SPRINGS, SPRINGS), (Stretch,)),
        ((TRIANGLES, TRIANGLES), (Membrane,)),
        ((SPRINGS, TRIANGLES), (Stretch, Membrane)),
        ((TRIANGLES, SPRINGS), (Stretch, Membrane)),
        ((Fabric(30.0, shear=0.0), SPRINGS), (Stretch, Membrane)),
    ],
)
def test_each_garment_has_the_term_its_fabric_asks_for(fabrics: tuple[Fabric, Fabric], kinds: tuple[type, ...]):
    level = pair()
    x = crumple(level.rest.numpy(), 0.005, 1)
    terms = in_plane_terms(level, fabrics)
    assert tuple(type(term) for term in terms) == kinds
    found = sum((evaluate(term, x)[1] for term in terms), torch.zeros_like(x))
    for span, fabric in zip(level.spans, fabrics, strict=True):
        alone = in_plane_terms(level, (fabric, fabric))
        assert len(alone) == 1
        assert torch.allclose(found[span], evaluate(alone[0], x)[1][span], rtol=1e-12, atol=1e-15)


def test_small_strains_of_an_isotropic_membrane_are_those_of_springs():
    points, triangles = equilateral(0.5, 0.4, 0.1)
    level = level_of(points, triangles)
    springs = in_plane_terms(level, [Fabric(30.0)])[0]
    membrane = in_plane_terms(level, [Fabric(30.0, shear=0.375 * 30.0)])[0]
    strain = torch.eye(3, dtype=torch.float64) + 1e-6 * torch.as_tensor(np.random.default_rng(1).normal(size=(3, 3)))
    small = level.rest @ strain
    assert evaluate(membrane, small)[0] == pytest.approx(evaluate(springs, small)[0], rel=1e-4)


def test_without_stiffness_in_shear_a_sheared_sheet_is_free():
    """A shear along the rest frame's axes costs the second order only."""
    mesh, points = grid(3, 2, "triangles")
    level = level_of(points, mesh.indices.reshape(-1, 3))
    membrane = in_plane_terms(level, [Fabric(30.0, shear=0.0)])[0]
    costs = []
    for angle in (1e-2, 1e-3):
        sheared = points.copy()
        sheared[:, 0] += angle * points[:, 1]
        costs.append(evaluate(membrane, torch.as_tensor(sheared))[0])
    assert costs[0] / costs[1] == pytest.approx(1e4, rel=1e-3)


def test_painted_scale_multiplies_the_triangles():
    points, triangles = equilateral(0.5, 0.4, 0.1)
    plain = level_of(points, triangles)
    painted = level_of(points, triangles, stretch_scale=np.full(len(points), 2.5))
    x = crumple(points, 0.01, 3)
    energies = [evaluate(in_plane_terms(level, [TRIANGLES])[0], x)[0] for level in (plain, painted)]
    assert energies[1] == pytest.approx(2.5 * energies[0])


def test_springs_of_quads_stand_for_the_mean_of_both_splits():
    """A grid of a square of two triangles, which share the side 1-4 with a square of one quad."""
    mesh, points = grid(2, 1, "mixed")
    level = build_levels([garment_of(mesh, points)], [()], dtype=torch.float64)[0]
    areas = dict(zip(map(tuple, level.springs.tolist()), level.spring_area.tolist(), strict=True))
    side, diagonal = QUAD_SPRING
    assert len(areas) == 10
    assert areas[0, 4] == pytest.approx(1.0 / 3.0)
    assert areas[1, 4] == pytest.approx((0.5 + 0.5 * side) / 3.0)
    assert areas[1, 2] == pytest.approx(0.5 * side / 3.0)
    assert areas[1, 5] == areas[2, 4] == pytest.approx(0.5 * diagonal / 3.0)
    assert float(level.spring_area.sum()) == pytest.approx(2.0)
    assert float(level.membrane_area.sum()) == pytest.approx(2.0)
    assert len(level.triangles) == 4
    assert len(level.membrane) == 6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_mixed_group_is_what_its_garments_are_alone(dtype: torch.dtype):
    """Pulled, so that there is one rest state."""
    mesh, points = grid(6, 6)
    points = 0.03 * points
    bump = 0.01 * np.sin(20 * points[:, 1])
    pulled = points * [1.15, 1.02, 1.0] + np.stack([0 * bump, 0 * bump, bump], axis=1)
    frames = [GarmentFrame(pulled, SPRINGS), GarmentFrame(pulled + np.array([1.0, 0, 0]), TRIANGLES)]
    settings = SolveSettings(method_named("quasi-newton"), steps=100, tolerance=1e-5)

    def solve(chosen: list[GarmentFrame]) -> tuple[list[np.ndarray], dict[str, float]]:
        garments = [garment_of(mesh, points) for _ in chosen]
        refinements = refine_garments(garments, [1] * len(garments))
        group = Group.of(garments, refinements, np.array([0, 0, -9.81]), settings, dtype=dtype, device="cpu")
        solved = solve_frame(group, FrameInput(chosen), None)
        shapes, energies = solved.points, solved.telemetry["energy_joules"]
        assert isinstance(energies, dict)
        return shapes, energies["output"]

    together, energies = solve(frames)
    assert {"stretch", "membrane"} <= set(energies)
    for shape, frame, term, other in zip(
        together, frames, ("stretch", "membrane"), ("membrane", "stretch"), strict=True
    ):
        alone, energy = solve([frame])
        assert energy[term] == pytest.approx(energies[term], rel=1e-3)
        assert other not in energy
        assert np.abs(shape - alone[0]).max() < 0.01 * 0.015


@pytest.mark.parametrize("shear", [None, 5.0])
def test_the_report_says_which_garments_are_membranes(sample: Callable[[str], Path], shear: float | None):
    overrides = () if shear is None else (f"physgraph:material:shearStiffness={shear}",)
    report = inspect_shot(sample("tshirt"), overrides=overrides)
    path = report["garments"][0]["path"]
    if shear is None:
        assert report["modelled"]["stretch"] == "edge springs"
        assert "membrane" not in report["modelled"]
        assert "0.375 Y" in report["left_out"]["triangle membrane"]
    else:
        assert report["modelled"]["membrane"] == f"triangle membrane for {path}"
        assert "stretch" not in report["modelled"]
        assert not {"shear", "triangle membrane"} & set(report["left_out"])
