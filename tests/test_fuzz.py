"""A mutant of each kind in this process, and the fuzzer's machinery: `python -m tests.fuzz` runs thousands."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.bases import BASES, write_bases
from fuzz.kinds import KINDS
from fuzz.trial import GOOD, attempt
from shots import faults, refine

ROOT = Path(__file__).resolve().parents[1]
SAFE = [number for number, kind in enumerate(KINDS) if kind.in_process]
PARTS = 3
"""Mutants are tried in a few groups, so that they spread over processes and a failure names its group."""


@pytest.fixture(scope="module")
def bases(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bases")
    write_bases(folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", BASES)
def test_the_shots_that_mutants_are_made_from_are_sound(bases: Path, tmp_path: Path, name: str):
    report = refine(bases / name / "shot.usda", tmp_path / "fine.usdc")
    assert report.exit_code == 0
    assert faults(tmp_path / "fine.usdc", bases / name / "shot.usda") == []


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("turn", [0, *(pytest.param(turn, marks=pytest.mark.slow) for turn in (1, 2, 3))])
@pytest.mark.parametrize("part", range(PARTS))
def test_mutants_end_in_a_layer_or_a_named_error(bases: Path, tmp_path: Path, part: int, turn: int):
    numbers = [number + turn * len(KINDS) for number in SAFE[part::PARTS]]
    outcomes = [attempt(number, KINDS, bases, tmp_path / str(number)) for number in numbers]
    bad = [f"{each.number} {each.kind}: {each.result}\n{each.detail}" for each in outcomes if each.result not in GOOD]
    assert not bad, "\n".join(bad)
    assert len({each.result for each in outcomes}) > 1


def test_a_loose_point_does_not_hold_up_the_last_resort(bases: Path, tmp_path: Path):
    """Rings round what crosses never reach it; they grew without end."""
    kind = next(kind for kind in KINDS if kind.name == "odd: points at one place")
    outcome = attempt(40414, (kind,), bases, tmp_path / "loose")
    assert outcome.said == ["shot 'bodies'", "/World/cloth: 2 pairs at one place, 1 loose points, 6 faces"]
    assert outcome.result == "done"


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="its children are limited in memory by a Unix call")
def test_the_command_runs_crates_in_processes_of_their_own(tmp_path: Path):
    line = [
        sys.executable,
        "-m",
        "tests.fuzz",
        "--mutants",
        "60",
        "--kind",
        "crate",
        "--failures",
        str(tmp_path / "bad"),
    ]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "crate: flip bits" in done.stdout
