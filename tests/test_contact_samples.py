"""Samples that are about contact: their cages do not cross, stay out of their bodies, and can be refined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="samples are written with usd-core")

from piercing import depths, parts, piercings, place, signed, triangles_of
from pxr import Usd
from scipy.spatial import cKDTree
from shots import faults, refine, sample_times
from stages import built

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.lab.samples.panel import sew
from physgraph_usd.lab.samples.shapes import box, join, lathe, off_box, off_torus, torus
from physgraph_usd.lab.samples.tshirt import SHIRT, dress
from physgraph_usd.usd.write.plain import Look, PlainMesh

DEEP = 1e-4


@dataclass(frozen=True)
class Told:
    """What a sample says about itself: garments and bodies by name, frames, and how deep its cage may be in a body."""

    garments: tuple[str, ...]
    bodies: tuple[str, ...]
    frames: int
    inside: float = 0.0
    deepest_mm: float = 0.0


SHOTS = {
    "crossing": Told(("Front", "Back"), (), 12),
    "torus": Told(("Sheet",), ("Ring",), 28),
    "hood": Told(("Hood",), ("Head", "Bust"), 24),
    "armpit": Told(("Shirt",), ("Form",), 30, inside=0.02, deepest_mm=8.0),
    "layers": Told(("Trousers", "Shirt", "Belt"), ("Form",), 30),
    "block": Told(("Sheet",), ("Block",), 24),
    "dancer": Told(("Dress",), ("Body",), 60),
}


def of_role(name: str, role: str) -> list[PlainMesh]:
    return [mesh for mesh in built(name).meshes if mesh.role == role]


def sides(mesh: PlainMesh) -> np.ndarray:
    """Edges of quads, without diagonals."""
    quads = mesh.indices.reshape(-1, 4)
    return np.unique(np.sort(quads[:, [[0, 1], [1, 2], [2, 3], [3, 0]]].reshape(-1, 2), axis=1), axis=0)


def lengths(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)


def solid_mesh(points: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> PlainMesh:
    return PlainMesh("Solid", counts, indices, points, Look("Grey", (0.5, 0.5, 0.5)))


@pytest.mark.parametrize("name", SHOTS)
def test_parts(name: str) -> None:
    told = SHOTS[name]
    garments, bodies = of_role(name, "garment"), of_role(name, "collider")
    assert tuple(mesh.name for mesh in garments) == told.garments
    assert tuple(mesh.name for mesh in bodies) == told.bodies
    assert len(built(name).times) == told.frames
    for mesh in garments:
        assert set(mesh.counts) == {4}
        assert 150 <= len(mesh.points) <= 2500
        assert mesh.uv is not None
        assert mesh.fabric is not None
        assert 0.015 <= np.median(lengths(mesh.points, sides(mesh))) <= 0.035
    assert sum(len(mesh.points) for mesh in garments) >= 500


@pytest.mark.parametrize("name", SHOTS)
def test_cloth_moves_and_is_compressed_in_places(name: str) -> None:
    for mesh in of_role(name, "garment"):
        assert mesh.samples is not None
        assert np.ptp(mesh.samples, axis=0).max() > 0.003
        if mesh.name == "Belt":
            continue  # of leather, and as long as it is worn
        rest = lengths(mesh.points, sides(mesh))
        ratio = np.stack([lengths(sample, sides(mesh)) for sample in mesh.samples]) / rest
        assert (ratio < 0.97).mean(axis=1).max() > 0.10, f"nothing to wrinkle in {mesh.name}"
        assert np.percentile(ratio, 95) < 1.15, f"{mesh.name} is stretched"


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [name for name in SHOTS if name != "crossing"])
def test_cages_do_not_cross(name: str, every: int) -> None:
    garments = of_role(name, "garment")
    frames = range(0, SHOTS[name].frames, every)
    assert [len(piercings(garments, frame)) for frame in frames] == [0] * len(frames)


@pytest.mark.parametrize("name", [name for name, told in SHOTS.items() if told.bodies])
def test_cages_stay_out_of_bodies(name: str) -> None:
    told = SHOTS[name]
    for mesh in of_role(name, "garment"):
        free = np.ones(len(mesh.points), bool) if mesh.pin is None else mesh.pin < 0.5
        for frame in (0, told.frames // 2, told.frames - 1):
            deep = [depths(place(mesh, frame)[free], body, frame) for body in of_role(name, "collider")]
            worst = np.max(deep, axis=0)
            assert np.mean(worst > DEEP) <= told.inside, (mesh.name, frame)
            assert worst.max() <= max(1e-3 * told.deepest_mm, DEEP), (mesh.name, frame)


@pytest.mark.parametrize("name", [name for name, told in SHOTS.items() if told.bodies])
def test_bodies_are_closed_and_face_out(name: str) -> None:
    for mesh in of_role(name, "collider"):
        faces = triangles_of(mesh)
        directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        forth, back = (np.unique(directed[:, order], axis=0) for order in ([0, 1], [1, 0]))
        assert len(forth) == len(directed), "two faces run along an edge in the same direction"
        np.testing.assert_array_equal(forth, back, "an edge has one face only")
        corners = place(mesh, 0)[faces]
        volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
        assert np.bincount(parts(mesh)[faces[:, 0]], volumes).min() > 1e-4, "a part is inside out"


@pytest.mark.parametrize("name", SHOTS)
def test_schemas_are_applied(sample: Callable[[str], Path], name: str) -> None:
    stage = Usd.Stage.Open(str(sample(name)))
    applied = {prim.GetName(): prim.GetPrimTypeInfo().GetAppliedAPISchemas() for prim in stage.Traverse()}
    assert all("PhysGraphGarmentAPI" in applied[mesh] for mesh in SHOTS[name].garments)
    assert all("PhysGraphColliderAPI" in applied[mesh] for mesh in SHOTS[name].bodies)


@pytest.mark.parametrize("name", SHOTS)
def test_one_frame_is_refined(sample: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    middle = float(built(name).times[SHOTS[name].frames // 2])
    layer = tmp_path / "fine.usdc"
    refine(sample(name), layer, frames=(middle, middle), level=0)
    root = built(name).name
    assert all(sample_times(layer, f"/{root}/{mesh}") == (middle,) for mesh in SHOTS[name].garments)
    assert faults(layer, sample(name)) == []


def test_layers_are_a_few_millimetres_apart() -> None:
    trousers, shirt, belt = of_role("layers", "garment")
    form = of_role("layers", "collider")[0]
    for frame in range(0, 30, 4):
        for outer, inner in ((belt, shirt), (shirt, trousers), (trousers, form)):
            points, height = place(outer, frame), belt.points[:, 1]
            at_waist = points[(outer.points[:, 1] > height.min() - 0.01) & (outer.points[:, 1] < height.max() + 0.01)]
            distance = np.abs(signed(at_waist, place(inner, frame), triangles_of(inner)))
            assert len(at_waist) > 60
            assert 0.004 < distance.min() < distance.max() < 0.008, (outer.name, frame)


def test_sheets_start_crossed_near_their_lower_edges() -> None:
    front, back = sheets = of_role("crossing", "garment")
    for frame in (0, 6, 11):
        pairs = piercings(sheets, frame)
        assert len(pairs) > 40
        assert np.all(pairs[:, 0] != pairs[:, 1]), "no sheet crosses itself"
        ahead = place(front, frame)[:, 2].reshape(26, 25)[:, 4:21].mean(axis=1)
        behind = place(back, frame)[:, 2].reshape(25, 21)[:, 2:19].mean(axis=1)
        assert np.all(ahead[:18] > behind[:18])
        assert -0.05 < ahead[-1] - behind[-1] < -0.02, "a few centimetres past one another"
    for mesh in sheets:
        assert mesh.samples is not None
        assert mesh.pin is not None
        assert np.ptp(mesh.samples[:, mesh.pin == 1], axis=0).max() == 0.0


def test_the_hood_lies_on_itself_and_the_head_turns_in_it() -> None:
    hood, head = of_role("hood", "garment")[0], of_role("hood", "collider")[0]
    points, faces = place(hood, 0), triangles_of(hood)
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    behind = np.abs(corners.mean(axis=1)[:, 0]) < 0.03
    back = normal[behind & (corners.mean(axis=1)[:, 2] < -0.1) & (corners.mean(axis=1)[:, 1] < 0.08)]
    assert (back[:, 2] < 0).any()
    assert (back[:, 2] > 0).any(), "the middle layer of the fold faces the other way"
    assert head.transforms is not None
    turned = [np.degrees(np.arctan2(matrix[0, 2], matrix[2, 2])) for matrix in head.transforms]
    assert max(turned) > 25
    assert min(turned) < -15


def test_the_armpit_is_pinched_in_the_middle_and_open_at_the_ends() -> None:
    shirt, form = built("armpit").meshes
    assert form.samples is not None
    faces, level = triangles_of(form), dress(sew(SHIRT))
    part = parts(form)
    torso, arm = part == part[0], part == part[np.argmax(form.samples[0, :, 0])]
    lower = arm & (form.samples[14, :, 1] < 0.36) & (form.samples[14, :, 1] > 0.25)
    under = (level[:, 0] > 0.22) & (np.abs(level[:, 1] - SHIRT.armpit) < 0.005)
    side = (np.abs(level[:, 0] - SHIRT.half_width) < 0.01) & (level[:, 1] < 0.39) & (level[:, 1] > 0.25)
    bodies, layers = [], []
    for frame in (0, 14, 29):
        bodies.append(signed(form.samples[frame, lower], form.samples[frame], faces[torso[faces].all(axis=1)]).min())
        points = place(shirt, frame)
        layers.append(np.median(cKDTree(points[side]).query(points[under])[0]))
    assert 0.002 < bodies[1] < 0.012, "between arm and side there is less room than two layers of cloth ask for"
    assert layers[1] < 0.015, "sleeve and side lie on one another"
    assert min(bodies[0], bodies[2], layers[0], layers[2]) > 0.03
    gaps = -depths(place(shirt, 0), form, 0)
    assert 0.003 < gaps.min() < np.median(gaps) < 0.02


def test_the_body_walks() -> None:
    samples = of_role("layers", "collider")[0].samples
    assert samples is not None
    ankle = samples[:, -2] - samples[:, -1]
    assert ankle[:, 2].max() > 0.3, "the left foot is ahead"
    assert ankle[:, 2].min() < -0.3, "the right foot is ahead"
    assert np.ptp(samples[:, -2, 1]) > 0.05, "feet are lifted"


def test_an_edge_through_a_face_is_counted() -> None:
    quad = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    flat = solid_mesh(quad, np.array([4]), np.arange(4))
    upright = solid_mesh(quad[:, [2, 0, 1]] + (0.3, 0.4, -0.55), np.array([4]), np.arange(4))
    above = solid_mesh(quad[:, [2, 0, 1]] + (0.3, 0.4, 0.05), np.array([4]), np.arange(4))
    pairs = piercings([flat, upright], 0)
    assert {tuple(pair) for pair in pairs} == {(0, 1), (1, 0)}
    assert len(piercings([flat, above], 0)) == 0
    assert len(piercings([flat, flat], 0)) == 0, "faces that lie in one plane do not cross"


def test_solids_are_closed_and_points_are_pushed_to_them() -> None:
    rng = np.random.default_rng(20)
    points = rng.uniform(-0.35, 0.35, (400, 3))
    ring, block = torus(0.2, 0.08, (96, 64)), box(np.array([0.2, 0.1, 0.15]))
    angle = 2 * np.pi * np.arange(64) / 64
    turned = np.linspace(0.0, np.pi, 34)[1:-1, None]
    rings = 0.2 * np.stack(
        np.broadcast_arrays(np.sin(turned) * np.cos(angle), np.cos(turned), np.sin(turned) * np.sin(angle)), -1
    )
    ball = lathe(rings, np.array([[0, 0.2, 0], [0, -0.2, 0]]))
    volumes = {0.2**2 * np.pi**2 * 2 * 0.08**2 / 0.2: ring, 8 * 0.2 * 0.1 * 0.15: block, 4 / 3 * np.pi * 0.2**3: ball}
    for volume, solid in volumes.items():
        corners = solid.points[triangles_of(solid_mesh(solid.points, solid.counts, solid.indices))]
        found = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        assert found == pytest.approx(volume, rel=0.01)
    assert len(join(ring, block).counts) == len(ring.counts) + 6
    for solid, pushed, gap in [
        (block, off_box(points, np.array([0.2, 0.1, 0.15]), 0.01), 0.01),
        (ring, off_torus(points, 0.2, 0.08), 0.0),
    ]:
        faces = triangles_of(solid_mesh(solid.points, solid.counts, solid.indices))
        before, after = (signed(each, solid.points, faces) for each in (points, pushed))
        assert (before < gap).sum() > 20
        assert after.min() > gap - 5e-4
        np.testing.assert_array_equal(points[before > gap + 5e-4], pushed[before > gap + 5e-4])


def test_folds_twice_as_high_cross_nothing(tmp_path: Path) -> None:
    """Without a safe move after it the scale would have them cross 573 times."""
    shot = write_sample("hood", tmp_path)
    report = refine(shot, tmp_path / "fine.usdc", steps=30, frames=(1.0, 1.0), overrides=["detail=2"])
    told = report.frames[0]["garments"][0]["contact"]["cloth"]
    assert told["after"]["crossings"] == 0
