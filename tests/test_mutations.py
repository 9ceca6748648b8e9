"""The list of deliberate defects fits the present code; `python -m tests.mutations` sees that each is caught."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from mutations.entries import Mutation, mutated, place_of, read_list

ROOT = Path(__file__).resolve().parents[1]
LIST = read_list()
DEFINITIONS = (ast.ClassDef, ast.FunctionDef)


def test_there_are_enough_and_each_is_one():
    assert len(LIST) >= 20
    assert len({each.name for each in LIST}) == len(LIST)
    assert len({(each.old, each.new) for each in LIST}) == len(LIST)


@pytest.mark.parametrize("mutation", LIST, ids=[each.name for each in LIST])
def test_it_applies_to_the_present_text(mutation: Mutation):
    text = mutated(mutation, ROOT)
    assert text != place_of(mutation, ROOT).read_text(encoding="utf-8")
    ast.parse(text)
    assert mutation.breaks
    assert mutation.tests
    for test in mutation.tests:
        file, *names = test.split("::")
        body = ast.parse((ROOT / file).read_text(encoding="utf-8")).body
        for name in names:
            (found,) = (each for each in body if isinstance(each, DEFINITIONS) and each.name == name)
            body = found.body


def test_a_defect_is_found_where_its_text_was_moved_to(tmp_path: Path):
    folder = tmp_path / "physgraph_usd" / "inner"
    folder.mkdir(parents=True)
    (folder / "new.py").write_text("a = 1\nb = 2\n")
    mutation = Mutation("x", "old.py", "b = 2", "b = 3", "b", ["tests/test_b.py"])
    assert place_of(mutation, tmp_path) == folder / "new.py"
    assert mutated(mutation, tmp_path) == "a = 1\nb = 3\n"
    (folder / "other.py").write_text("b = 2\n")
    with pytest.raises(LookupError, match="in 2 files"):
        place_of(mutation, tmp_path)
    (folder / "other.py").write_text("")
    (folder / "new.py").write_text("b = 2\nb = 2\n")
    with pytest.raises(LookupError, match="2 times"):
        place_of(mutation, tmp_path)
