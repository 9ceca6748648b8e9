"""Writes strict JSON for any parser: a non-finite number becomes null."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any


def to_json(value: Any, *, indent: int | None = 2, default: Callable[[Any], Any] | None = None) -> str:
    """Plain values as JSON.

    Args:
        value: Records, lists, texts and numbers.
        indent: Spaces per level; None for a single line.
        default: Converts any value of another type to a plain value.

    Raises:
        TypeError: A value is not plain and ``default`` is None.
    """
    return json.dumps(_finite(value), indent=indent, default=default, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
