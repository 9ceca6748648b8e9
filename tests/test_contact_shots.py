"""Samples and real shots with their bodies: nothing left inside, no more crossings than in the input."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from shots import cloth_shot, refine

SHOTS: dict[str, tuple[list[str], list[str], tuple[float, float]]] = {
    "01_newton_shirt_dab_cm.usdc": (["/shot/char/shirt_geo"], ["/shot/char/body_geo"], (1037, 1045)),
    "02_makehuman_usdskel_dm.usdc": (["/shot/char/top", "/shot/char/shorts"], ["/shot/char/body"], (23, 24)),
    "06_torus_pull.usda": (["/shot/cloth"], ["/shot/torus"], (31, 32)),
    "08_sphere_spin_xformcollider.usdc": (["/shot/set/cloth"], ["/shot/set/rig/sphere"], (31, 32)),
    "09_cesiumman_kilt/shot.usda": (["/shot/kilt"], ["Cesium_Man_2"], (36, 37)),
    "12_variants/b_winding_flipped_unflagged.usdc": (["/shot/shirt"], ["/shot/body"], (6, 7)),
}


def bodies_of(report: Any) -> list[dict[str, Any]]:
    """What was measured against each body, of every frame and garment."""
    return [
        body
        for frame in report.frames
        for garment in frame["garments"]
        for body in garment.get("contact", {}).get("bodies", {}).values()
    ]


def check(report: Any) -> list[dict[str, Any]]:
    measured = bodies_of(report)
    for body in measured:
        assert body["after"]["inside"] == 0, body
        assert body["after"]["crossings"] <= body["before"]["crossings"], body
    return measured


@pytest.mark.real_data
@pytest.mark.slow
@pytest.mark.parametrize("name", SHOTS)
def test_real_shots(real_data: Path, tmp_path: Path, name: str):
    garments, colliders, frames = SHOTS[name]
    shot = real_data / "shots" / name
    report = refine(
        shot, tmp_path / "fine.usdc", level=2, steps=12, frames=frames, garments=garments, colliders=colliders
    )
    assert len(check(report)) >= 2


@pytest.mark.real_data
@pytest.mark.slow
def test_knees_that_come_up_through_a_kilt_end_under_it(real_data: Path, tmp_path: Path):
    """The way out of a body changes every few steps: with one long first round edges stay in the knees."""
    garments, colliders, _ = SHOTS["09_cesiumman_kilt/shot.usda"]
    shot, frames = real_data / "shots/09_cesiumman_kilt/shot.usda", (31, 38)
    report = refine(
        shot, tmp_path / "fine.usdc", level=2, steps=24, frames=frames, garments=garments, colliders=colliders
    )
    measured = check(report)
    assert all(body["before"]["crossings"] > 100 for body in measured)
    assert [body["after"]["crossings"] for body in measured] == [0] * 8


def test_why_contact_is_left_out_is_told(sample: Callable[[str], Path], tmp_path: Path):
    shot = cloth_shot(tmp_path / "sheet.usda")
    assert refine(shot, tmp_path / "a.usdc").left_out["contact"] == "no collider is tagged or named"
    off = refine(sample("skirt"), tmp_path / "b.usdc", contact="off", frames=(1.0, 1.0))
    assert "switched off" in off.left_out["contact"]
    assert bodies_of(off) == []
