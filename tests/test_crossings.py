"""Edges that pass through faces: every one of them, against numpy and the IPC toolkit, which share no code with it."""

from functools import cache

import numpy as np
import pytest
import torch
from brute import Soup
from brute import crossings as every
from cloth import base_of
from folds import EDGE, SHAPES, Cloth, crumpled, curved, flat, folded, levels_of, named, placed, square, strip
from meshes import mesh_of
from sheets import rotation

from physgraph_usd.solver.collide.crossings import Crossings, crossings
from physgraph_usd.solver.collide.parts import Parts
from physgraph_usd.solver.contact.cloth_mesh import ClothMesh
from physgraph_usd.solver.level import Level
from physgraph_usd.solver.mesh.topology import joined_by

ALL = np.ones((2, 2), bool)
CROSSED = ("rolled through itself", "crumpled", "crumpled more")


def listed(found: Crossings) -> set[tuple[int, int]]:
    """Pairs of an edge and a face, each found once."""
    out = set(zip(found.edge.tolist(), found.face.tolist(), strict=True))
    assert len(out) == found.count
    return out


def found_at(level: Level, x: torch.Tensor, meets: np.ndarray = ALL) -> set[tuple[int, int]]:
    return listed(crossings(Parts(level, meets), x))


def two_sheets(kind: str = "triangles") -> tuple[Level, torch.Tensor]:
    """Two garments that pass through one another and through themselves."""
    cloth = square(3, kind=kind)
    level = levels_of(named(cloth, "A"), named(cloth, "B"))[-1]
    half = level.vertex_count // 2
    points = level.rest.double().numpy()
    x = np.concatenate([crumpled(points[:half], 1, size=0.5), crumpled(points[half:], 2, size=0.5)])
    x[half:, 0] += 0.01
    return level, torch.as_tensor(x, dtype=level.dtype)


def lips(seed: int) -> tuple[Level, torch.Tensor]:
    """Both lips of a slit lie in the plane of the cloth, their normals up, and pass over and through one another."""
    mesh, rest = slit()
    level = levels_of(named((mesh, rest)))[-1]
    return level, torch.as_tensor(base_of(mesh, overlapped(rest, seed), 1), dtype=level.dtype)


@cache
def scene(name: str) -> tuple[Level, torch.Tensor]:
    if name in SHAPES:
        level = levels_of(named(strip(8, 3) if "crumpled" not in name else square(4)))[-1]
        return level, placed(level, SHAPES[name])
    kind, _, of = name.partition(" of ")
    return lips(int(of.removeprefix("seed "))) if kind == "lips" else two_sheets(of or "triangles")


SCENES = (*SHAPES, "two sheets", "two sheets of quads", *(f"lips of seed {seed}" for seed in range(4)))


class TestAgainstEveryPair:
    @pytest.mark.parametrize("name", SCENES)
    def test_of_sheets(self, name: str):
        level, x = scene(name)
        expected = every(Soup.of(level, x))
        assert found_at(level, x) == expected
        assert (len(expected) > 5) == (name in CROSSED or name not in SHAPES)

    @pytest.mark.parametrize("kind", ["triangles", "quads", "mixed"])
    @pytest.mark.parametrize("level", [0, 1, 2])
    def test_of_random_crumples(self, kind: str, level: int):
        finest, count = levels_of(named(square(4, kind=kind)), level=level)[-1], 0
        for seed in range(6 if level < 2 else 2):
            for size in (0.2, 0.5, 0.8):
                points = crumpled(finest.rest.double().numpy(), seed, size=size) @ rotation(seed)
                x = torch.as_tensor(points, dtype=finest.dtype)
                expected = every(Soup.of(finest, x))
                assert found_at(finest, x) == expected
                count += len(expected)
        assert count > 30


def slit() -> Cloth:
    """A square sheet cut along the middle from its lower rim to its centre: the points there are there twice."""
    mesh, points = square(6)
    faces = mesh.indices.reshape(-1, 3).copy()
    cut = np.flatnonzero((np.abs(points[:, 0]) < 1e-9) & (points[:, 2] > 1e-9))
    left = points[faces][:, :, 0].mean(axis=1) < 0
    for number, vertex in enumerate(cut):
        faces[left[:, None] & (faces == vertex)] = len(points) + number
    return mesh_of(faces.tolist(), len(points) + len(cut)), np.concatenate([points, points[cut]])


