"""Types of command-line values missing in click."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import click

_RANGE = re.compile(r"(-?[\d.]+)-(-?[\d.]+)")


class Text(click.ParamType):
    """A parameter parsed by a function; the function's ValueError is the message to the user."""

    def __init__(self, name: str, read: Callable[[str], Any]) -> None:
        """Take the type's name and the function."""
        self.name, self._read = name, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Turn a text into a value; other values are returned unchanged."""
        try:
            return self._read(value) if isinstance(value, str) else value
        except ValueError as error:
            self.fail(str(error), param, ctx)


def _frame_range(text: str) -> tuple[float, float]:
    """Time codes ``A:B``, or one time code ``A``; ``A-B`` too, as farms write the frames of a task."""
    first, colon, last = _RANGE.sub(r"\1:\2", text).partition(":")
    try:
        span = float(first), float(last if colon else first)
    except ValueError:
        raise ValueError(f"{text!r} is not a frame range; write A:B or A, for example 1001:1024") from None
    if not span[0] <= span[1]:
        raise ValueError(f"{text!r} ends before it starts")
    return span


def _level(text: str) -> int | None:
    """A number of subdivisions; -1 for ``auto``; None, the default, for a farm's empty parameter."""
    if text in ("", "auto"):
        return -1 if text else None
    if not text.isdecimal():
        raise ValueError(f"{text!r} is neither a whole number nor 'auto'")
    return int(text)


def _rest(text: str) -> float | str:
    """A time code, or ``auto``."""
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise ValueError(f"{text!r} is neither a time code nor 'auto'") from None


def _size(text: str) -> tuple[int, int]:
    """Width and height in pixels, ``1280x640``."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ValueError(f"{text!r} is not a size; write WxH, for example 1280x640")
    return int(width), int(height)


FRAME_RANGE, LEVEL, REST = Text("A:B", _frame_range), Text("level", _level), Text("rest", _rest)
PICTURE_SIZE = Text("WxH", _size)
