"""Each program of benchmarks/ makes one cheap row, so that none breaks unseen.

The rows of `benchmarks.converged` and of the judge are in test_converged.py and test_versions.py. Newton's own
simulations need another package, and the films' encoding the program ffmpeg: those are left out.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pxr", reason="programs read stages with usd-core")

from shots import cloth_shot, refine

from benchmarks.judge_shot import RIPPLES
from benchmarks.unseen import cases
from physgraph_usd.lab.chart import reference

NUMBER = "SolveSettings.steps"
RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"


class Here:
    """A pool whose tasks run in this process."""

    def __init__(self, *_: object, **__: object) -> None:
        self.map = map

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *_: object) -> None: ...

    def submit(self, call: Callable[..., Any], *args: object) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(call(*args))
        return done


SMALL = {"ProcessPoolExecutor": Here, "STEPS": 2}
Program = Callable[..., str]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Program:
    """A function that runs a program with other constants, and gives what it prints."""

    def run(name: str, *words: object, **constants: Any) -> str:
        module = import_module(f"benchmarks.{name}")
        for constant, value in constants.items():
            monkeypatch.setattr(module, constant, value)
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        with suppress(SystemExit):
            module.main()
        return capsys.readouterr().out

    return run


@pytest.fixture
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The least energy of a frame is looked for from three starts alone, of few steps."""
    few = {"STARTS": reference.STARTS[:1] * 2, "ROUNDS": 0, "MORE": 0, "POLISHES": 0}
    for name, value in few.items():
        monkeypatch.setattr(reference, name, value)


def last_row(text: str) -> list[str]:
    """Cells of the last row of a table."""
    rows = [line for line in text.splitlines() if line.startswith("|")]
    return [cell.strip() for cell in rows[-1].strip("|").split("|")]


ROWS: dict[str, tuple[tuple[str, ...], dict[str, Any], int]] = {
    "contact_shots": (("--frames", "1", "--level", "0", "--shot", "crossing"), {}, 14),
    "costs": (("--level", "0"), {"SAMPLES": {"swatch": 0}}, 4),
    "step": (("--most", "1000"), {"REPEATS": 2}, 7),
    "temporal": (("swatch",), {"RUNS": (("off", 0.0),), "FRAMES": 4}, 5),
    "tune": (("--processor", "--moves", "1", "--shot", "swatch"), {}, 6),
}
"""Programs that print a table: their words, other constants, and the number of cells in a row."""


@pytest.mark.parametrize("name", ROWS)
def test_a_table_has_a_row(program: Program, name: str):
    words, constants, cells = ROWS[name]
    assert len(last_row(program(name, *words, **constants))) == cells


def test_a_chunk_is_compared_with_the_whole_run(program: Program):
    rows = program("seams", "--short", "--preroll", "2", CASES=(("swatch", 0, {}),)).splitlines()
    assert [row.split()[0] for row in rows[1:]] == ["swatch"] * 2


def test_ease_adds_curvature(program: Program, tmp_path: Path):
    shot, constants = cloth_shot(tmp_path / "sheet.usda"), {"EASES": (0.0, 4.0), "LEVEL": 1}
    row = last_row(program("ease", shot, "--frames", "1:2", "--pictures", tmp_path, **constants))
    assert (row[:2], float(row[5]) > 1.0) == (["sheet", "4%"], True)
    assert (tmp_path / "ease_sheet.png").is_file()


def test_a_drawn_surface_is_measured(program: Program, tmp_path: Path):
    shot, layer = cloth_shot(tmp_path / "sheet.usda"), tmp_path / "fine.usdc"
    refine(shot, layer)
    assert len(program("drawn_surface", shot, layer, 2.0).splitlines()) == 3


@pytest.mark.usefixtures("short_search")
def test_networks_stand_beside_quasi_newton(program: Program):
    words = ("--shots", "swatch", "--fabrics", "jersey", "--gaps-only")
    constants = {"SCHEDULES": ((1, 1), (2, 1)), "REPEATS": 1, "cases": partial(cases, level=1)}
    assert last_row(program("learned", *words, **constants))[0] == "physgraph-paper"


@pytest.mark.usefixtures("short_search")
def test_convergence_has_its_table_and_picture(program: Program, tmp_path: Path):
    config = replace(import_module("benchmarks.convergence").CONFIG, count=1, levels=(1, 1), most_vertices=200)
    curves = {"STEPS": 10, "ADAM_SWEEP": (), "GRADIENT_SWEEP": (), "trained_like": None}
    module = import_module("benchmarks.convergence")
    curves["trained_like"] = partial(module.trained_like, config=replace(config, reference_steps=2))
    text = program("convergence", "--out", tmp_path / "convergence.png", **curves)
    assert "| quasi-Newton, nested |" in text
    assert (tmp_path / "convergence.png").is_file()


