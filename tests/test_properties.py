"""What holds for every shot: random meshes, fabrics, time samplings and stage conventions, refined end to end.

Cloth does not feel itself here: faces thrown together cross each other, and drawing them apart may cost energy.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from cloth import frame_of, refiner_of
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from layers import errors, open_over, world_metres
from meshes import any_mesh, faces_of, planar_mesh
from pxr import Sdf, UsdGeom
from sheets import garment_of, rotation
from stages import add_mesh, affine, author, new_stage, save, set_matrix, vec3

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.mesh.subdivide import subdivide, subdivide_times
from physgraph_usd.solver.mesh.topology import PolygonMesh

CLOTH = "/World/cloth"
EDGE = 0.05
FEW = settings(
    max_examples=5,
    phases=(Phase.explicit, Phase.generate),  # each example is a run: making it smaller would take minutes
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)


@dataclass(frozen=True)
class Sheet:
    """Cloth in metres, Y up, seen from where its faces run counter-clockwise."""

    mesh: PolygonMesh
    rest: np.ndarray
    moving: dict[float, np.ndarray]
    fabric: dict[str, float]


@dataclass(frozen=True)
class Convention:
    """How a stage writes lengths, axes and winding down."""

    metres: float = 1.0
    up: str = "Y"
    left_handed: bool = False
    parent_scale: float = 1.0
    rate: float = 24.0


@st.composite
def fabrics(draw: st.DrawFn) -> dict[str, float]:
    """Stiffnesses and weights over several powers of ten."""
    powers = {"stretchStiffness": (0, 3), "bendStiffness": (-7, -3), "density": (-2, 0)}
    return {name: 10.0 ** draw(st.integers(low, high)) for name, (low, high) in powers.items()}


@st.composite
def time_codes(draw: st.DrawFn) -> tuple[float, ...]:
    """One to four sample times, some of them between frames, or none."""
    steps = draw(st.lists(st.sampled_from([0.25, 1.0, 1.0 / 3.0, 5.0]), max_size=4))
    first = draw(st.sampled_from([-2.0, 0.0, 1001.0]))
    return tuple((first + np.cumsum(steps)).tolist())


@st.composite
def sheets(draw: st.DrawFn, *, planar: bool | None = None, times: tuple[float, ...] | None = None) -> Sheet:
    """Planar grids of triangles, quads and hexagons, or faces thrown together without any order."""
    if draw(st.booleans()) if planar is None else planar:
        mesh, points = draw(planar_mesh())
    else:
        mesh = draw(any_mesh(duplicates=False))
        points = np.random.default_rng(draw(st.integers(0, 2**16))).uniform(0, 3, (mesh.vertex_count, 3))
    assume(len(mesh.counts))
    rest = EDGE * points
    chosen = draw(time_codes()) if times is None else times
    squeeze, phase = draw(st.sampled_from([0.8, 0.95, 1.05])), draw(st.floats(0, 3))
    moving = {
        time: rest * [squeeze, 1.0, 1.0]
        + 0.2 * EDGE * np.sin(40.0 * rest[:, :1] + phase + index) * np.array([0.0, 0.0, 1.0])
        for index, time in enumerate(chosen)
    }
    return Sheet(mesh, rest, moving, draw(fabrics()))


def write(sheet: Sheet, path: Path, how: Convention) -> Path:
    stage = new_stage(path, metres=how.metres, up=how.up, rate=how.rate)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) if how.up == "Z" else np.eye(3)
    faces = faces_of(sheet.mesh)
    if how.left_handed:
        faces = [[face[0], *face[:0:-1]] for face in faces]
    mesh = add_mesh(stage, CLOTH, sheet.rest @ turn.T / (how.metres * how.parent_scale), faces)
    set_matrix(mesh.GetPrim().GetParent(), affine(np.eye(3) * how.parent_scale))
    if how.left_handed:
        mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    for time, points in sheet.moving.items():
        mesh.GetPointsAttr().Set(vec3(points @ turn.T / (how.metres * how.parent_scale)), time)
    for name, value in sheet.fabric.items():
        author(mesh.GetPrim(), f"physgraph:material:{name}", value, kind="double")
    author(mesh.GetPrim(), "physgraph:contact:selfCollision", False, kind="bool")
    return Path(save(stage))


def refined(sheet: Sheet, folder: Path, how: Convention, **options) -> tuple[dict[float | None, np.ndarray], dict]:
    """World points [m], Y up, of a sheet refined in a convention, by time code; and the run's report."""
    shot, out = write(sheet, folder / "shot.usdc", how), folder / "fine.usdc"
    report = refine_shot(shot, out, RefineOptions(**{"level": 1, "steps": 6, "temporal": "off"} | options))
    assert errors(out, shot) == []
    stage = open_over(shot, out)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) if how.up == "Z" else np.eye(3)
    times = Sdf.Layer.FindOrOpen(str(out)).ListTimeSamplesForPath(f"{CLOTH}.points")
    points = {time: world_metres(stage, CLOTH, time) @ turn.T for time in (times or [None])}
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))
    topology = {
        "counts": np.array(mesh.GetFaceVertexCountsAttr().Get()),
        "indices": np.array(mesh.GetFaceVertexIndicesAttr().Get()),
    }
    return points, report.to_dict() | topology


def folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="physgraph-property-")


@FEW
@given(sheet=sheets(), how=st.builds(Convention, metres=st.sampled_from([1.0, 0.01]), up=st.sampled_from("YZ")))
def test_a_layer_has_the_right_counts_and_times_and_no_more_energy(sheet: Sheet, how: Convention):
    with folder() as name:
        points, report = refined(sheet, Path(name), how)
    fine = subdivide(sheet.mesh)
    np.testing.assert_array_equal(report["counts"], fine.mesh.counts)
    np.testing.assert_array_equal(report["indices"], fine.mesh.indices)
    assert tuple(points) == (tuple(sheet.moving) or (None,))
    for each in points.values():
        assert each.shape == (fine.mesh.vertex_count, 3)
        assert np.isfinite(each).all()
    for frame in report["frames"]:
        energy = {which: sum(frame["garments"][0]["energy_joules"][which].values()) for which in ("input", "output")}
        scale = sum(abs(value) for value in frame["garments"][0]["energy_joules"]["input"].values())
        assert energy["output"] <= energy["input"] + 1e-6 * scale


@FEW
@given(case=planar_mesh(), fabric=fabrics(), level=st.integers(0, 2), seed=st.integers(0, 99), guide=st.booleans())
def test_rest_without_weight_stays_at_rest(
    case: tuple[PolygonMesh, np.ndarray], fabric: dict[str, float], level: int, seed: int, guide: bool
):
    mesh, points = case
    assume(len(mesh.counts))
    rest = EDGE * points
    placed = rest @ rotation(seed).T + [3.0, -2.0, 5.0]
    refiner = refiner_of([garment_of(mesh, rest)], level=level, gravity=np.zeros(3), dtype=torch.float64)
    values = Fabric(fabric["stretchStiffness"], fabric["bendStiffness"], fabric["density"])
    out = refiner.solve(frame_of(placed, fabric=values, guide=2000.0 if guide else 0.0)).points[0]
    base = placed
    for refinement in subdivide_times(mesh, level):
        base = refinement.linear @ base
    assert np.abs(out - base).max() < 1e-3 * EDGE / 2**level


CONVENTIONS = st.builds(
    Convention,
    metres=st.sampled_from([1e-3, 0.01, 0.0254, 1.0, 10.0]),
    up=st.sampled_from("YZ"),
    left_handed=st.booleans(),
    parent_scale=st.sampled_from([0.1, 1.0, 3.0]),
    rate=st.sampled_from([24.0, 30.0, 120.0]),
)


@FEW
@given(sheet=sheets(planar=True, times=(1.0,)), how=CONVENTIONS)
def test_units_axes_handedness_and_scale_do_not_change_the_cloth(sheet: Sheet, how: Convention):
    with folder() as one, folder() as two:
        here, _ = refined(sheet, Path(one), Convention(), tolerance=0.0)
        there, _ = refined(sheet, Path(two), how, tolerance=0.0)
    np.testing.assert_allclose(there[1.0], here[1.0], atol=1e-2 * EDGE if how.left_handed else 1e-3 * EDGE)
