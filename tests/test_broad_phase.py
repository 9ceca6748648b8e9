"""Which bodies count as near: bounds, grown by the margin and the body's own offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cloth import sheet
from sheets import garment_of

from physgraph_usd.solver.colliders.pose import Collider, MeshPose, ShapePose
from physgraph_usd.solver.contact.broad_phase import Bodies, bounds_of

MESH, REST = sheet(4, 4)
TOP = float(REST[:, 1].max())


def near(gap: float, *, margin: float, offset: float, kind: str = "cube") -> bool:
    """Whether a body that lies a gap above the sheet's bounds counts."""
    bodies = Bodies([Collider("/World/Body", kind, offset)], device="cpu", threads=1)
    centre = np.array([0.1, TOP + gap + 0.5, 0.0])
    if kind == "mesh":
        corners = np.array([[0.0, TOP + gap, 0.0], [0.1, TOP + gap, 0.0], [0.0, TOP + gap + 0.1, 0.1]])
        pose = MeshPose(corners, np.array([[0, 1, 2]], np.int32))
    else:
        pose = ShapePose(kind, np.eye(3), centre, np.full(3, 0.5))
    bodies.pose([pose])
    garment = replace(garment_of(MESH, REST), colliders=(0,))
    return bodies.near(garment, bounds_of(REST), margin) == (0,)


@pytest.mark.parametrize("kind", ["cube", "sphere", "mesh"])
@pytest.mark.parametrize(
    ("gap", "margin", "offset", "counts"),
    [
        (0.05, 0.04, 0.0, False),
        (0.05, 0.06, 0.0, True),
        (0.05, 0.04, 0.02, True),
        (0.05, 0.0, 0.04, False),
        (0.05, 0.0, 0.06, True),
        (-0.05, 0.0, 0.0, True),
    ],
)
def test_a_body_counts_within_the_margin_and_its_own_offset(
    kind: str, gap: float, margin: float, offset: float, counts: bool
):
    assert near(gap, margin=margin, offset=offset, kind=kind) == counts


def test_one_without_a_pose_does_not():
    bodies = Bodies([Collider("/World/Body", "cube")], device="cpu", threads=1)
    bodies.pose([None])
    assert bodies.near(replace(garment_of(MESH, REST), colliders=(0,)), bounds_of(REST), 1e9) == ()
