"""Events of the page reach the session in the order in which they happened."""

from __future__ import annotations

import ast
import asyncio
from collections.abc import Callable, Coroutine, Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("viser", reason="the page is served with viser")

from physgraph_usd.studio.desk import Desk

STUDIO = Path(__file__).parents[1] / "physgraph_usd" / "studio"
TAKERS = {"on_update", "on_click", "on_drag", "on_trigger", "on_client_connect"}
"""What viser is given callbacks by."""


class Control:
    """Stands in for a control of viser's, and for what calls its callbacks."""

    value = 0
    callback: Callable[[Any], Coroutine[Any, Any, None]]

    def on_update(self, callback: Any) -> None:
        self.callback = callback

    on_click = on_update


def test_changes_of_a_control_are_asked_in_order_with_the_value_at_the_time():
    """As viser does it: callbacks that are coroutines one after another, before the next message is read."""
    asked: list[Callable[[Any], None]] = []
    seen: list[Any] = []
    session, loop = SimpleNamespace(garments=["/World/coat"]), SimpleNamespace(ask=asked.append)
    stands_in: dict[str, Any] = {"loop": loop, "picture": None, "notes": None}
    desk = Desk(None, session, **stands_in)  # pyright: ignore[reportArgumentType]
    control, button = Control(), Control()
    desk.on(control, lambda _, value: seen.append(value))
    desk.press(button, lambda _: seen.append("pressed"))

    async def messages() -> None:
        for value in range(100):
            control.value = value
            await control.callback(SimpleNamespace(client="the artist"))
        await control.callback(SimpleNamespace(client=None))  # The page's own.
        await button.callback(SimpleNamespace(client="the artist"))
        control.value = -1

    asyncio.run(messages())
    for change in asked:
        change(None)
    assert seen == [*range(100), "pressed"]


def is_taker(node: ast.AST) -> bool:
    """Whether viser is given a callback by calling this; `on_drag` is called with a button first."""
    taker = node.func if isinstance(node, ast.Call) else node
    return isinstance(taker, ast.Attribute) and taker.attr in TAKERS


def given(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and source of each callback that viser is given, or of the decorator under viser's."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for first, second in pairwise([*node.decorator_list, ast.Constant("none")]):
                if is_taker(first):
                    yield node.lineno, ast.unparse(second) + "("
        if isinstance(node, ast.Call) and node.args and is_taker(node.func):
            if not isinstance(node.args[0], ast.Constant):
                yield node.lineno, ast.unparse(node.args[0])


def test_viser_is_given_no_callback_that_its_pool_of_threads_would_call_in_any_order():
    found = [
        (file.name, line, source)
        for file in sorted(STUDIO.glob("*.py"))
        for line, source in given(ast.parse(file.read_text(encoding="utf-8")))
    ]
    assert len(found) >= 11
    assert [each for each in found if not each[2].startswith("in_order(") and each[2] != "moved"] == []
