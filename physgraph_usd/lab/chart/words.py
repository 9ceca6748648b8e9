"""Words and colours that the picture and the page share: titles, settings, each term's change, a style a curve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...errors import counted
from ...shot.options import INTEGRATORS
from .measure import DEFAULT, SMOOTH, UPSAMPLED
from .table import TOLERANCE, Chart, Point

FAR = 1e4
"""Distance to the reference from which unsupported cloth counts as fallen away [mm]."""
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5195", "#8c6d31")
"""Okabe and Ito's colours, which colour-blind readers tell apart, and two more."""
OUTSIDE = ("#e6007e", "#7fa800", "#5a2d0c")
"""Colours of solvers outside."""
BASELINE = "#6e6e6e"
FRONT = "#e9dfc0"


@dataclass(frozen=True)
class Change:
    """Cost and gain of a part of the model.

    Attributes:
        cost_ms: Time of a frame with the term minus time without [ms].
        fraction: Cost over the time with the term.
        moved_mm: RMS distance between the results [mm].
        buys: Worsening without the term, in words.
    """

    name: str
    cost_ms: float
    fraction: float
    moved_mm: float
    buys: str


@dataclass(frozen=True)
class Style:
    """How a curve is drawn: broken where the method is as it is not used by default."""

    colour: str
    dashed: bool
    outside: bool = False


def styles(chart: Chart) -> dict[str, Style]:
    """A style for each curve: the colour is the integrator's, a broken line is flat."""
    nested = {point.method: point.nested for point in chart.points}
    family = {point.method: (point.integrator or point.method).removesuffix("-flat") for point in chart.points}
    names = {family[name] for name in chart.methods if name not in {DEFAULT, SMOOTH, UPSAMPLED}}
    outside = names & set(chart.notes)
    colours = {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(sorted(names - outside))}
    colours |= {name: OUTSIDE[i % len(OUTSIDE)] for i, name in enumerate(sorted(outside))}
    sentences = {
        name: Style(colours.get(family[name], BASELINE), nested[name] is False, family[name] in outside)
        for name in chart.methods
    }
    return sentences | {DEFAULT: Style("#111111", False)}


def title(chart: Chart) -> str:
    """Shot, size, device."""
    about = chart.about
    frames = len(chart.references)
    levels = ", ".join(map(str, sorted(set(about["levels"]))))
    where = about["device"] if about["device"] == "cpu" else about["processor"]
    where += ", processor time of one core" if about.get("clock") == "cpu" else ""
    cold = counted(frames, "cold frame")
    return f"{about['shot']}: {about['vertices']:,} fine vertices, level {levels}, {cold}, {where}"


def percent(value: float, *, digits: int = 3) -> str:
    """A fraction with the needed digits; a large fraction as a factor."""
    if abs(value) >= 10.0:
        return f"{value:,.0f}x"
    return f"{100.0 * value:.{max(digits, 3) if abs(value) >= 0.995 else digits}g}%"


PREPARING = "preparing a cold frame, in all times of ours"
ABOVE = "energy above the best known, percent of what solving gains"
"""The axis of gaps, in words."""


def advice(chart: Chart) -> str:
    """The recommended method, in a sentence."""
    standing = chart.default_place()
    if standing is None:
        return ""
    excess = f"{percent(standing['gap'], digits=2)} above the best known in {standing['ms']:.0f} ms a frame"
    if standing["on_front"]:
        return (
            f"Take refine's default, which you have without asking: it comes to {excess}; nothing gets as low sooner."
        )
    known = {point.method: point for point in chart.points}[standing["fastest"]]
    asked = f" (--integrator {known.integrator})" if known.method == known.integrator in INTEGRATORS else ""
    return (
        f"Take {standing['fastest']}{asked} for single frames like these: refine's default comes to {excess}, "
        f"{standing['ratio']:.1f} times the {standing['fastest_ms']:.0f} ms in which that gets as low."
    )


def contact_words(chart: Chart) -> str:
    """A sentence that names the measures of contact that are 0 for every method and not drawn; "" without any."""
    return f"0 for every method: {', '.join(words.split(' [')[0] for words in chart.zeros)}." if chart.zeros else ""


