"""The chart as a picture: PNG and SVG for documents."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter, SymmetricalLogLocator

from .measure import DEFAULT, JUDGED, SMOOTH, UPSAMPLED
from .table import Chart, Point
from .words import (
    ABOVE,
    BASELINE,
    FAR,
    FRONT,
    PREPARING,
    Change,
    Style,
    advice,
    changes,
    contact_words,
    percent,
    styles,
    title,
)

FLOOR = 1e-4
"""Least gap that is drawn: Phi* itself is known no better."""
CEILING = 1.6
RULES: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "svg.hashsalt": "physgraph",
    "svg.fonttype": "none",
}
ONE_POINT = {DEFAULT: "*", UPSAMPLED: "s", SMOOTH: "D"}
"""Markers of curves with a single point."""


def draw_chart(chart: Chart, folder: Path) -> None:
    """Write ``chart.png`` and ``chart.svg`` of a chart into a folder."""
    with mpl.rc_context(RULES):
        figure = _figure(chart)
        figure.savefig(folder / "chart.png", dpi=160)
        figure.savefig(folder / "chart.svg", metadata={"Date": None})


def _figure(chart: Chart) -> Figure:
    steps = changes(chart)
    rows = [row for row in (chart.seen, chart.panels, chart.likeness) if row]
    heights = [4.2, *[2.6] * len(rows), *([0.6 + 0.28 * len(steps)] if steps else [])]
    figure = Figure(figsize=(10.6, sum(heights) + 1.0), layout="constrained")
    words = textwrap.fill(f"{advice(chart)} {contact_words(chart)}", 120)
    figure.suptitle(f"{title(chart)}\n{words}", x=0.01, ha="left", fontsize=9.5)
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    style = styles(chart)
    if chart.warm:
        axes, beside = parts[0].subplots(1, 2, sharey=True, width_ratios=[1.7, 1.0])
        _warm(beside, chart, style)
    else:
        axes = parts[0].subplots()
    _curves(axes, chart, style)
    parts[0].legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False, fontsize=8)
    for part, row in zip(parts[1:], rows, strict=False):
        panels = part.subplots(1, len(row), squeeze=False)[0]
        for axes, (name, words) in zip(panels, row.items(), strict=True):
            _measure(axes, name, words, chart=chart, style=style)
    if steps:
        _terms(parts[-1].subplots(1, 3, sharey=True, width_ratios=[1.0, 1.0, 1.5]), steps)
    return figure


def _curves(axes: Axes, chart: Chart, style: dict[str, Style]) -> None:
    """Gap against time, with the front in the background."""
    front = chart.front
    axes.step(
        [max(p.ms, 1e-2) for p in front],
        [max(p.gap, FLOOR) for p in front],
        where="post",
        color=FRONT,
        linewidth=7.0,
        solid_capstyle="round",
        zorder=1,
        label="the front: nothing is lower sooner",
    )
    for name in chart.methods:
        points = chart.curve(name)
        _gaps(axes, name, points, style[name])
    axes.set(xscale="log", yscale="log", xlabel="milliseconds a frame", title="Cold frames, contact on")
    axes.set_ylabel(ABOVE)
    axes.annotate(
        "better",
        xy=(0.02, 0.03),
        xytext=(0.09, 0.12),
        xycoords="axes fraction",
        arrowprops={"arrowstyle": "-|>", "color": "#444444", "linewidth": 1.4},
        color="#444444",
    )
    least = min((p.gap for p in chart.points), default=FLOOR)
    highest = max((p.gap for name in ONE_POINT for p in chart.curve(name)), default=0.0)
    axes.set_ylim(max(FLOOR, min(0.5 * least, 0.01)) if least > 0 else FLOOR, max(CEILING, 1.3 * highest))
    if chart.prepared:
        left, right = axes.get_xlim()
        axes.axvspan(left, chart.prepared, color="#f2f2f2", zorder=0, label=PREPARING)
        axes.set_xlim(left, right)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: percent(value)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.axhline(JUDGED, color="#b0b0b0", linewidth=0.8, linestyle=":")


def _warm(axes: Axes, chart: Chart, style: dict[str, Style]) -> None:
    """Gap against time of warm frames."""
    for name in dict.fromkeys(point.method for point in chart.warm):
        points = [point for point in chart.warm if point.method == name]
        _gaps(axes, name, points, style.get(name, Style(BASELINE, dashed=False)))
    axes.set(xscale="log", yscale="log", xlabel="milliseconds a frame", title="Warm frames")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    least, most = min(p.ms_least for p in chart.warm), max(p.ms_most for p in chart.warm)
    axes.set_xlim(10.0 ** math.floor(math.log10(max(least, 1e-2))), 10.0 ** math.ceil(math.log10(max(most, 1.0))))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.axhline(JUDGED, color="#b0b0b0", linewidth=0.8, linestyle=":")


def _gaps(axes: Axes, name: str, points: Sequence[Point], style: Style) -> None:
    """Gaps of a method against time, with the fastest and the slowest turn of each point."""
    _line(axes, name, points, style, [max(p.gap, FLOOR) for p in points])
    for point in points:
        ends = [max(milliseconds, 1e-2) for milliseconds in (point.ms_least, max(point.ms_most, point.ms_least))]
        axes.plot(ends, [max(point.gap, FLOOR)] * 2, color=style.colour, linewidth=3.2, alpha=0.3, zorder=1.5)


def _line(axes: Axes, name: str, points: Sequence[Point], style: Style, heights: list[float]) -> None:
    axes.plot(
        [max(p.ms, 1e-2) for p in points],
        heights,
        color=style.colour,
        linestyle="" if name in ONE_POINT else "--" if style.dashed else "-",
        marker=ONE_POINT.get(name, "^" if style.outside else "o"),
        markersize=11 if name == DEFAULT else 5 if name in ONE_POINT or style.outside else 3,
        linewidth=1.4,
        zorder=5 if name == DEFAULT else 2,
        label=name,
        clip_on=False,
    )


def _measure(axes: Axes, name: str, words: str, *, chart: Chart, style: dict[str, Style]) -> None:
    """One measure of contact or of likeness against time."""
    for method in chart.methods:
        points = [point for point in chart.curve(method) if getattr(point, name) is not None]
        _line(axes, method, points, style[method], [float(getattr(p, name)) for p in points])
    axes.set(xscale="log", xlabel="milliseconds a frame", title=words[0].upper() + words[1:])
    if name in chart.likeness or name in chart.seen:
        heights = [getattr(point, name) or 0.0 for method in ONE_POINT for point in chart.curve(method)]
        axes.set_ylim(0, 1.5 * max(heights, default=0.0) or None)
        for line in axes.lines:  # A solver that flew apart flies out of the picture.
            line.set_clip_on(True)
    else:
        axes.set_yscale("symlog", linthresh=0.01 if name == "percent" else 1.0)
        axes.set_ylim(bottom=0)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _terms(panels: Any, steps: list[Change]) -> None:
    positions = list(range(len(steps)))[::-1]
    cost, buys, words = panels
    for axes, values, colour, digits in (
        (cost, [step.cost_ms for step in steps], "#0072b2", 0),
        (buys, [min(step.moved_mm, FAR) for step in steps], "#009e73", 2),
    ):
        axes.barh(positions, values, color=colour, height=0.6)
        axes.grid(visible=False, axis="y")
        axes.xaxis.set_major_locator(MaxNLocator(4) if axes is cost else SymmetricalLogLocator(base=10, linthresh=1))
        for position, value in zip(positions, values, strict=True):
            label = f" over {value:.0f}" if value == FAR else f" {value:.{digits}f}"
            axes.text(max(value, 0.0), position, label, va="center", fontsize=7.5, color="#444444")
    cost.set(yticks=positions, title="Costs [ms a frame]")
    cost.set_yticklabels([step.name for step in steps])
    cost.margins(x=0.25)
    cost.axvline(0.0, color="#888888", linewidth=0.8)
    buys.set(title="Moves the result [mm]", xscale="symlog")
    buys.set_xlim(0, 8.0 * max(1.0, *(min(step.moved_mm, FAR) for step in steps)))
    buys.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    words.set(title="Buys")
    words.axis("off")
    for position, step in zip(positions, steps, strict=True):
        words.text(0.0, position, step.buys, va="center", fontsize=7.5, color="#444444", in_layout=False)
