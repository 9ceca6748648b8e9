"""Sizes: a doll's clothes keep their distance and folds, and units that cannot be a garment's are named."""

from pathlib import Path

import numpy as np
import pytest
from meshes import quads_of
from pxr import UsdGeom
from shots import fine, refine
from stages import COLLIDER_API, add_mesh, new_stage, said, save

from physgraph_usd.usd.read.reader import open_shot

COAT, RADIUS, AROUND, ROWS = "/World/coat", 0.12, 48, 7
DOLL = 1.0 / 12.0


def coat(scale: float, gap: float = 0.0036, folds: float = 0.003) -> np.ndarray:
    """Points of a coat about a body, with folds along it [m], before its scale."""
    turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
    radius = RADIUS + gap + folds * (1.0 + np.cos(6.0 * turn))
    z = np.linspace(-0.08, 0.08, ROWS)[:, None]
    points = np.broadcast_arrays(radius * np.cos(turn), radius * np.sin(turn), z)
    return scale * np.stack(points, axis=-1).reshape(-1, 3)


def dressed(path: Path, scale: float, *, metres: float = 1.0, body: bool = True, **folds: float) -> str:
    """A coat on a body at a scale of a person's, in metres unless the stage says otherwise."""
    stage = new_stage(path, up="Z", metres=metres)
    add_mesh(stage, COAT, coat(scale, **folds), quads_of(AROUND, ROWS, closed=True))
    if body:
        shape = UsdGeom.Cylinder.Define(stage, "/World/body")
        shape.CreateRadiusAttr(scale * RADIUS)
        shape.CreateHeightAttr(scale * 0.6)
        shape.GetPrim().AddAppliedSchema(COLLIDER_API)
    return save(stage)


def apart(shot: str, folder: Path, scale: float, *overrides: str) -> np.ndarray:
    """Distances of the refined coat from the body [m]."""
    layer = folder / f"{len(overrides)}.usdc"
    refine(Path(shot), layer, level=1, steps=60, overrides=list(overrides))
    points = fine(Path(shot), layer, None, prim=COAT)
    return np.hypot(points[:, 0], points[:, 1]) - scale * RADIUS


def test_a_dolls_coat_keeps_its_distance_and_folds(tmp_path: Path):
    """Its cage is 0.3 to 0.8 mm off the body; 2 mm irons its folds out."""
    soft = "bendStiffness=1e-9", "refine:raiseBending=off"  # No fabric of a person's folds within 10 mm.
    shot = dressed(tmp_path / "s.usda", DOLL)
    low, middle, high = np.percentile(1e3 * apart(shot, tmp_path, DOLL, *soft), [5, 50, 95])
    assert middle < 0.7
    assert high - low > 0.25
    assert "physgraph:contact:offset is taken as 0.3" in said(open_shot(shot))
    low, high = np.percentile(1e3 * apart(shot, tmp_path, DOLL, *soft, "contact:offset=0.002"), [5, 95])
    assert low > 1.9
    assert high - low < 0.1
    assert "physgraph:contact:offset of 2 mm hides" in said(open_shot(shot, overrides=["contact:offset=0.002"]))


@pytest.mark.parametrize(("scale", "keeps"), [(1.0, 1.9), (DOLL, 0.3)])
def test_cloth_inside_comes_out_whatever_its_size(tmp_path: Path, scale: float, keeps: float):
    shot = dressed(tmp_path / "s.usda", scale, gap=-0.004, folds=0.002)
    assert 1e3 * apart(shot, tmp_path, scale).min() > keeps
    assert ("offset" in said(open_shot(shot))) == (scale < 1.0)


@pytest.mark.parametrize(("scale", "metres", "likely"), [(150.0, 1.0, 0.01), (5000.0, 0.01, 0.001), (0.6, 0.1, 1.0)])
def test_units_of_no_garment_on_a_body_are_named(tmp_path: Path, scale: float, metres: float, likely: float):
    """In the first stage a coat of 41 m that was modelled in centimetres."""
    found = said(open_shot(dressed(tmp_path / "s.usda", scale, metres=metres)))
    assert f"garments on bodies are believed from 0.02 to 10 m: set metersPerUnit to {likely:g}" in found
    assert "metersPerUnit" not in said(open_shot(dressed(tmp_path / "alone.usda", scale, metres=metres, body=False)))


@pytest.mark.parametrize("scale", [DOLL, 1.0, 10.0])
def test_sizes_from_a_dolls_to_a_giants_are_believed(tmp_path: Path, scale: float):
    assert "metersPerUnit" not in said(open_shot(dressed(tmp_path / "s.usda", scale)))
