"""The chart as a page to explore: one file, hover for settings and figures, click a method to hide it."""

from __future__ import annotations

import html
from pathlib import Path

import plotly.graph_objects as go
from plotly.io import to_html
from plotly.subplots import make_subplots

from ...shot.page.document import document, table
from .measure import DEFAULT, JUDGED, SMOOTH, UPSAMPLED
from .table import Chart
from .words import FAR, Style, changes, figures, percent, settings, styles, title

FLOOR = 1e-5
TICKS = [1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0003, 0.0001]
SIGNS = {DEFAULT: "star", UPSAMPLED: "square", SMOOTH: "diamond"}
HOW = (
    "Every frame starts cold. Times are of preparing and solving a frame, the median of the faster half of {repeats} "
    "turns, in which all methods take one budget before any takes the next: what else a machine does only ever adds to "
    "a time. Reading and writing are left out. A budget is a number of steps at the finest level; a nested method may "
    "take four times as many at each coarser one. Energies, strain and contact are measured in float64, alike for "
    "all. Phi0 is plain upsampling's energy, Phi* the least that anybody found, from several starts."
)


def write_page(chart: Chart, file: Path) -> None:
    """Write the page of a chart; it needs no network."""
    figure = to_html(
        _figure(chart),
        full_html=False,
        include_plotlyjs=True,
        div_id="curves",
        config={"displaylogo": False, "responsive": True},
    )
    body = "\n".join([f"<h1>{html.escape(title(chart))}</h1>", _lead(chart), figure, _terms(chart), _notes(chart)])
    file.write_text(document(title(chart), body), encoding="utf-8")


def _figure(chart: Chart) -> go.Figure:
    """Gap, penetrations and crossings against time, with one legend."""
    panels = {"gap": "energy gap (Phi - Phi*) / (Phi0 - Phi*)", **chart.panels, **chart.likeness}
    figure = make_subplots(
        rows=len(panels),
        cols=1,
        shared_xaxes=True,
        vertical_spacing=0.05,
        row_heights=[2.0, *[1.0] * (len(panels) - 1)],
    )
    style = styles(chart)
    for row, (field, words) in enumerate(panels.items(), start=1):
        for name in chart.methods:
            figure.add_trace(_trace(chart, name, style[name], field=field, first=row == 1), row=row, col=1)
        figure.update_yaxes(title_text=words, row=row, col=1)
    figure.update_xaxes(type="log", dtick=1, minor={"dtick": "D1", "showgrid": True})
    figure.update_xaxes(title_text="milliseconds a frame", row=len(panels), col=1)
    figure.update_yaxes(type="log", tickvals=TICKS, tickformat="~p", row=1, col=1)
    figure.update_layout(
        height=480 + 240 * (len(panels) - 1),
        template="plotly_white",
        margin={"l": 70, "r": 20, "t": 20, "b": 50},
        hoverlabel={"align": "left"},
        legend={"title": {"text": "click hides, double click isolates"}},
    )
    return figure


def _trace(chart: Chart, name: str, style: Style, *, field: str, first: bool) -> go.Scatter:
    points = chart.curve(name)
    labels = ["<br>".join([settings(p), *figures(p, touches=bool(chart.panels))]) for p in points]
    values = [max(p.gap, FLOOR) if field == "gap" else getattr(p, field) for p in points]
    return go.Scatter(
        x=[max(p.ms, 1e-2) for p in points],
        y=values,
        name=name,
        legendgroup=name,
        showlegend=first,
        mode="markers" if name in SIGNS else "lines+markers",
        line={"color": style.colour, "dash": "dash" if style.dashed else "solid", "width": 2},
        marker={
            "symbol": SIGNS.get(name, "triangle-up" if style.outside else "circle"),
            "size": 16 if name == DEFAULT else 8,
            "color": style.colour,
        },
        customdata=labels,
        hovertemplate=f"<b>{html.escape(name)}</b><br>%{{customdata}}<extra></extra>",
    )


def _lead(chart: Chart) -> str:
    """The sentences that a reader should know first."""
    place = chart.default_place()
    sentences = []
    if place is not None:
        where = "is on the front" if place["on_front"] else "is not on the front"
        sentences.append(
            f"refine's default leaves {percent(place['gap'])} in {place['ms']:.0f} ms a frame and {where}: the fastest "
            f"to that gap, {place['fastest']}, needs {place['fastest_ms']:.0f} ms."
        )
    times = chart.times_to(JUDGED)
    if times:
        order = ", ".join(f"{name} {ms:.0f} ms" for name, ms in times.items())
        sentences.append(f"To a gap of 3%: {order}.")
    if chart.busy:
        sentences.append(f"Warning: {chart.busy}.")
    return f"<p>{html.escape(' '.join(sentences))}</p>"


def _terms(chart: Chart) -> str:
    """Cost and gain of each part of the model, as a table."""
    found = changes(chart)
    if not found:
        return ""
    rows = [
        (
            each.name,
            f"{each.cost_ms:.1f}",
            percent(each.fraction),
            "-" if each.moved_mm > FAR else f"{each.moved_mm:.3f}",
            each.buys,
        )
        for each in found
    ]
    return (
        "<h2>What each part of the model costs and buys</h2>"
        + table("terms", ("part", "costs [ms]", "of the frame", "moves [mm]", "buys"), rows, numbers=(1, 2, 3))
        + "<p class='note'>By refine's default, with the part less without it; a level less the one below it. The "
        "result moves by the RMS distance between the two; gaps are by the full potential at the finest level.</p>"
    )


def _notes(chart: Chart) -> str:
    """How it was measured."""
    plan, longer = chart.about["plan"] or {}, chart.about.get("long_minutes")
    rows = [
        (
            "-" if r["frame"] is None else f"{r['frame']:g}",
            f"{r['start']:.5g}",
            f"{r['least']:.5g}",
            r["by"],
            "-" if r["apart"] is None else f"{r['apart']:.2%}",
        )
        for r in chart.references
    ]
    failed = [(r["method"], str(r["steps"]), r["error"]) for r in chart.failed]
    return "".join(
        [
            f"<h2>How it was measured</h2><p>{HOW.format(repeats=plan.get('repeats', '?'))}</p>",
            table(
                "references",
                ("frame", "Phi0 [J]", "Phi* [J]", "found by", "next best above, of the fall"),
                rows,
                numbers=(0, 1, 2),
            ),
            table("outside", ("solver outside", "was given"), list(chart.notes.items())) if chart.notes else "",
            "<h2>Runs that failed</h2>" + table("failed", ("method", "steps", "error"), failed) if failed else "",
            f"<p class='note'>The long form would take about {longer:.0f} minutes here.</p>" if longer else "",
        ]
    )
