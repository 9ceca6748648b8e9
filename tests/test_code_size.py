"""The rules of size and habit that no linter has; each rule is one function from source to complaints."""

import ast
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "physgraph_usd"
CODE_FOLDERS = (PACKAGE, "plugins", "samples", "tests", "benchmarks")
TEXT_SUFFIXES = {".py", ".md", ".toml", ".yaml", ".yml", ".json", ".usda", ".cfg", ".txt", ""}
MAX_MEMBERS = 12
WIDE = {
    "ChartOptions": 16,
    "Drape": 14,
    "Garment": 24,
    "GarmentSource": 17,
    "Job": 13,
    "LayerWriter": 14,
    "Level": 35,
    "LevelContact": 13,
    "LevelReport": 13,
    "MeshSurface": 16,
    "Metric": 13,
    "PaintPanel": 15,
    "Picture": 19,
    "PlainMesh": 16,
    "Point": 25,
    "PointTrack": 18,
    "Property": 14,
    "RefineOptions": 38,
    "RefineReport": 23,
    "Refiner": 13,
    "Shot": 15,
    "Simulation": 16,
    "SolveSettings": 13,
    "Topology": 14,
    "TrainConfig": 22,
    "Trainer": 13,
    "Tuning": 16,
    "_GarmentLevel": 16,
}
"""Classes with more public methods or fields than that, and how many: members leave this list, none join it."""
MAX_BODY_LINES = 40
MAX_POSITIONAL = 3
OWN_WORDS = {"told", "said", "lanes", "adopt", "met", "runup", "looking", "ways"}
MAY_CATCH_ALL = {"exceptions_named"}
"""The ends of a process use it: whatever ends a command or a worker must reach the user as a line, and the report. It
converts and swallows nothing."""
MACHINE_PATH = re.compile(r"(?<![\w.}])/(?:home|Users|work|farm|tmp|opt|mnt|scratch)/\w|\b[A-Z]:[\\/]+Users")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def trees() -> dict[str, ast.Module]:
    """The code of each file, by the file's name from the root."""
    files = sorted(file for folder in CODE_FOLDERS for file in (ROOT / folder).rglob("*.py"))
    return {str(file.relative_to(ROOT)): ast.parse(file.read_text(encoding="utf-8")) for file in files}


def text_files() -> list[Path]:
    folders = (*CODE_FOLDERS, "docs", "schemas", ".ci")
    inside = (file for folder in folders for file in (ROOT / folder).rglob("*"))
    files = (*ROOT.iterdir(), *inside)
    return sorted(file for file in files if file.is_file() and file.suffix in TEXT_SUFFIXES and file.name != ".git")


def functions(tree: ast.AST) -> Iterator[Function]:
    return (node for node in ast.walk(tree) if isinstance(node, Function))


