"""What the picture and the page say: titles, settings, and each term's change in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .methods import DEFAULT
from .table import Chart, Point

FAR = 1e4
"""Distance beyond which cloth that nothing holds has fallen away [mm]."""


@dataclass(frozen=True)
class Change:
    """What a part of the model costs and buys.

    Attributes:
        name: The part.
        cost_ms: Time of a frame with it less that without [ms].
        share: The same over the time with it.
        moved_mm: RMS distance between the results [mm].
        buys: What is worse without it, in words.
    """

    name: str
    cost_ms: float
    share: float
    moved_mm: float
    buys: str


def title(chart: Chart) -> str:
    """Shot, size, device."""
    about = chart.about
    frames = len(chart.references)
    levels = ", ".join(map(str, sorted(set(about["levels"]))))
    where = about["device"] if about["device"] == "cpu" else about["processor"]
    where += ", processor time of one core" if about.get("clock") == "cpu" else ""
    plural = "s" if frames > 1 else ""
    return f"{about['shot']}: {about['vertices']:,} fine vertices, level {levels}, {frames} cold frame{plural}, {where}"


def percent(value: float) -> str:
    """A share with as many digits as it needs; a large one as a factor."""
    if abs(value) >= 10.0:
        return f"{value:,.0f}x"
    return f"{100.0 * value:.3g}%"


def settings(point: Point) -> str:
    """What a point was solved with."""
    if point.method == DEFAULT:
        return f"at most {point.steps} steps at the finest level, tolerance {point.tolerance:g} edge lengths"
    if not point.integrator:
        return "no physics"
    where = "nested" if point.nested else "finest level only"
    return f"{point.integrator}, {where}, {point.steps} steps there" + (f" ({point.note})" if point.note else "")


def figures(point: Point, *, touches: bool) -> list[str]:
    """What a point reached."""
    said = [
        f"gap {percent(point.gap)}, energy {point.energy:.4g} J",
        f"{point.ms:.1f} ms a frame (median {point.ms_median:.1f}, least {point.ms_least:.1f}; "
        f"{point.repeats} turns of {_frames(point)})",
        ", ".join(f"{name} {1e3 * value:.3g}" for name, value in sorted(point.energies.items())) + " mJ",
        f"strain p99 {percent(point.strain)}"
        + (f", {point.apart_mm:.3g} mm from Phi*'s shape" if point.apart_mm is not None else ""),
    ]
    if touches:
        said.append(
            f"{point.inside} vertices inside ({point.percent:.3g}%), deepest {point.deepest_mm:.3g} mm, "
            f"{point.crossings} edges through faces of bodies, {point.tangles} through cloth"
        )
    return said


def _frames(point: Point) -> str:
    return "one frame" if point.frames == 1 else f"{point.frames} frames"


def changes(chart: Chart) -> list[Change]:
    """Every part of the model that was measured, levels one by one."""
    fall = sum(each["start"] - each["least"] for each in chart.references)
    least = sum(each["least"] for each in chart.references)
    found = [_term(each, fall, least) for each in chart.terms if each["kind"] != "level"]
    return [each for each in found if each is not None] + _levels(chart, fall, least)


def _term(row: dict[str, Any], fall: float, least: float) -> Change | None:
    if "failed" in row:
        return None
    full, other = row["with"], row["without"]
    if row["kind"] == "time":
        name = {"tether": "tether to the last frame", "warm": "start from the last frame"}[row["term"]]
        worse = [f"jerk {other['jerk']:.3g} edges (with it {full['jerk']:.3g})"]
    else:
        name = row["term"]
        worse = [f"gap {percent((other['energy'] - least) / max(fall, 1e-12))}"]
    worse += [
        f"{key} {other[key]} ({full[key]})" for key in ("inside", "crossings", "tangles") if full[key] != other[key]
    ]
    cost = full["ms"] - other["ms"]
    if row["moved_mm"] > FAR:
        worse = ["the cloth falls away"]
    return Change(name, cost, cost / max(full["ms"], 1e-9), row["moved_mm"], "without it " + ", ".join(worse))


def _levels(chart: Chart, fall: float, least: float) -> list[Change]:
    rows = [each for each in chart.terms if each["kind"] == "level" and "failed" not in each]
    found, before, apart = [], 0.0, None
    for row in rows:
        own = row["without"]
        gap = percent((own["energy"] - least) / max(fall, 1e-12))
        cost = own["ms"] - before
        moved = 0.0 if apart is None else max(apart - row["moved_mm"], 0.0)
        name = f"{row['term']} ({own['vertices']:,} vertices)"
        found.append(Change(name, cost, cost / max(own["ms"], 1e-9), moved, f"as the last one gap {gap}"))
        before, apart = own["ms"], row["moved_mm"]
    return found
