"""A cloth draped over a round table and frozen: twelve equal samples."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage
from .drape import Drape, DrapeOptions
from .shapes import Solid, mesh, quad_grid, rings, square

SIDE, CELLS = 1.1, 36
"""Side of the cloth [m] and its quads along a side."""
TABLE_RADIUS, ROUND, TABLE_HEIGHT, THICK = 0.30, 0.02, 0.55, 0.16
"""Radius of the table and of the rounded edge, height and thickness of the top [m]."""
FRAMES, SETTLE = 12, 50


def build() -> PlainStage:
    """A garment with 12 equal samples, over a static collider."""
    rest, quads, uv = square(SIDE, CELLS, TABLE_HEIGHT + 0.004)
    ring = np.minimum(np.arange(CELLS), np.arange(CELLS)[::-1])
    border = np.flatnonzero(np.minimum(ring[:, None], ring[None, :]).ravel() == 2)
    garment = mesh(
        "Cloth",
        quads,
        rest,
        Look("Linen", (0.70, 0.66, 0.56)),
        samples=np.repeat(_settle(rest, quads)[None], FRAMES, axis=0),
        uv=uv,
        subsets=((Look("Stripe", (0.13, 0.20, 0.38)), border),),
        fabric=PRESETS["cotton"],
    )
    doc = "A draped cloth that does not move"
    return PlainStage("FrozenShot", doc, (garment, _table()), np.arange(1.0, FRAMES + 1))


def _settle(rest: np.ndarray, quads: np.ndarray) -> np.ndarray:
    options = DrapeOptions(step=1 / 30, spring=40.0, iterations=8, give=0.85, bend=0.15, drag=4.0, density=0.15)
    turned = np.radians(20.0)
    start = rest.copy()
    radius = np.hypot(rest[:, 0], rest[:, 2])
    start[:, 1] += 0.1 * (radius - TABLE_RADIUS).clip(0) * np.cos(6.0 * np.arctan2(rest[:, 2], rest[:, 0]) + turned)
    top = np.flatnonzero(radius < TABLE_RADIUS - ROUND)
    cloth = Drape(rest, quads, top, options=options, project=lambda x, _: _push_out(x), start=start)
    for _ in range(SETTLE):
        cloth.step(rest[top])
    return cloth.points


def _push_out(points: np.ndarray) -> np.ndarray:
    """Move points out of the table's top; the part on top is held by its pins."""
    middle = TABLE_HEIGHT - 0.5 * THICK
    radius = np.hypot(points[:, 0], points[:, 2])
    outside = np.stack([radius - (TABLE_RADIUS - ROUND), np.abs(points[:, 1] - middle) - (0.5 * THICK - ROUND)], axis=1)
    distance = np.linalg.norm(outside.clip(0), axis=1) + outside.max(axis=1).clip(max=0.0) - ROUND - 0.003
    inside = distance < 0.0
    side = outside.clip(1e-9 * (outside >= outside.max(axis=1, keepdims=True)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    push = points / np.maximum(radius, 1e-9)[:, None] * side[:, :1]
    push[:, 1] = np.sign(points[:, 1] - middle) * side[:, 1]
    return np.where(inside[:, None], points - distance[:, None] * push, points)


def _table() -> PlainMesh:
    """The table's top and its leg, a lathed outline of quads."""
    turn = np.linspace(0.0, 0.5 * np.pi, 5)
    # drawn a little smaller than simulated, so that the coarse cloth's flat quads stay outside
    height, rim = TABLE_HEIGHT - 0.006, TABLE_RADIUS - ROUND - 0.012
    top, low = height - ROUND, height - 0.05 + ROUND
    outline = np.concatenate(
        [
            np.stack([np.linspace(0.0, rim, 5)[1:-1], np.full(3, height)], axis=1),
            np.stack([rim + ROUND * np.sin(turn), top + ROUND * np.cos(turn)], axis=1),
            np.stack([rim + ROUND * np.cos(turn), low - ROUND * np.sin(turn)], axis=1),
            [[0.05, height - 0.05], [0.04, 0.30], [0.045, 0.06], [0.19, 0.03], [0.20, 0.0]],
        ]
    )
    around = 48
    points = rings(outline[:, 0], outline[:, 1], outline[:, 0], around).reshape(-1, 3)
    quads = quad_grid(len(outline), around, closed=True)[:, ::-1]
    cap = np.array([[0.0, height, 0.0]])
    fan = np.stack([np.full(around, len(points)), (np.arange(around) + 1) % around, np.arange(around)], axis=1)
    counts = np.concatenate([np.full(len(quads), 4), np.full(around, 3)])
    table = Solid(np.concatenate([points, cap]), counts, np.concatenate([quads.ravel(), fan.ravel()]))
    return table.collider("Table", Look("Wood", (0.30, 0.20, 0.12), 0.5))
