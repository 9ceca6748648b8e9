"""Samples that are about contact: their cages do not cross, stay out of their bodies, and can be refined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="samples are written with usd-core")

from piercing import depths, piercings, place
from shots import faults, refine, sample_times
from stages import built

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.usd.write.plain import PlainMesh

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


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SHOTS if name != "crossing"])
def test_cages_do_not_cross(name: str) -> None:
    garments = of_role(name, "garment")
    frames = range(SHOTS[name].frames)
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


@pytest.mark.parametrize("name", SHOTS)
def test_one_frame_is_refined(sample: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    middle = float(built(name).times[SHOTS[name].frames // 2])
    layer = tmp_path / "fine.usdc"
    refine(sample(name), layer, frames=(middle, middle), level=0)
    root = built(name).name
    assert all(sample_times(layer, f"/{root}/{mesh}") == (middle,) for mesh in SHOTS[name].garments)
    assert faults(layer, sample(name)) == []


def test_folds_twice_as_high_cross_nothing(tmp_path: Path) -> None:
    """Without a safe move after it the scale would have them cross 573 times."""
    shot = write_sample("hood", tmp_path)
    report = refine(shot, tmp_path / "fine.usdc", steps=30, frames=(1.0, 1.0), overrides=["detail=2"])
    told = report.frames[0]["garments"][0]["contact"]["cloth"]
    assert told["after"]["crossings"] == 0
