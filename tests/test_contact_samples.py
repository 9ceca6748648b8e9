"""Samples that are about contact: their cages do not cross, stay out of their bodies, and can be refined."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="samples are written with usd-core")

from shots import faults, refine, sample_times
from stages import built

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.usd.read.reader import open_shot

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


FAST = ("crossing", "hood")
"""Samples that are made and refined in seconds."""


def frames_of(name: str) -> list[float]:
    """Its first frame, one in the middle, and its last."""
    times = built(name).times
    return [float(times[index]) for index in (0, SHOTS[name].frames // 2, SHOTS[name].frames - 1)]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name not in FAST else name for name in SHOTS]
)
def test_cages_do_not_cross_and_stay_out_of_bodies(sample: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    told, layer = SHOTS[name], tmp_path / "fine.usdc"
    for time in frames_of(name):
        report = refine(sample(name), layer, frames=(time, time), level=0, steps=0, overwrite=True)
        for entry in report.frames[0]["garments"]:
            contact = entry.get("contact", {})
            for body in contact.get("bodies", {}).values():
                before = body["before"]
                assert before["percent"] <= 100.0 * told.inside, (time, before)
                assert before["deepest_mm"] <= max(told.deepest_mm, 1e3 * DEEP), (time, before)
            crossed = contact.get("cloth", {"before": {"crossings": 0}})["before"]["crossings"]
            assert (crossed > 0) <= (name == "crossing"), (time, crossed)
        root = built(name).name
        assert all(sample_times(layer, f"/{root}/{mesh}") == (time,) for mesh in told.garments)
    assert faults(layer, sample(name)) == []


@pytest.mark.slow
@pytest.mark.parametrize(("ripple", "first"), [(0.0015, 0), (0.0015, 9), (0.002, 0), (0.0025, 9)])
def test_a_coat_over_a_shirt_comes_apart_from_any_first_frame(
    sample: Callable[[str], Path], ripple: float, first: int
) -> None:
    """The cages cross over 3,000 times: a rule that gave up such tangles by their size left 5,800 crossings.

    Args:
        sample: Writes a sample.
        ripple: Change of the cages' points [mean edges].
        first: Number of the first of two frames.
    """
    shot = open_shot(str(sample("overcoat")))
    random, moved = np.random.default_rng(1), []
    for garment in shot.scene.garments:
        ends = garment.rest[garment.mesh.half_edges.edges]
        edge = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean()
        moved.append(ripple * edge * random.uniform(-1.0, 1.0, garment.rest.shape))
    refiner = Refiner(shot.scene, RefineOptions().solve_settings(), levels=[1] * len(moved))
    for time in shot.scene.times[first : first + 2]:
        frame = shot.frame(time)
        pairs = zip(frame.garments, moved, strict=True)
        rippled = [replace(garment, points=garment.points + move) for garment, move in pairs]
        told = refiner.solve(replace(frame, garments=rippled)).garments[0].telemetry
        cloth = told["contact"]["cloth"]
        assert cloth["before"]["crossings"] > 3000
        assert cloth["after"]["crossings"] == 0


def test_folds_twice_as_high_cross_nothing(tmp_path: Path) -> None:
    """Without a safe move after the scale they would cross, and follow the subdivided cage there."""
    shot = write_sample("hood", tmp_path)
    report = refine(shot, tmp_path / "fine.usdc", steps=30, frames=(1.0, 1.0), overrides=["detail=2"])
    told = report.frames[0]["garments"][0]
    assert told["contact"]["cloth"]["after"]["crossings"] == 0
    assert not told.get("follows_cage")
