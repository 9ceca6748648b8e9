"""Plots values over time codes as inline SVG, a few kilobytes each; a short script shows the values at the cursor."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ...errors import named_time

WIDTH, HEIGHT = 1120, 190
LEFT, RIGHT, TOP, BOTTOM = 64, 12, 8, 24
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5195", "#8c6d31", "#6e6e6e")
MARKED = 60
"""Most samples drawn with a dot each."""

SCRIPT = """
for (const svg of document.querySelectorAll("svg.plot")) {
  const plot = JSON.parse(svg.dataset.plot), cursor = svg.querySelector(".cursor");
  const labels = [...document.querySelectorAll(`[data-of="${svg.id}"] b`)];
  svg.addEventListener("mousemove", (event) => {
    const box = svg.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * plot.width;
    let best = 0;
    plot.at.forEach((place, i) => { if (Math.abs(place - x) < Math.abs(plot.at[best] - x)) best = i; });
    cursor.setAttribute("x1", plot.at[best]);
    cursor.setAttribute("x2", plot.at[best]);
    cursor.style.visibility = "visible";
    labels[0].textContent = plot.times[best];
    plot.values.forEach((line, i) => { labels[i + 1].textContent = line[best] === null ? "-" : line[best]; });
  });
}
"""


@dataclass(frozen=True)
class Axis:
    """Maps values to a picture's coordinates.

    Attributes:
        low: Least value.
        high: Greatest value.
        start: Coordinate of the least.
        end: Coordinate of the greatest.
    """

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """The coordinate of a value."""
        span = self.high - self.low
        return self.start if span <= 0 else self.start + (value - self.low) / span * (self.end - self.start)


def plot(name: str, title: str, times: Sequence[float], lines: Mapping[str, Sequence[float | None]]) -> str:
    """A plot with title and legend, or "" without data.

    Args:
        name: The element's id.
        title: Plotted quantity, with unit.
        times: Time codes, ascending.
        lines: For each line, a value per time code, None if missing.
    """
    curves = {label: [_finite(value) for value in values] for label, values in lines.items()}
    curves = {label: values for label, values in curves.items() if any(value is not None for value in values)}
    if not curves or not times:
        return ""
    finite = [value for values in curves.values() for value in values if value is not None]
    ticks = _ticks(min(0.0, *finite), max(finite))
    across = Axis(times[0], times[-1], LEFT, WIDTH - RIGHT)
    up = Axis(ticks[0], ticks[-1], HEIGHT - BOTTOM, TOP)
    drawn = "".join(
        _line(values, times, across, up, colour=COLOURS[i % len(COLOURS)]) for i, values in enumerate(curves.values())
    )
    data = {
        "width": WIDTH,
        "times": [*map(named_time, times)],
        "at": [round(across.at(time), 2) for time in times],
        "values": [[None if v is None else f"{v:.4g}" for v in values] for values in curves.values()],
    }
    return (
        f"<h3>{html.escape(title)}</h3>{_legend(name, list(curves))}"
        f"<svg class='plot' id='{name}' viewBox='0 0 {WIDTH} {HEIGHT}' role='img' aria-label='{html.escape(title)}' "
        f"data-plot='{html.escape(json.dumps(data))}'>{_frame(ticks, times, across, up)}{drawn}"
        f"<line class='cursor' y1='{TOP}' y2='{HEIGHT - BOTTOM}'/></svg>"
    )


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from below the least value to above the greatest."""
    span = high - low or abs(high) or 1.0
    rough = span / 4.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
    first, last = math.floor(low / step), math.ceil((high if high > low else low + span) / step)
    return [index * step for index in range(first, last + 1)]


def _frame(ticks: Sequence[float], times: Sequence[float], across: Axis, up: Axis) -> str:
    rows = "".join(
        f"<line class='grid' x1='{LEFT}' x2='{WIDTH - RIGHT}' y1='{up.at(t):.1f}' y2='{up.at(t):.1f}'/>"
        f"<text x='{LEFT - 6}' y='{up.at(t) + 4:.1f}' text-anchor='end'>{t:.6g}</text>"
        for t in ticks
    )
    count = min(len(times), 9)
    picks = sorted({round(i * (len(times) - 1) / max(count - 1, 1)) for i in range(count)})
    columns = "".join(
        f"<text x='{across.at(times[i]):.1f}' y='{HEIGHT - 6}' text-anchor='middle'>{named_time(times[i])}</text>"
        for i in picks
    )
    return rows + columns


def _line(values: Sequence[float | None], times: Sequence[float], across: Axis, up: Axis, *, colour: str) -> str:
    parts: list[list[str]] = [[]]
    for time, value in zip(times, values, strict=True):
        if value is None:
            parts.append([])
        else:
            parts[-1].append(f"{across.at(time):.1f},{up.at(value):.1f}")
    lines = "".join(
        f"<polyline points='{' '.join(part)}' fill='none' stroke='{colour}' stroke-width='1.6'/>"
        for part in parts
        if len(part) > 1
    )
    every = len(times) <= MARKED
    dots = "".join(
        f"<circle cx='{point.partition(',')[0]}' cy='{point.partition(',')[2]}' r='2.2' fill='{colour}'/>"
        for part in parts
        for point in part
        if every or len(part) == 1
    )
    return lines + dots


def _legend(name: str, labels: Sequence[str]) -> str:
    """Names of the lines, and space for the values at the cursor."""
    spans = "".join(
        f"<span><i style='background:{COLOURS[i % len(COLOURS)]}'></i>{html.escape(label)} <b></b></span>"
        for i, label in enumerate(labels)
    )
    return f"<div class='legend' data-of='{name}'><span>time code <b></b></span>{spans}</div>"
