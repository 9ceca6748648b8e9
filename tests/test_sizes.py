"""Sizes: a doll's clothes keep their distance and folds, and units that cannot be a garment's are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bodies import tube
from pxr import Vt
from shots import fine, refine
from stages import COLLIDER_API, add_mesh, author, new_stage, said, save

from physgraph_usd.usd.read.reader import open_shot

COAT, RADIUS, AROUND, ROWS = "/World/coat", 0.12, 24, 13
DOLL = 1.0 / 12.0


def coat(scale: float, gap: float = 0.0036, folds: float = 0.003) -> np.ndarray:
    """Points of a coat about a body, with folds along it [m], before its scale."""
    turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
    radius = RADIUS + gap + folds * (1.0 + np.cos(8.0 * turn))
    z = np.linspace(-0.2, 0.2, ROWS)[:, None]
    points = np.broadcast_arrays(radius * np.cos(turn), radius * np.sin(turn), z)
    return scale * np.stack(points, axis=-1).reshape(-1, 3)


def dressed(path: Path, scale: float, *, metres: float = 1.0, body: bool = True, **shape: float) -> str:
    """A coat on a body at a scale of a person's, in metres unless the stage says otherwise."""
    stage = new_stage(path, up="Z", metres=metres)
    ids = np.arange(ROWS * AROUND).reshape(ROWS, AROUND)
    there = np.roll(ids, -1, axis=1)
    quads = np.stack([ids[:-1], there[:-1], there[1:], ids[1:]], axis=-1).reshape(-1, 4)
    add_mesh(stage, COAT, coat(scale, **shape), quads)
    if body:
        points, faces = tube(RADIUS, 0.6, around=96)
        add_mesh(stage, "/World/body", scale * points, faces, schema=COLLIDER_API)
    return save(stage)


def apart(shot: str, folder: Path, scale: float) -> np.ndarray:
    """Distances of the refined coat from the body's axis less its radius [m]."""
    refine(Path(shot), folder / "fine.usdc", level=1, steps=60)
    points = fine(Path(shot), folder / "fine.usdc", None, prim=COAT)
    return np.hypot(points[:, 0], points[:, 1]) - scale * RADIUS


def test_a_dolls_coat_stays_as_near_as_its_cage(tmp_path: Path):
    """Its cage keeps 0.3 to 0.8 mm, and an offset of 2 mm would iron its folds out."""
    found = apart(dressed(tmp_path / "s.usda", DOLL), tmp_path, DOLL)
    assert 2e-4 < np.median(found) < 8e-4
    assert np.ptp(np.percentile(found, [5, 95])) > 2e-4


@pytest.mark.parametrize("scale", [1.0, DOLL])
def test_cloth_inside_comes_out_whatever_the_size(tmp_path: Path, scale: float):
    found = apart(dressed(tmp_path / "s.usda", scale, gap=-0.004, folds=0.002), tmp_path, scale)
    assert found.min() > -1e-3 * scale * RADIUS
    assert scale < 1.0 or np.median(found) > 1.5e-3
