"""Values of the command line's options that click has no type for."""

from __future__ import annotations

import re
from typing import Any

import click

_RANGE = re.compile(r"(-?[\d.]+)-(-?[\d.]+)")


class FrameRange(click.ParamType):
    """Time codes ``A:B``, or one time code ``A``; ``A-B`` too, as farms write the frames of a task."""

    name = "A:B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """Turn the text into the first and the last time code."""
        if isinstance(value, tuple):
            return value
        first, colon, last = _RANGE.sub(r"\1:\2", value).partition(":")
        try:
            span = float(first), float(last if colon else first)
        except ValueError:
            self.fail(f"{value!r} is not a frame range; write A:B or A, for example 1001:1024", param, ctx)
        if not span[0] <= span[1]:
            self.fail(f"{value!r} ends before it starts", param, ctx)
        return span


class RefineLevel(click.ParamType):
    """A number of subdivisions, or ``auto``, which is passed on as -1."""

    name = "level"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | None:
        """Turn the text into a level; none, as of a farm's parameter that was left empty, is the default."""
        if value == "":
            return None
        if value == "auto":
            return -1
        if not str(value).isdecimal():
            self.fail(f"{value!r} is neither a whole number nor 'auto'", param, ctx)
        return int(value)


class RestShape(click.ParamType):
    """A time code, or ``auto``."""

    name = "rest"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Turn the text into a time code, unless it is ``auto``."""
        try:
            return value if value == "auto" else float(value)
        except ValueError:
            self.fail(f"{value!r} is neither a time code nor 'auto'", param, ctx)


class PictureSize(click.ParamType):
    """Width and height in pixels, ``1280x640``."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Turn the text into width and height."""
        if isinstance(value, tuple):
            return value
        width, _, height = value.partition("x")
        if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
            self.fail(f"{value!r} is not a size; write WxH, for example 1280x640", param, ctx)
        return int(width), int(height)
