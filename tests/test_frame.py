"""A frame as a user sees it, of eight scenes: what it may not do, whoever solves it and however."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
import torch
from brute import crossing_points
from cloth import total
from scenes import BODIES, SCENES, inside, refined, shot_of, soup_of, triangles, upsampled

ipctk = pytest.importorskip("ipctk", reason="the IPC toolkit is not installed; it is in the extra `dev`")
scenes = pytest.mark.parametrize("name", SCENES)
some = pytest.mark.parametrize(
    "name",
    [name if name in ("layers", "tube") else pytest.param(name, marks=pytest.mark.slow) for name in SCENES],
)
"""Fast: garments over one another on a body, and one garment on a body."""


def crossings(points: Sequence[np.ndarray], faces: Sequence[np.ndarray]) -> int:
    """Number of edges through triangles, by the IPC toolkit."""
    x, corners = soup_of(points, faces)
    edges = np.asarray(ipctk.edges(corners.astype(np.int32)))
    x = x - x.mean(axis=0)
    mesh = ipctk.CollisionMesh(np.asfortranarray(x), edges, corners.astype(np.int32))
    if not ipctk.has_intersections(mesh, np.asfortranarray(x)):
        return 0
    return len(crossing_points(x, edges, corners)[0])


@scenes
class TestEveryFrame:
    def test_nothing_crosses_that_does_not_cross_in_the_cage(self, name: str):
        faces = triangles(name)
        for number, answer in enumerate(refined(name)):
            before, after = (crossings(x, faces) for x in (upsampled(name, number), answer.points))
            assert (before > 0) == shot_of(name).crossed
            assert after == 0, number
            told = answer.telemetry[0].get("contact", {}).get("cloth", {"after": {"crossings": 0}})
            assert told["after"]["crossings"] == after

    def test_energy_falls_at_every_level(self, name: str):
        for answer in refined(name):
            for garment in answer.telemetry:
                for level in garment["levels"]:
                    assert level["energy_after"] <= level["energy_before"] + 1e-12

    def test_cloth_has_wrinkles_of_its_own_and_stays_with_its_cage(self, name: str):
        """It is nowhere the upsampled cage, and nowhere farther from it than two of its edges."""
        for number, answer in enumerate(refined(name)):
            for points, cage in zip(answer.points, upsampled(name, number), strict=True):
                away = np.linalg.norm(points - cage, axis=1)
                assert 1e-5 < away.max() < 0.1

    def test_from_frame_to_frame_it_jumps_no_farther_than_its_cage(self, name: str):
        """And than an edge."""
        cages = [np.concatenate(upsampled(name, number)) for number in range(len(refined(name)))]
        fine = [np.concatenate(answer.points) for answer in refined(name)]
        for (a, b), (c, d) in zip(pairwise(cages), pairwise(fine), strict=True):
            moved = np.linalg.norm(b - a, axis=1).max()
            assert np.linalg.norm(d - c, axis=1).max() < moved + 0.05


@some
class TestAnotherRefiner:
    def test_a_fresh_refiner_gives_the_same_bytes_in_two_threads(self, name: str):
        made = shot_of(name)
        for answer, again in zip(refined(name), made.refiner(threads=2).refine(made.frames), strict=True):
            assert [x.tobytes() for x in again.points] == [x.tobytes() for x in answer.points]

    def test_a_frame_by_itself_is_the_same_after_any_other(self, name: str):
        made = shot_of(name)
        alone, after = (made.refiner(temporal="off") for _ in range(2))
        after.solve(made.frames[0])
        first, second = (each.solve(made.frames[-1]).points for each in (alone, after))
        assert [x.tobytes() for x in first] == [x.tobytes() for x in second]

    def test_double_precision_keeps_the_same_promises(self, name: str):
        made = shot_of(name)
        level = 2 if len(made.scene.garments) == 1 else 1
        answer = made.refiner(dtype=torch.float64, level=level).solve(made.frames[-1])
        assert crossings(answer.points, triangles(name, level)) == 0
        assert total(answer.telemetry[0], "output") < total(answer.telemetry[0], "input")


@pytest.mark.parametrize("name", BODIES)
def test_nothing_is_inside_a_body(name: str):
    """But where there is less room between two bodies than cloth is thick: there it stays between them."""
    entered = 0
    for number, answer in enumerate(refined(name)):
        entered += int(inside(name, number, upsampled(name, number)).sum())
        assert not inside(name, number, answer.points, deeper=1e-5).any(), number
        for body in answer.telemetry[0]["contact"]["bodies"].values():
            assert body["after"]["inside"] == 0
    assert entered > 0 or name == "armpit"