def warm_advice(chart: Chart) -> str:
    """The cost of frames after the first, in a sentence."""
    default = next((point for point in chart.warm if point.method == DEFAULT), None)
    if default is None:
        return ""
    rest = [point for point in chart.warm if point.method != DEFAULT and point.gap <= default.gap]
    best = min(rest, key=lambda point: point.ms, default=None)
    words = (
        f"Frames begun where the last one ended take it {default.ms:.0f} ms and end at {percent(default.gap, digits=2)}"
    )
    if best is None or best.ms * TOLERANCE >= default.ms:
        return f"{words}; nothing else is as low sooner."
    return f"{words}; {best.method} with {best.steps} steps is as low in {best.ms:.0f} ms."


def settings(point: Point) -> str:
    """Settings of a point's solve."""
    if point.tolerance:
        words = (
            f"at most {counted(point.steps, 'step')} at the finest level, tolerance {point.tolerance:g} edge lengths"
        )
        return f"{point.integrator}, {words}" if point.integrator else words
    if not point.integrator:
        return "no physics"
    where = "nested" if point.nested else "finest level only"
    return f"{point.integrator}, {where}, {counted(point.steps, 'step')} there" + (
        f" ({point.note})" if point.note else ""
    )


def figures(point: Point, *, touches: bool) -> list[str]:
    """Figures of a point's result."""
    lines = [
        f"gap {percent(point.gap)}, energy {point.energy:.4g} J",
        f"{point.ms:.1f} ms a frame (median {point.ms_median:.1f}, least {point.ms_least:.1f}; "
        f"{counted(point.repeats, 'turn')} of {counted(point.frames, 'frame')})",
        ", ".join(f"{name} {1e3 * value:.3g}" for name, value in sorted(point.energies.items())) + " mJ",
        f"strain p99 {percent(point.strain)}"
        + (f", {point.apart_mm:.3g} mm from Phi*'s shape" if point.apart_mm is not None else "")
        + (f", {point.degrees:.2g} degrees from it" if point.degrees is not None else ""),
    ]
    if touches:
        lines.append(
            f"{point.inside} vertices inside ({point.percent:.3g}%), deepest {point.deepest_mm:.3g} mm, "
            f"{point.crossings} edges through faces of bodies, {point.tangles} through cloth"
        )
    return lines


def changes(chart: Chart) -> list[Change]:
    """Changes of the energy by each measured part of the model, and by each level."""
    fall = max(sum(reference["start"] - reference["least"] for reference in chart.references), 1e-12)
    least = sum(reference["least"] for reference in chart.references)
    changes, levels, before, apart = list[Change](), list[Change](), 0.0, None
    for row in (term for term in chart.terms if "failed" not in term):
        without = row["without"]
        gap = f"gap {percent((without['energy'] - least) / fall)}"
        if row["kind"] != "level":
            changes.append(_term(row, gap))
            continue
        cost = without["ms"] - before
        moved = 0.0 if apart is None else max(apart - row["moved_mm"], 0.0)
        name = f"{row['term']} ({without['vertices']:,} vertices)"
        levels.append(Change(name, cost, cost / max(without["ms"], 1e-9), moved, f"as the last one {gap}"))
        before, apart = without["ms"], row["moved_mm"]
    return changes + levels


def _term(row: dict[str, Any], gap: str) -> Change:
    full, without = row["with"], row["without"]
    name, worse = row["term"], [gap]
    if row["kind"] == "time":
        name = {"tether": "tether to the last frame", "warm": "start from the last frame"}[name]
        worse = [f"jerk {without['jerk']:.3g} edges (with it {full['jerk']:.3g})"]
    worse += [
        f"{key} {without[key]} ({full[key]})" for key in ("inside", "crossings", "tangles") if full[key] != without[key]
    ]
    cost = full["ms"] - without["ms"]
    if without["ms"] > TOLERANCE * full["ms"]:
        worse.append("and a frame takes longer")
    if row["moved_mm"] > FAR:
        worse = ["the cloth falls away"]
    return Change(name, cost, cost / max(full["ms"], 1e-9), row["moved_mm"], "without it " + ", ".join(worse))