def body_lines(function: Function) -> int:
    """Lines from the first statement after the docstring to the end."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def positional_after_third(function: Function) -> list[str]:
    """Arguments past the third, self and cls not counted, that can be given by position."""
    names = [argument.arg for argument in (*function.args.posonlyargs, *function.args.args)]
    counted = names[1:] if names[:1] in (["self"], ["cls"]) else names
    defaults = len(function.args.defaults)
    optional = set(names[-defaults:]) if defaults else set()
    return [name for name in counted[MAX_POSITIONAL:] if name in optional]


def too_long(tree: ast.AST) -> Iterator[str]:
    for function in functions(tree):
        lines = body_lines(function)
        if lines >= MAX_BODY_LINES:
            yield f"{function.lineno}: body of {function.name} has {lines} lines, {MAX_BODY_LINES - 1} allowed"


def options_by_position(tree: ast.AST) -> Iterator[str]:
    for function in functions(tree):
        for name in positional_after_third(function):
            yield f"{function.lineno}: option {name} of {function.name} must be keyword-only"


def prints(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
            yield f"{node.lineno}: print"


def broad_excepts(tree: ast.AST) -> Iterator[str]:
    allowed = {id(node) for each in functions(tree) if each.name in MAY_CATCH_ALL for node in ast.walk(each)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler) and id(node) not in allowed:
            caught = node.type.elts if isinstance(node.type, ast.Tuple) else [node.type]
            if any(kind is None or ast.unparse(kind) in {"Exception", "BaseException"} for kind in caught):
                yield f"{node.lineno}: catches everything"


def sums_out_of_order(tree: ast.AST) -> Iterator[str]:
    """Sums at repeated indices whose rounding changes from run to run on a CPU; `add_at` keeps the order."""
    allowed = {id(node) for each in functions(tree) if each.name == "add_at" for node in ast.walk(each)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and id(node) not in allowed:
            if any(keyword.arg == "accumulate" for keyword in node.keywords):
                yield f"{node.lineno}: {node.func.attr}; use add_at"


RULES = {rule.__name__: rule for rule in (too_long, options_by_position, prints, broad_excepts, sums_out_of_order)}


@pytest.mark.parametrize("rule", RULES)
def test_code_keeps_rule(rule: str) -> None:
    complaints = [f"{name}:{complaint}" for name, tree in trees().items() for complaint in RULES[rule](tree)]
    assert not complaints, "\n".join(complaints)


def public_methods(kind: ast.ClassDef) -> int:
    """Number of public methods of a class, properties left out."""
    methods = [each for each in kind.body if isinstance(each, ast.FunctionDef) and not each.name.startswith("_")]
    return sum(not any("property" in ast.unparse(mark) for mark in each.decorator_list) for each in methods)


def own_fields(kind: ast.ClassDef) -> int:
    """Number of fields of a class: annotated in its body, or assigned to self in its constructor."""
    targets = [each.target for each in kind.body if isinstance(each, ast.AnnAssign)]
    fields = {target.id for target in targets if isinstance(target, ast.Name)}
    for made in kind.body:
        if isinstance(made, ast.FunctionDef) and made.name == "__init__":
            written = [each for each in ast.walk(made) if isinstance(each, ast.Attribute)]
            mine = [each for each in written if isinstance(each.ctx, ast.Store) and ast.unparse(each.value) == "self"]
            fields |= {each.attr for each in mine}
    return len(fields)


def test_classes_hold_few_things() -> None:
    """A class has at most `MAX_MEMBERS` public methods and as many fields; `WIDE` only shrinks."""
    kinds = [
        node
        for file, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and not file.startswith("tests/")
    ]
    sizes = dict(sorted((kind.name, max(public_methods(kind), own_fields(kind))) for kind in kinds))
    assert {name: size for name, size in sizes.items() if size > MAX_MEMBERS} == WIDE


def test_names_speak_the_fields_language() -> None:
    """Words of our own that were renamed do not come back; what is inside contact gets its words when it is rebuilt."""
    found = set()
    for file in (ROOT / PACKAGE).rglob("*.py"):
        if not {"contact", "collide", "colliders"} & set(file.parts):
            with file.open(encoding="utf-8") as text:
                names = {
                    token.string for token in tokenize.generate_tokens(text.readline) if token.type == tokenize.NAME
                }
            found |= {f"{file.name}: {name}" for name in names if OWN_WORDS & set(re.findall("[a-z]+", name.lower()))}
    assert not found


def test_docstrings_begin_with_what_the_thing_is() -> None:
    texts = {
        f"{file.name}: {text[:60]}"
        for file in (ROOT / PACKAGE).rglob("*.py")
        if not {"contact", "collide", "colliders"} & set(file.parts)
        for text in re.findall(r'"""(.*)', file.read_text(encoding="utf-8"))
    }
    assert len(texts) > 1000
    assert not {text for text in texts if re.search(r": (The same|As|What)\b", text)}


def test_a_name_means_one_thing() -> None:
    """A constant or a class of the solver has a name of its own."""
    places: dict[str, set[str]] = {}
    for file, tree in trees().items():
        for node in tree.body if file.startswith(f"{PACKAGE}/solver/") else ():
            targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
            names = [each for target in targets for each in getattr(target, "elts", [target])]
            found = [each.id for each in names if isinstance(each, ast.Name) and each.id.isupper()]
            found += [node.name] if isinstance(node, ast.ClassDef) else []
            for name in found:
                if not name.startswith("_"):
                    places.setdefault(name, set()).add(file)
    assert places
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


def test_no_paths_of_one_machine() -> None:
    assert MACHINE_PATH.search("see " + "/".join(["", "home", "someone"]))
    assert not MACHINE_PATH.search("#!/usr/bin/env bash, </World/work/Coat>, ../tmp/x, https://example.org/opt/x")
    found = [
        f"{file.relative_to(ROOT)}: {match.group()}"
        for file in text_files()
        for match in MACHINE_PATH.finditer(file.read_text(encoding="utf-8"))
    ]
    assert not found, "\n".join(found)
