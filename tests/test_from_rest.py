"""How far frames end from rest, in degrees of the surface: what `inspect --time` says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")

from shots import cloth_shot, run

from physgraph_usd.shot.from_rest import FromRest
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.usd.read.reader import open_shot


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "sheet.usda", times=(1.0, 2.0))


def followed(shot: Path, steps: int, *, measured: bool = True) -> tuple[list[np.ndarray], FromRest]:
    """Positions in each frame of a run with so many steps, and how far from rest the frames end."""
    prepare_device("cpu")
    opened, found = open_shot(str(shot), level=1), FromRest()
    settings = RefineOptions(steps=steps, tolerance=1e-6).solve_settings()
    settings = replace(settings, ended=found.note) if measured else settings
    refiner, points = Refiner(opened.scene, settings, levels=[1], threads=1), []
    for time in opened.scene.times:
        points.append(refiner.solve(opened.frame(time)).garments[0].points)
        if measured:
            found.measure()
    opened.close()
    return points, found


def test_measuring_changes_no_frame_to_the_bit(shot: Path):
    with_it, without = (followed(shot, 4, measured=measured)[0] for measured in (True, False))
    for a, b in zip(with_it, without, strict=True):
        assert np.array_equal(a, b)


def test_frames_with_more_steps_end_nearer_to_rest(shot: Path):
    few, many = (followed(shot, steps)[1].plain() for steps in (1, 80))
    assert many["degrees_nine_tenths"] < 0.5 * few["degrees_nine_tenths"]
    assert few["degrees_half"] <= few["degrees_nine_tenths"]


def test_inspect_says_how_far_from_rest_frames_end(shot: Path):
    found = inspect_shot(shot, timed=True, level=1)
    assert found["timed"]["whole_shot_seconds"] > 0
    rest = found["from_rest"]
    assert 0 <= rest["degrees_half"] <= rest["degrees_nine_tenths"] < 180
    assert f"within {rest['degrees_half']:g} degrees of where they would end" in rest["words"]
    assert "from_rest" not in inspect_shot(shot, level=1)


def test_the_command_says_it_in_words(shot: Path):
    result = run("inspect", shot, "--time", "--level", "1")
    assert result.exit_code == 0
    assert "the folds are within" in result.output


def test_without_a_solve_nothing_is_said():
    assert FromRest().plain() == {}
