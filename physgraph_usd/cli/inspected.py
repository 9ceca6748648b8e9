"""Text of `inspect` for a reader: a summary that ends with the command to run, and every value below it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..errors import counted
from .printing import outline

MOST_MESHES = 20
"""Most meshes of a stage without garments that the summary lists."""
PRINTED_IN_FULL = ("problem", "defects", "warnings", "notes", "command", "exit_code", "from_rest")
"""Entries of the result that `details` leaves out."""


def summary(inspected: Mapping[str, Any]) -> Iterator[str]:
    """Lines for a first look: garments, bodies, problems, warnings, cost, and the command to run.

    Args:
        inspected: Result of `inspect_shot`.
    """
    yield _heading(inspected)
    if "garments" in inspected:
        yield from _listed("garments", [_garment(garment) for garment in inspected["garments"]])
        yield from _listed("bodies", inspected["colliders"])
    else:
        yield from _listed("meshes", _meshes(inspected["meshes"]))
    yield from _listed("problems", _problems(inspected))
    yield from _listed("warnings", inspected["warnings"])
    yield from _listed("notes", inspected.get("notes", ()))
    yield from _cost(inspected)
    yield "details: every value and its source with --details"
    if "command" in inspected:
        yield f"command: {inspected['command']}"


def details(inspected: Mapping[str, Any]) -> Iterator[str]:
    """Lines of everything that the summary leaves out or shortens."""
    return outline({name: value for name, value in inspected.items() if name not in PRINTED_IN_FULL})


def _heading(inspected: Mapping[str, Any]) -> str:
    times = inspected.get("times")
    frames = f"{counted(len(times), 'frame')}, {_range(times)}, " if times else ""
    return f"shot: {inspected['shot']}, {frames}1 unit is {inspected['metres_per_unit']:g} m"


def _range(times: Sequence[float]) -> str:
    return f"{times[0]:g} to {times[-1]:g}" if len(times) > 1 else f"{times[0]:g}"


def _listed(name: str, items: Sequence[str]) -> Iterator[str]:
    """A name with its items below it, or with "none"."""
    yield f"{name}:" if items else f"{name}: none"
    for item in items:
        yield f"  {item}"


def _garment(garment: Mapping[str, Any]) -> str:
    size = " x ".join(f"{length:.2f}" for length in garment["size_m"])
    fine = f"{garment['fine_points']:,} at level {garment['level']}"
    pinned = garment["pinned_points"]
    parts = [f"{counted(garment['points'], 'vertex', 'vertices')} become {fine}", f"{size} m"]
    parts += [f"{pinned:,} pinned"] if pinned else []
    return f"{garment['path']}: {', '.join(parts)}"


def _meshes(meshes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Meshes of a stage, those most like garments first."""
    ordered = sorted(meshes, key=lambda mesh: (not mesh["garment"], mesh["form"] != "open", not mesh["samples"]))
    lines = [_mesh(mesh) for mesh in ordered[:MOST_MESHES]]
    remaining = len(ordered) - len(lines)
    return lines + ([f"and {remaining:,} more, which --details lists"] if remaining else [])


def _mesh(mesh: Mapping[str, Any]) -> str:
    parts = ["tagged as a garment"] if mesh["garment"] else []
    parts += [counted(mesh["points"], "vertex", "vertices"), mesh["form"], counted(mesh["samples"], "sample")]
    return f"{mesh['path']}: {', '.join(parts)}"


def _problems(inspected: Mapping[str, Any]) -> list[str]:
    """The reason that a shot cannot be refined, and defects of meshes."""
    problems = [inspected["problem"]] if "problem" in inspected else []
    faulty = [mesh for mesh in inspected.get("meshes", ()) if mesh["problem"] != "none"]
    problems += [f"{mesh['path']}: {mesh['problem']}" for mesh in faulty[:MOST_MESHES]]
    for path, defects in inspected.get("defects", {}).items():
        problems += [f"{path}: {defect}" for defect in defects]
    return list(dict.fromkeys(problems))


def _cost(inspected: Mapping[str, Any]) -> Iterator[str]:
    """Estimates of memory, disk and time."""
    if estimate := inspected.get("estimate"):
        layer = f"the layer: {estimate['layer_mb']:,.4g} MB on disk"
        yield f"memory: {estimate['memory_mb']:,.0f} MB for one process; {layer}"
    if timed := inspected.get("timed"):
        seconds = [f"{timed[name]:g} s" for name in ("first_frame_seconds", "seconds_a_frame", "whole_shot_seconds")]
        yield "time: {} for the first frame, {} for each frame after it, {} for the whole shot".format(*seconds)
    if words := inspected.get("from_rest", {}).get("words"):
        yield f"distance from rest: {words}"