def test_a_number_of_the_solver_is_halved_and_doubled(program: Program, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("benchmarks.effects.BASE_RIPPLES", 2)
    constants = {"BASE_RIPPLES": 2, "RIPPLES": RIPPLES[:1], "SCENES": {"swatch": ("swatch", 0, 1)}}
    text = program("numbers", "--only", NUMBER, **constants, _pool=Here, as_completed=list)
    assert f"`{NUMBER}`" in text
    assert "## By class" in text


def test_the_judge_prints_what_was_measured(program: Program, tmp_path: Path):
    runs = []
    for version, energy in (("older", 2.0), ("this", 1.0)):
        for ripple in RIPPLES:
            asked = {"row": "sheet", "version": version, "code": "", "job": {"count": 3, "first": 0, "level": 1}}
            asked["job"]["ripple"] = ripple
            runs.append(asked | {"figures": {"energy": energy + ripple, "warm": 10.0}})
    (tmp_path / "runs.json").write_text(json.dumps({"runs": runs}), "utf-8")
    text = program("versions", "--from-json", tmp_path / "runs.json")
    assert "| energy [mJ] | - | 1 | 0 | 0 | sheet | - |" in text


def test_a_preset_is_drawn(program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("benchmarks.fidelity.STEPS", 2)
    constants = {"QUADS": 6, "FRAMES": 2, "ProcessPoolExecutor": Here}
    assert "| silk | " in program("swatches", tmp_path, "silk", **constants)
    program("swatches", tmp_path, "silk", "--thumbnails", **constants)
    assert len([*tmp_path.iterdir()]) == 4


@pytest.mark.parametrize("words", [("--paired",), ()])
def test_refined_cloth_stands_beside_a_fine_simulation(program: Program, tmp_path: Path, words: tuple[str, ...]):
    constants = SMALL | {"LEVEL": 1, "PAIRED": ("flag",), "GUIDES": (2000.0,), "OURS": ("flag",)}
    constants |= {"FILMED": [("flag", "ours", "jersey")], "STRIDE": 8, "PANEL": (60, 68)}
    program("fidelity", "--short", "-o", tmp_path / "page.md", *words, **constants)
    assert last_row((tmp_path / "page.md").read_text("utf-8"))[0] == "flag"
    assert (tmp_path / "fidelity_flag_jersey.webp").exists() == (not words)


def test_rows_beside_newton_are_written_anew(program: Program, tmp_path: Path):
    rows = json.loads((RESULTS / "newton.json").read_text("utf-8"))
    (tmp_path / "rows.json").write_text(json.dumps([row for row in rows if row["scene"] == "body"]), "utf-8")
    page, picture = tmp_path / "page.md", tmp_path / "chart.webp"
    program("beside_newton", "-o", page, "--picture", picture, "--rows", tmp_path / "rows.json")
    assert picture.is_file()
    assert page.read_text("utf-8").splitlines()[-1] in (RESULTS / "newton.md").read_text("utf-8")


def test_a_part_of_the_papers_page_is_measured(program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("benchmarks.step.MOST", {True: (1000, 0)})
    texts = [program("paper.__main__", "--short", "--only", "timing", CACHE=tmp_path) for _ in range(2)]
    assert "quasi-newton on this CPU" in texts[0]
    assert texts[0] == texts[1], "what is in the journal is not measured again"


def test_contact_is_drawn(program: Program, tmp_path: Path):
    program("pictures", tmp_path, "crossing", LEVEL=0, PREROLL=0, PANEL=(108, 84))
    assert (tmp_path / "contact_crossing.png").is_file()


def test_a_film_has_its_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    films, shot = import_module("benchmarks.films"), cloth_shot(tmp_path / "sheet.usda")
    monkeypatch.setattr(films, "LEVEL", 1)
    monkeypatch.setattr(films, "encode", lambda *_, **__: None)
    films.film(shot, films.Shown("A sheet", (1.0, 2.0), (20.0, 10.0)), tmp_path / "fine.usdc", tmp_path / "sheet.mp4")
    figures = json.loads((tmp_path / "figures.json").read_text("utf-8"))["sheet"]
    assert (figures["frames"], figures["crossings"]) == (2, [0, 0])
    assert (tmp_path / "sheet.jpg").is_file()
