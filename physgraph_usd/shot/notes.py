"""Lines for the report and `inspect` that are no warnings: nothing is wrong, but cloth could look otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import join
from typing import Any

from ..errors import counted
from ..solver.fabric import NAMED
from ..solver.resolution import SHARP_FRACTION, LevelChoice
from ..usd.read.reader import Shot
from ..usd.schema import GARMENT
from .untagged import options_of

EASE = 4
"""Percent of weft ease that the note on slack proposes: of those in docs/fabrics.md, the one that folds every cage."""
MATERIALS = "stretchStiffness", "bendStiffness", "density"
"""Values of a fabric that every preset has."""


def of_slack(garments: Sequence[str], choices: Sequence[LevelChoice]) -> list[str]:
    """A note of the garments whose cages have no slack.

    Args:
        garments: Their paths.
        choices: Their levels.
    """
    tight = [f"<{path}>" for path, choice in zip(garments, choices, strict=True) if choice.is_tight]
    if not tight:
        return []
    cages = "this cage has" if len(tight) == 1 else "these cages have"
    words = f"{cages} no slack: expect what subdivision gives; for folds give --set weftEase={EASE}"
    return [f"{', '.join(tight)}: {words}"]


def of_fabrics(shot: Shot) -> list[str]:
    """A note for each preset that garments without a fabric of their own are named after.

    Args:
        shot: An open shot.
    """
    named: dict[str, dict[str, str]] = {}
    for source in shot.sources:
        word = next((word for word in source.words if word in NAMED), None)
        if word and all(source.sources[name] == "fallback" for name in MATERIALS):
            named.setdefault(NAMED[word], {})[str(source.path)] = word
    notes = []
    for preset, words in named.items():
        said = ", ".join(f"<{path}> ({word})" for path, word in words.items())
        out = str(Path(shot.path).with_suffix(f".{preset}.usda"))
        tag = ["physgraph-usd", "tag", shot.path, "-o", out, "--preset", preset, *options_of("--garment", words)]
        notes.append(f"named like {preset}: {said}; to refine it so: {join(tag)}")
    return notes


def of_folds(garments: Sequence[Mapping[str, Any]], frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """A note where cloth folds as sharply as only a mesh too coarse for its fabric does, of the garment that does most.

    Args:
        garments: A report's garments.
        frames: A report's frames.
    """
    found = [
        (entry.get("sharp_folds", 0.0), frame["time"], garment)
        for frame in frames
        for garment, entry in zip(garments, frame.get("garments", ()), strict=False)
    ]
    share, time, worst = max(found, key=lambda each: each[0], default=(0.0, None, {}))
    if share <= SHARP_FRACTION:
        return []
    others = len({id(garment) for each, _, garment in found if each > SHARP_FRACTION}) - 1
    level, at = worst["level"], "" if time is None else f" at time code {time:g}"
    text = f"level: {share:.0%} of the edges of <{worst['path']}>{at} fold by more than 45 degrees, so the mesh shows"
    text += f", and in {counted(others, 'other garment')}" if others else ""
    finer = f"--level {level + 1} halves the edges of {worst['fine_edge_mm']:.1f} mm, for up to 4 times the time"
    return [text + (f"; {finer}" if level < (GARMENT["refine:level"].maximum or 0) else "")]