def overlapped(rest: np.ndarray, seed: int) -> np.ndarray:
    """The lips pushed over one another by up to an edge, and waved a little."""
    points = rest.copy()
    mirror = len(square(6)[1])
    left = points[:, 0] < -1e-9
    left[mirror:] = True
    past = points[:, 2].clip(0.0)
    points[:, 0] += np.where(left, 1.0, -1.0) * 0.4 * past * (1 - 2 * np.abs(rest[:, 0])) ** 4
    rng = np.random.default_rng(seed)
    return points + 0.05 * EDGE * rng.normal(size=points.shape)


class TestWhatCounts:
    @pytest.mark.parametrize(
        "meets", [[[True, False], [False, True]], [[False, True], [True, False]], [[False, False], [False, True]]]
    )
    def test_only_garments_that_feel_one_another(self, meets: list[list[bool]]):
        level, x = scene("two sheets")
        felt = np.array(meets)
        mesh = ClothMesh(level, felt, np.zeros((0, 2), np.int64))
        found = crossings(mesh.parts, x)
        expected = every(Soup.of(level, x), felt)
        assert 0 < len(expected) < len(every(Soup.of(level, x)))
        assert listed(found) == expected
        table = mesh.between(found)
        assert table.sum() == found.count
        assert not table[~felt | np.tri(2, k=-1, dtype=bool)].any()

    def test_touching_is_not_passing(self):
        """A sheet laid exactly on another, and one whose vertices lie in the other's faces."""
        level = levels_of(named(square(2), "A"), named(square(2), "B"))[-1]
        half = level.vertex_count // 2
        for shift in ([0.0, 0.0, 0.0], [0.004, 0.0, 0.003]):
            x = level.rest.clone()
            x[half:] += torch.tensor(shift)
            assert not found_at(level, x)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("shape", [flat, folded, curved])
    def test_what_does_not_cross_has_none(self, shape: object, dtype: torch.dtype):
        """However it is turned: in a plane that is no axis' own, rounding says on which side of it an end is."""
        level = levels_of(named(strip(8, 3)), dtype=dtype)[-1]
        x = placed(level, shape)  # type: ignore[arg-type]
        for seed in range(20):
            assert not found_at(level, x @ torch.as_tensor(rotation(seed), dtype=dtype)), seed

    def test_what_is_sewn_to_a_face_does_not_pass_through_it(self):
        """Pairs of vertices of two crossing sheets are sewn at random: what shares a label with a face is left out."""
        level, x = scene("two sheets")
        soup, half = Soup.of(level, x), level.vertex_count // 2
        expected = every(soup)
        rng = np.random.default_rng(3)
        sewn = np.stack([rng.choice(half, 12, replace=False), half + rng.choice(half, 12, replace=False)], axis=1)
        label = joined_by(sewn, level.vertex_count)
        kept = {(e, f) for e, f in expected if not np.isin(label[soup.edges[e]], label[soup.faces[f]]).any()}
        assert 0 < len(kept) < len(expected)
        assert listed(crossings(Parts(level, ALL, label), x)) == kept


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["quads", "mixed", "triangles"])
def test_a_cage_that_does_not_cross_crosses_at_no_level(kind: str, dtype: torch.dtype):
    """Crumpled sheets, as far as their cages do not cross; by the means of quads some of them would."""
    levels = levels_of(named(square(4, kind=kind)), level=2, dtype=dtype)
    tried = bent = 0
    for seed in range(60):
        x = torch.as_tensor(crumpled(levels[0].rest.double().numpy(), seed, size=0.9), dtype=dtype)
        if found_at(levels[0], x):
            continue
        tried, mean = tried + 1, x
        for level in levels[1:]:
            assert level.flat_from_below is not None
            assert level.from_below is not None
            x, mean = level.flat_from_below.apply(x), level.from_below.apply(mean)
            assert not found_at(level, x), (seed, level.index)
        bent += bool(found_at(levels[-1], mean))
    assert tried > 5
    assert kind == "triangles" or bent > 0
