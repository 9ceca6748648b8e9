"""Distances, sides and orientation of collider surfaces, against libigl and closed forms."""

import numpy as np
import pytest
import torch
from bodies import around, ball, box, distances, endless, flipped, signed, split, surfaces, together, tube

from physgraph_usd.solver.colliders.mesh import Faces, MeshBody, MeshSurface, overlapping
from physgraph_usd.solver.colliders.pose import Pose, moved_rigidly
from physgraph_usd.solver.colliders.primitives import primitive

FAR = np.array([0.25, 0.0, 0.0])
BODIES = {
    "ball": ball(),
    "box": box(),
    "flipped": flipped(ball()),
    "mixed": flipped(ball(), 0.5),
    "split": split(ball()),
    "two": together(ball(), flipped(ball(at=(0.6, 0.0, 0.0)))),
}


class TestMeshes:
    @pytest.mark.parametrize("name", BODIES)
    def test_closed_bodies_are_closed_whatever_their_winding(self, name: str):
        (surface,) = surfaces(BODIES[name])
        assert surface.closed
        corners = BODIES[name][0][surface.triangles]
        volume = np.einsum("tc,tc->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
        assert volume > 0

    @pytest.mark.parametrize("name", BODIES)
    def test_distances_are_libigls(self, name: str):
        soup = BODIES[name]
        (surface,) = surfaces(soup)
        x = around(soup)
        found = surface.closest(torch.as_tensor(x - surface.origin), endless(len(x)))
        np.testing.assert_allclose(found.distance.numpy(), distances(soup, x), atol=2e-6)
        np.testing.assert_allclose(distances(soup, found.point.numpy() + surface.origin), 0.0, atol=2e-6)

    @pytest.mark.parametrize("name", ["ball", "flipped", "mixed", "split"])
    def test_inside_is_inside(self, name: str):
        (surface,) = surfaces(BODIES[name])
        x = around(BODIES[name])
        radius = np.linalg.norm(x, axis=1)
        clear = np.abs(radius - 0.2) > 2e-3
        np.testing.assert_array_equal(signed(surface, x)[clear] < 0, radius[clear] < 0.2)

    @pytest.mark.parametrize("parts", [1, 2])
    def test_all_faces_summed_give_the_inside_of_the_hierarchy(self, parts: int):
        """Two balls in one another: a card sums over faces, the CPU asks the hierarchy."""
        soup = together(ball(level=3), ball(0.15, level=3, at=(0.25, 0.0, 0.0)))
        (surface,) = surfaces(soup)
        x = torch.as_tensor(around(soup) - surface.origin)
        inside = surface.inside(x, parts=parts)
        assert inside.any()
        assert torch.equal(surface._turns(x) > parts - 0.5, inside)

    @pytest.mark.parametrize("rigid", [True, False])
    def test_turned_alone_it_passes_through_itself_as_before(self, monkeypatch: pytest.MonkeyPatch, rigid: bool):
        """What was found out about two balls in one another serves again where both turn, not where one moves."""
        one, other = ball(level=3), ball(0.15, level=3, at=(0.25, 0.0, 0.0))
        points, triangles = together(one, other)
        angle, second = np.radians(40.0), (np.arange(len(points)) >= len(one[0]))[:, None]
        turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        move = 0.0 if rigid else 0.02 * second
        later = Pose((points + move * np.array([-1.0, 0.0, 0.0])) @ turn.T + 0.3, triangles)
        body, x = MeshBody(device="cpu", threads=1), around((later.points, triangles))
        (surface,) = body.pose(Pose(points, triangles))
        self.ways_out(surface, around((points, triangles)))
        asked, lifted = list[int](), Faces._lifted_inside
        monkeypatch.setattr(
            Faces, "_lifted_inside", lambda self, which: asked.append(len(which)) or lifted(self, which)
        )
        body.pose(later)
        (fresh,) = surfaces((later.points, triangles))
        found = self.ways_out(surface, x)
        assert sum(asked) == (0 if rigid else len(points))
        assert torch.equal(found, self.ways_out(fresh, x))
        assert len(found) > 20

    @staticmethod
    def ways_out(surface: MeshSurface, x: np.ndarray) -> torch.Tensor:
        """Lengths of the ways out from the world positions inside [m]."""
        at = torch.as_tensor(x - surface.origin)
        within = at[surface.inside(at)]
        return surface.exit(within, surface.closest(within, endless(len(within)))).distance

    def test_far_from_the_world_origin_nothing_is_lost(self):
        points, triangles = ball()
        (surface,) = surfaces((points + 1e5, triangles))
        x = around(ball())
        np.testing.assert_allclose(np.abs(signed(surface, x + 1e5)), distances(ball(), x), atol=3e-6)


class TestRigid:
    def test_turned_and_shifted(self):
        points, turn = ball()[0], np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        assert moved_rigidly(points, points @ turn.T + 5.0)
        assert moved_rigidly(points, (points @ turn.T + 0.5).astype(np.float32).astype(np.float64))

    @pytest.mark.parametrize("change", [np.diag([1.0, 1.0, -1.0]), 1.001 * np.eye(3), np.eye(3) + 1e-4])
    def test_mirrored_scaled_or_sheared(self, change: np.ndarray):
        points = ball()[0] * np.array([1.0, 0.7, 0.4]) + np.array([0.1, 0.0, 0.02]) * ball()[0][:, :1] ** 2
        assert not moved_rigidly(points, points @ change.T)


class TestOverlap:
    def test_a_body_passes_through_itself_only_where_its_parts_meet(self):
        """Neighbouring faces share corners and do not cross; two balls meet in a ring at x = 0.16 m."""
        one, other = ball(level=4), ball(0.15, level=4, at=(0.25, 0.0, 0.0))
        found = []
        for soup in (one, together(one, other)):
            (surface,) = surfaces(soup)
            faces = overlapping(surface.mesh, torch.arange(len(surface.triangles))).numpy()
            found.append(surface.world[surface.solid.faces[faces]])
        assert len(found[0]) == 0
        assert len(found[1]) > 50
        np.testing.assert_allclose(found[1][..., 0], 0.16, atol=0.02)

    def test_the_way_out_of_overlapping_parts_is_on_a_bare_face(self):
        """Between two balls 0.2 in radius and 0.2 apart the nearest faces are buried in the other ball."""
        soup = together(ball(level=4), ball(level=4, at=(0.2, 0.0, 0.0)))
        (surface,) = surfaces(soup)
        x = torch.tensor([[0.1, 0.0, 0.0]], dtype=torch.float64)
        asked = x - torch.as_tensor(surface.origin)
        found = surface.closest(asked, endless(1))
        assert float(found.distance) == pytest.approx(0.1, abs=2e-3)
        way = surface.exit(asked, found)
        # The balls meet in a ring of radius sqrt(0.2^2 - 0.1^2).
        assert float(way.distance) == pytest.approx(np.sqrt(0.03), abs=0.02)


class TestBuried:
    """A corner from which one sees the sky is not buried; the others take a winding number."""

    def test_it_is_what_winding_numbers_say(self, monkeypatch: pytest.MonkeyPatch):
        (surface,) = surfaces(together(ball(level=4), ball(0.15, level=4, at=(0.25, 0.0, 0.0))))
        every = torch.arange(len(surface.mesh.points))
        one, other = (np.linalg.norm(surface.mesh.points.numpy() + surface.origin - at, axis=1) for at in (0.0, FAR))
        of_one = np.arange(len(every)) < len(every) // 2
        deep, near = (np.where(of_one, other < 0.15 + by, one < 0.2 + by) for by in (-2e-3, 2e-3))
        asked = self.asked(monkeypatch)
        buried = surface._faces._lifted_inside(every).numpy()
        assert deep.sum() > 100
        assert buried[deep].all()
        assert not buried[~near].any()
        assert deep.sum() <= sum(asked) < 0.5 * len(every)

    def test_through_a_hole_one_sees_the_sky_from_inside(self):
        """Of a tube with a ball in it: the ball's corners look out at the ends, and all are buried."""
        body = MeshBody(side="winding", device="cpu", threads=1)
        (surface,) = body.pose(Pose(*together(tube(0.1, 0.4), ball(0.05))))
        radius = np.linalg.norm(surface.mesh.points.numpy() + surface.origin, axis=1)
        inner = torch.as_tensor(np.flatnonzero(radius < 0.051))
        assert len(inner) > 100
        assert surface._faces._lifted_inside(inner).all()

    @staticmethod
    def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
        """How many points are asked for at each call from now on."""
        counts, inside = list[int](), MeshSurface.inside
        monkeypatch.setattr(
            MeshSurface, "inside", lambda self, x, **more: counts.append(len(x)) or inside(self, x, **more)
        )
        return counts


def distance_to(kind: str, x: np.ndarray) -> np.ndarray:
    """Signed distance of points, shape (N, 3), from a primitive of the size (0.1, 0.1, 0.2) m about z, shape (N,)."""
    if kind == "plane":
        return x[:, 2]
    if kind == "sphere":
        return np.linalg.norm(x, axis=1) - 0.1
    if kind == "capsule":
        return np.linalg.norm(x - x.clip([0, 0, -0.2], [0, 0, 0.2]), axis=1) - 0.1
    beyond = np.abs(x) - [0.1, 0.1, 0.2]
    if kind == "cylinder":
        beyond = np.stack([np.hypot(x[:, 0], x[:, 1]) - 0.1, beyond[:, 2]], axis=1)
    return np.linalg.norm(beyond.clip(0.0), axis=1) + beyond.max(axis=1).clip(max=0.0)


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder", "cube", "plane"])
def test_distances_to_a_primitive_are_those_of_its_formula(kind: str):
    """Within a thousandth of the radius; a plane's also tens of metres from its centre."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn, centre = turn * np.sign(np.linalg.det(turn)), np.array([0.3, -0.2, 0.1])
    pose = primitive(kind, np.array([0.1, 0.1, 0.2]), turn=turn, centre=centre)
    (surface,) = MeshBody(side="front" if pose.endless else "auto", device="cpu", threads=1).pose(pose)
    local = np.random.default_rng(4).uniform(-0.4, 0.4, (400, 3))
    local[::4, :2] *= 100.0 if pose.endless else 1.0
    np.testing.assert_allclose(signed(surface, local @ turn.T + centre), distance_to(kind, local), atol=1.5e-4)


def test_normals_of_a_body_repeat_bit_for_bit_on_two_threads():
    points, triangles = ball(level=6)
    (surface,) = MeshBody(side="auto", device="cpu", threads=2).pose(Pose(points, triangles))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        first, *others = (Faces(surface)._normals for _ in range(6))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(first, each) for each in others)
