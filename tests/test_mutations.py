"""The list of deliberate defects fits the present code; `python -m tests.mutations` sees that each is caught."""

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
