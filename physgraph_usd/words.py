"""Words of messages: numbers of things, and how loud they are."""

from __future__ import annotations

NOTICE = 25
"""Level of what a run says without being asked and is nothing wrong, between logging's INFO and WARNING."""


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number of things: "1 frame", "1,024 frames".

    Args:
        number: How many.
        noun: One of them.
        plural: Several; the noun with an "s" where it is left out.
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"
