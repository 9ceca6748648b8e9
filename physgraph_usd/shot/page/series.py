"""Figures of a run's frames over time, garment by garment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LayerError, StageError
from ...solver.level import refine_garments
from ...usd.read.meshes import RefinedLayer
from ...usd.read.reader import Shot
from ..report import RefineReport, levels_of

Line = list[float | None]
"""A figure in each frame, None for a frame without the value."""
Series = dict[str, dict[str, Line]]
"""One garment's lines, by name of the plot, whose title has the unit, and by label."""


def read_series(report: RefineReport, index: int) -> Series:
    """One garment's lines from a report's frames."""
    series: Series = {}
    for position, frame in enumerate(report.frames):
        entry = frame["garments"][index] if "garments" in frame else {}
        for name, values in _series_of(entry, frame).items():
            for label, value in values.items():
                series.setdefault(name, {}).setdefault(label, [None] * len(report.frames))[position] = value
    return series


def _series_of(entry: dict[str, Any], frame: dict[str, Any]) -> dict[str, dict[str, float]]:
    """One frame's figures of a garment, by field and line."""
    lines_of: dict[str, dict[str, float]] = {"time": _milliseconds(entry, frame)}
    if "energy_joules" in entry:
        output, start = entry["energy_joules"]["output"], entry["energy_joules"]["input"]
        lines_of["energy"] = {name: 1e3 * value for name, value in output.items()}
        lines_of["energy"] |= {"total": 1e3 * sum(output.values()), "upsampled input": 1e3 * sum(start.values())}
    if "strain" in entry:
        lines_of["strain"] = {name: 100.0 * value for name, value in entry["strain"].items()}
    if entry.get("remaining_mm") is not None:
        lines_of["remaining"] = {"remaining move": entry["remaining_mm"]}
    contact = entry.get("contact", {})
    bodies = contact.get("bodies", {}).values()
    for when in ("before", "after"):
        if bodies:
            lines_of.setdefault("inside", {})[when] = sum(body[when]["inside"] for body in bodies)
            lines_of.setdefault("depth", {})[when] = max(body[when]["deepest_mm"] for body in bodies)
            lines_of.setdefault("crossings", {})[f"bodies, {when}"] = sum(body[when]["crossings"] for body in bodies)
        if "cloth" in contact:
            lines_of.setdefault("crossings", {})[f"cloth, {when}"] = contact["cloth"][when]["crossings"]
    return lines_of


def _milliseconds(entry: dict[str, Any], frame: dict[str, Any]) -> dict[str, float]:
    spent = dict(entry.get("milliseconds", {}))
    return ({"read": frame["read_ms"]} if "read_ms" in frame and spent else {}) | spent


def add_jerk(series: Sequence[Series], report: RefineReport, shot: Shot, layer: Path) -> None:
    """Measure the unsteadiness of the detail, from the written layer.

    Args:
        series: Lines of every garment; jerk is added for each run of four consecutive samples.
        shot: The shot, open.
    """
    written = RefinedLayer(layer)
    chains = refine_garments(shot.scene.garments, levels_of(report.garments))
    for index, garment_series in enumerate(series):
        garment, steps = shot.scene.garments[index], chains[index]
        edge = 1e-3 * report.garments[index]["fine_edge_mm"]
        recent: list[np.ndarray | None] = []
        line: Line = []
        for frame in report.frames:
            recent = [*recent[-3:], _detail(written, shot, frame["time"], index=index, steps=steps)]
            complete = [
                positions for positions in recent if positions is not None and len(positions) >= len(garment.rest)
            ]
            line.append(third_difference(complete) / edge if len(complete) == 4 and edge > 0 else None)
        garment_series["jerk"] = {"jerk": line}


def _detail(
    written: RefinedLayer, shot: Shot, time: float | None, *, index: int, steps: Sequence[Any]
) -> np.ndarray | None:
    """Fine positions minus the linearly upsampled cage [m], or None for a frame without a sample."""
    try:
        fine = written.points(shot, index, time)
        coarse = shot.frame(time).garments[index].points
    except (StageError, LayerError):
        return None
    for step in steps:
        coarse = np.asarray(step.linear @ coarse)
    return None if fine is None or fine.shape != coarse.shape else fine - coarse


def third_difference(detail: Sequence[np.ndarray]) -> float:
    """RMS over the vertices of the third difference of four states, in the states' unit."""
    third = np.diff(np.stack(detail), n=3, axis=0)[0]
    return float(np.sqrt(np.square(third).sum(axis=1).mean())) if len(third) else 0.0
