"""``physgraph.toml``: a show's defaults, found above the shot, and refused where they are no options."""

import json
from pathlib import Path
from typing import Any

import pytest
from shots import cloth_shot, run

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.report import RefineReport


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    folder = tmp_path / "show" / "seq" / "shot"
    folder.mkdir(parents=True)
    return cloth_shot(folder / "s.usda", times=(1.0, 2.0))


def planned(shot: Path, *args: object) -> dict[str, Any]:
    """The report of a dry run."""
    done = run("refine", shot, "-o", shot.parent / "o.usdc", "--dry-run", *args)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def write(folder: Path, text: str, name: str = "physgraph.toml") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def test_it_is_found_above_the_shot_and_the_command_line_goes_first(shot: Path) -> None:
    file = write(shot.parents[2], '[refine]\nlevel = 0\nsteps = 3\nset = ["material:density=0.3"]\nstrict = true\n')
    report = planned(shot, "--steps", "4")
    assert (report["options"]["level"], report["options"]["steps"]) == (0, 4)
    assert report["options"]["overrides"] == ["material:density=0.3"]
    assert report["garments"][0]["fabric"]["density"] == pytest.approx(0.3)
    told = {name: report["option_sources"][name] for name in ("level", "steps", "overrides", "contact")}
    assert told == {"level": str(file), "steps": "command line", "overrides": str(file), "contact": "default"}


def test_what_is_named_goes_before_the_environment_and_that_before_the_folders(
    shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(shot.parent, "[refine]\nsteps = 1\n")
    assert planned(shot)["options"]["steps"] == 1
    monkeypatch.setenv("PHYSGRAPH_CONFIG", str(write(tmp_path, "[refine]\nsteps = 2\n", "two.toml")))
    assert planned(shot)["options"]["steps"] == 2
    named = write(tmp_path, '[refine]\nsteps = 3\nframes = "1:1"\n', "three.toml")
    report = planned(shot, "--config", named)
    assert (report["options"]["steps"], report["options"]["frames"]) == (3, [1.0, 1.0])


def test_each_shot_has_its_own(shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    levels: dict[str, int | None] = {}

    def refine_shots(jobs: list[tuple[str, Path, RefineOptions]], **_: object) -> list[RefineReport]:
        levels.update({Path(each).stem: options.level for each, _, options in jobs})
        return [RefineReport(each, out, {}) for each, out, _ in jobs]

    monkeypatch.setattr("physgraph_usd.shot.refine.refine_shots", refine_shots)
    other = cloth_shot(tmp_path / "other.usda", times=(1.0, 2.0))
    write(shot.parent, "[refine]\nlevel = 0\n")
    write(tmp_path, "[refine]\nlevel = 1\n")
    done = run("refine", shot, other, "-o", tmp_path)
    assert done.exit_code == 0, done.output
    assert levels == {"s": 0, "other": 1}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[refine]\nlevl = 1\n", "unknown key 'levl'; did you mean level?"),
        ("[refin]\nlevel = 1\n", "unknown table 'refin'; did you mean refine?"),
        ("[refine]\nzzz = 1\n", "unknown key 'zzz'; known: asset-paths"),
        ("[refine]\noverwrite = true\n", "overwrite is of one run; give it on the command line"),
        ("[refine]\nsteps = -1\n", "steps: -1 is not in the range"),
        ('[refine]\ncontact = "hard"\n', "contact: 'hard' is not one of"),
        ("[refine]\nvelocities = 1\n", "velocities: 1 is not true or false"),
        ('[refine]\nset = "a=1"\n', "set: 'a=1' is not a list"),
        ("[refine]\nlevel = true\n", "level: True is not a text or a number"),
        ("[refine\n", "cannot read"),
        ("refine = 1\n", "write [refine]"),
    ],
)
def test_what_it_cannot_mean_is_refused_by_name(shot: Path, text: str, said: str) -> None:
    file = write(shot.parent, text)
    done = run("refine", shot, "-o", shot.parent / "o.usdc")
    assert (done.exit_code, str(file) in done.stderr, said in done.stderr) == (2, True, True), done.stderr


def test_a_file_that_is_named_and_not_there_is_refused(shot: Path, tmp_path: Path) -> None:
    done = run("refine", shot, "-o", tmp_path / "o.usdc", "--config", tmp_path / "no.toml")
    assert (done.exit_code, "no.toml" in done.stderr) == (2, True)
