"""What solves a frame is a function of what it is given: objects write their own fields as they are made, not after.

But for the places listed here, each with its reason. What hides behind another name, or in a cached property, is not
seen; `test_asked_twice.py` sees whether answers depend on it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "physgraph_usd" / "solver"
FOLDERS = ("contact", "collide", "frame")
OWN = {"self", "cls"}
MAKERS = {"__init__", "__post_init__", "__new__"}
MUTATORS = {"append", "extend", "insert", "add", "update", "setdefault", "clear", "pop", "popitem", "remove", "discard"}
ALLOWED = {
    # Of a frame, each answer found once.
    "contact/frame.py FrameContact.at: _views": "one a level",
    "contact/broad_phase.py Bodies._meets: _bounds": "of a pose, until the next one",
    "contact/broad_phase.py Bodies._posed: _surfaces": "of a pose, until the next one",
    "contact/cloth.py ClothView.look: _looked": "of the positions asked for last, and of no others",
    "contact/cloth.py ClothView.terms: came_near": "of the frame's report alone",
    "contact/springs.py ClothSprings.near: _near": "of the positions asked for last, and of no others",
    "contact/springs.py ClothSprings.blocking: _near": "at the end of the move asked for last",
    "contact/cloth.py ClothView.remember: _looked": "what the last frame found at those positions",
    # Functions of topology or of materials.
    "contact/cloth.py ClothContact.mesh: _meshes": "of a level and what is sewn there",
    "frame/group.py Group.forces_for: _forces": "of the materials; of the last ones alone",
    "frame/group.py Group._built: _integrators": "of the method",
    "frame/scene_frame.py SceneCloth.group: _groups": "one a set of garments solved together",
    # What goes on from frame to frame, or from one place to the next.
    "contact/broad_phase.py Bodies.forget: _meshes": "hierarchies are refitted from pose to pose",
    "contact/broad_phase.py Bodies.pose: _bounds": "the frame's poses",
    "contact/broad_phase.py Bodies.pose: _poses": "the frame's poses",
    "contact/broad_phase.py Bodies.pose: _surfaces": "the frame's poses",
}
"""Module, class and method, and the field; and why it may be written there."""
RUN = "Refiner"
"""The class that is a run: what goes on from frame to frame lies in its fields."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def field_of(node: ast.AST) -> str | None:
    """The field of ``self`` or ``cls`` that a target is, or lies in; None if it is none."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in OWN:
            return node.attr
        node = node.value
    return None


def called_on(call: ast.Call) -> str | None:
    """The field of ``self`` that a call changes in place; None if it changes none, as far as its name tells."""
    if not isinstance(call.func, ast.Attribute):
        return None
    name = call.func.attr
    if name == "__setattr__" and len(call.args) > 1 and ast.unparse(call.args[0]) in OWN:
        return ast.unparse(call.args[1]).strip("'\"")
    in_place = name.endswith("_") and not name.endswith("__")  # As torch names what writes to a tensor.
    return field_of(call.func.value) if name in MUTATORS or in_place else None


def written(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Class and method, and the field of ``self`` that it writes, outside what makes the object."""
    for owner in ast.walk(tree):
        if not isinstance(owner, ast.ClassDef):
            continue
        for method in owner.body:
            if not isinstance(method, Function) or method.name in MAKERS:
                continue
            for node in ast.walk(method):
                target = isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store | ast.Del)
                field = field_of(node) if target else called_on(node) if isinstance(node, ast.Call) else None
                if field is not None:
                    yield f"{owner.name}.{method.name}", field


def test_nothing_is_written_but_what_is_listed():
    files = sorted(file for folder in FOLDERS for file in (PACKAGE / folder).rglob("*.py"))
    assert {file.parent.name for file in files} == set(FOLDERS)
    found = {
        f"{file.relative_to(PACKAGE).as_posix()} {place}: {field}"
        for file in files
        for place, field in written(ast.parse(file.read_text(encoding="utf-8")))
        if place.partition(".")[0] != RUN
    }
    assert not found - ALLOWED.keys(), "written after it was made"
    assert not ALLOWED.keys() - found, "what is not written any more needs no line here"
    assert all(ALLOWED.values())
