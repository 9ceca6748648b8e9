"""The solver's numbers: found, counted, changed in a running process; and what is said of their effects."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pxr", reason="the judge reads stages with usd-core")

from shots import cloth_shot

from benchmarks.constants import Number, changed, counts, numbers_in
from benchmarks.effects import BASE_RIPPLES, Effects, counted, page
from benchmarks.judge_shot import Job, judged
from benchmarks.numbers import Variant, run_variant
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.settings import SolveSettings

ROOT = Path(__file__).resolve().parents[1]
CODE = '''
import math
import warp as wp
from dataclasses import dataclass
from .other import BORROWED
PLAIN = 3
"""A whole number."""
TURN: float = math.cos(math.radians(60.0))
PAIR, POWER = 0.5, 2.0**8
STEPS = (0.0, 0.25, -1)
FIRST, SECOND = (wp.constant(each) for each in range(2))
IN_KERNEL = 8
LIFTED = wp.constant(wp.float64(1.0e30))
NEVER = -float("inf")
DERIVED = 2 * PLAIN
TABLE = {"a": 1.0}
NAME = "text"
READY = True
lower = 5

@dataclass(frozen=True)
class Settings:
    stiff: float = 15.0
    count: int = 0
    on: bool = True

@wp.kernel
def kernel():
    x = IN_KERNEL

def plain(leaf: int = PLAIN):
    limit = 7
'''


@pytest.fixture(scope="module")
def numbers() -> list[Number]:
    return numbers_in(ROOT)


def named(numbers: list[Number], file: str, label: str) -> Number:
    return next(each for each in numbers if (each.file, each.label) == (file, label))


def test_numbers_are_found_by_their_rule(tmp_path: Path):
    room = tmp_path / "physgraph_usd" / "solver" / "contact"
    room.mkdir(parents=True)
    (room / "one.py").write_text(CODE, "utf-8")
    (room / "other.py").write_text("BORROWED = 4.0\n\ndef use(): return BORROWED\n", "utf-8")
    found = numbers_in(tmp_path)
    assert {each.label: (each.value, each.fixed) for each in found} == {
        "PLAIN": (3, "a default argument"),
        "TURN": (pytest.approx(0.5), ""),
        "PAIR": (0.5, ""),
        "POWER": (256.0, ""),
        "STEPS[0]": (0.0, ""),
        "STEPS[1]": (0.25, ""),
        "STEPS[2]": (-1, ""),
        "FIRST": (0, "a label"),
        "SECOND": (1, "a label"),
        "IN_KERNEL": (8, "in a kernel"),
        "LIFTED": (1e30, "warp constant"),
        "NEVER": (-float("inf"), "infinite"),
        "Settings.stiff": (15.0, ""),
        "BORROWED": (4.0, ""),
    }
    assert counts(found) == {"contact": 14}
    assert named(found, "contact/other.py", "BORROWED").importers == ("physgraph_usd.solver.contact.one",)


def test_a_name_means_one_thing():
    """A constant or a class of the solver has a name of its own."""
    places: dict[str, set[str]] = {}
    for file in (ROOT / "physgraph_usd" / "solver").rglob("*.py"):
        for node in ast.parse(file.read_text("utf-8")).body:
            targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
            names = [each for target in targets for each in getattr(target, "elts", [target])]
            found = [each.id for each in names if isinstance(each, ast.Name) and each.id.isupper()]
            found += [node.name] if isinstance(node, ast.ClassDef) else []
            for name in found:
                if not name.startswith("_"):
                    places.setdefault(name, set()).add(str(file))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


def test_half_and_double_keep_whole_numbers_whole_and_at_least_one():
    def variants(value: float) -> dict[str, float]:
        return Number("physgraph_usd.solver.contact.one", "A", None, value).variants

    assert variants(5) == {"half": 2, "double": 10}
    assert variants(1) == {"double": 2}
    assert variants(0.5) == {"half": 0.25, "double": 1.0}
    assert variants(0.0) == {}
    assert Number("a", "A", None, 5, "in a kernel").variants == {}


def test_a_changed_number_reaches_every_module_that_imports_it_and_comes_back(numbers: list[Number]):
    several = [each for each in numbers if each.importers and each.variants and each.room != "mesh"]
    assert several
    for number in several:
        modules = [importlib.import_module(each) for each in (number.module, *number.importers)]
        with changed(number, 1234):
            assert [getattr(each, number.name) for each in modules] == [1234] * len(modules)
        assert {getattr(each, number.name) for each in modules} == {number.value}
    element = next(each for each in numbers if each.element == 1)
    module = importlib.import_module(element.module)
    old = getattr(module, element.name)
    with changed(element, 1234.0):
        assert getattr(module, element.name) == (old[0], 1234.0, *old[2:])
    assert getattr(module, element.name) is old


def test_a_changed_default_reaches_the_settings_of_a_run(numbers: list[Number]):
    before = RefineOptions().solve_settings()
    for name, value in (("steps", 7), ("tether", 1.0), ("tolerance", 0.5)):
        with changed(named(numbers, "frame/settings.py", f"SolveSettings.{name}"), value):
            assert getattr(RefineOptions().solve_settings(), name) == value
            assert getattr(SolveSettings(), name) == value
    with changed(named(numbers, "contact/settings.py", "ContactSettings.way_out"), 0.9):
        assert RefineOptions().solve_settings().contact.way_out == 0.9
    assert RefineOptions().solve_settings() == before


def test_a_number_without_effect_takes_one_run_and_one_with_an_effect_three(numbers: list[Number], tmp_path: Path):
    shot = cloth_shot(tmp_path / "sheet.usda")
    jobs = tuple(Job(str(shot), level=1, count=2, ripple=0.2, seed=seed) for seed in range(3))
    base = judged(jobs[0])
    stop = Variant("sheet", jobs, named(numbers, "frame/settings.py", "SolveSettings.tolerance"), "double")
    found = run_variant(stop, base, 100.0)
    assert len(found) == 3
    assert found[0]["energy"] != base["energy"]
    rounds = Variant("sheet", jobs, named(numbers, "contact/promise.py", "ROUNDS"), "double")
    assert [each["energy"] for each in run_variant(rounds, base, 100.0)] == [base["energy"]]
    assert run_variant(rounds, None, 1e-3).startswith("TimeoutError")


def figures(energy: float, jumps: int = 0, warm: float = 100.0) -> dict[str, float | None]:
    return {"energy": energy, "warm": warm, "first": 200.0, "cloth": 0, "bodies": 0, "jumps": jumps, "still": None}


def test_effects_beyond_the_noise_are_told_from_those_within():
    noise = [0.0, 1.0, -1.0, 0.5, -0.5, 0.8, -0.8, 0.3, -0.3]
    found: dict[str, Any] = {f"a: base {k}": [figures(100.0 + each)] for k, each in enumerate(noise)}
    found |= {f"b: base {k}": [figures(50.0 + each)] for k, each in enumerate(noise)}
    assert len(noise) == BASE_RIPPLES
    module = "physgraph_usd.solver.contact.one"
    worse, equal, idle, bad = (Number(module, name, None, 2.0) for name in ("WORSE", "EQUAL", "IDLE", "BAD"))
    fixed = Number(module, "FIXED", None, 2.0, "in a kernel")
    for kind, value in (("half", "1"), ("double", "4")):
        for scene, energy in (("a", 100.0), ("b", 50.0)):
            place = f"{scene}: contact/one.py"
            found[f"{place} IDLE {kind} {value}"] = [figures(energy)]
            found[f"{place} EQUAL {kind} {value}"] = [figures(energy + each, jumps=1) for each in (0.6, 0.1, -0.2)]
            shift = 4.0 if scene == "a" and kind == "half" else 0.0
            found[f"{place} WORSE {kind} {value}"] = [figures(energy + shift + each) for each in (0.6, 0.1, -0.2)]
            found[f"{place} BAD {kind} {value}"] = "ValueError: no"
    effects = Effects(found, ["a", "b"])
    assert [effects.kind_of(each) for each in (worse, equal, idle, bad, fixed)] == [
        "matters in a only",
        "equal within the noise",
        "no effect here",
        "matters in several scenes",
        "fixed: in a kernel",
    ]
    lines = page([worse, equal, idle, bad, fixed], found, ["a", "b"]).splitlines()
    row = next(line for line in lines if "`WORSE`" in line and "half" in line)
    assert "+2.2% (+a)" in row
    assert "fails in a: ValueError: no; fails in b" in next(line for line in lines if "`BAD`" in line)
    assert "**no effect here** (1): `contact/one.py IDLE`" in lines
    assert "| round contact: contact + collide | 5 |" in counted([worse, equal, idle, bad, fixed])
