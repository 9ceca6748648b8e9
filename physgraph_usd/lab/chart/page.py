"""The chart as a page to explore: one file, hover for settings and figures, click a method to hide it."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path

import plotly.graph_objects as go
from plotly.io import to_html
from plotly.subplots import make_subplots

from ...shot.page.document import document, table
from .looks import looks_of
from .measure import DEFAULT, JUDGED, SMOOTH, UPSAMPLED
from .table import Chart, Point
from .words import (
    BASELINE,
    FAR,
    FRONT,
    PREPARING,
    Style,
    advice,
    changes,
    contact_words,
    figures,
    percent,
    settings,
    styles,
    title,
    warm_advice,
)

FLOOR = 1e-5
TICKS = [1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0003, 0.0001]
SIGNS = {DEFAULT: "star", UPSAMPLED: "square", SMOOTH: "diamond"}
READING = (
    "Lower is nearer to rest: 100% is the input, plainly subdivided, 0% the least energy that anybody found. Left is "
    "faster. Degrees are the median angle between the surface and the converged frame's: what one sees of the last "
    "percents. The broad line is the front: nothing that was measured is lower in less time than what lies on it."
)
OWN = """
#methods { display: flex; flex-wrap: wrap; gap: .3rem .5rem }
#methods button { font: inherit; font-size: .85rem; border: 1px solid var(--line); border-radius: 4px; background: none;
padding: .1rem .5rem; cursor: pointer; color: var(--ink) }
#methods button[aria-pressed=false] { opacity: .4 }
#methods i { display: inline-block; width: 1.4em; margin-right: .4em;
vertical-align: middle }
.looks { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: .6rem }
.looks figure { margin: 0 }
"""
SCRIPT = """
const plot = document.getElementById('curves');
document.querySelectorAll('#methods button').forEach(button => button.addEventListener('click', () => {
  const shown = button.getAttribute('aria-pressed') !== 'true';
  button.setAttribute('aria-pressed', String(shown));
  const own = [];
  plot.data.forEach((trace, index) => { if (trace.legendgroup === button.dataset.method) own.push(index); });
  Plotly.restyle(plot, { visible: shown }, own);
}));
"""
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
    head = f"<style>{OWN}</style><h1>{html.escape(title(chart))}</h1>"
    parts = [head, _lead(chart), _legend(chart), figure, _looks(chart, file.parent), _terms(chart), _notes(chart)]
    body = "\n".join(parts)
    file.write_text(document(title(chart), body, script=SCRIPT), encoding="utf-8")


def _figure(chart: Chart) -> go.Figure:
    """Gap of cold and of warm frames, penetrations and crossings against time."""
    panels = {"gap": "energy above<br>the best known", **chart.seen, **chart.panels, **chart.likeness}
    warm = 1 if chart.warm else 0
    figure = make_subplots(
        rows=len(panels) + warm,
        cols=1,
        vertical_spacing=0.2 / (len(panels) + warm),
        row_heights=[2.2, *[1.5] * warm, *[1.0] * (len(panels) - 1)],
        subplot_titles=["Cold frames, contact on", *["Warm frames, each begun where the last one ended"] * warm],
    )
    style = styles(chart)
    _add_front(figure, chart)
    for place, (field, words) in enumerate(panels.items(), start=1):
        row = place + (warm if place > 1 else 0)
        for name in chart.methods:
            figure.add_trace(_trace(chart, name, style[name], chart.curve(name), field=field), row=row, col=1)
        figure.update_yaxes(title_text=words, row=row, col=1)
    for name in dict.fromkeys(point.method for point in chart.warm):
        line_style, points = style.get(name, Style(BASELINE, dashed=False)), [p for p in chart.warm if p.method == name]
        figure.add_trace(_trace(chart, name, line_style, points, field="gap"), row=2, col=1)
    figure.update_xaxes(type="log", dtick=1, minor={"dtick": "D1", "showgrid": True})
    figure.update_xaxes(title_text="milliseconds a frame", row=1, col=1)
    figure.update_xaxes(title_text="milliseconds a frame", row=len(panels) + warm, col=1)
    figure.update_yaxes(type="log", tickvals=TICKS, tickformat="~p", row=1, col=1)
    if warm:  # it often spans less than a decade
        figure.update_xaxes(dtick="D2", minor=None, row=2, col=1)
        figure.update_yaxes(type="log", dtick="D2", tickformat="~p", title_text=panels["gap"], row=2, col=1)
    figure.update_layout(
        height=520 + 330 * warm + 220 * (len(panels) - 1),
        template="plotly_white",
        margin={"l": 70, "r": 12, "t": 36, "b": 50},
        hoverlabel={"align": "left"},
        showlegend=False,
    )
    for annotation in figure.layout.annotations:  # pyright: ignore[reportAttributeAccessIssue]
        annotation.update(x=0.0, xanchor="left", font={"size": 14})
    figure.add_annotation(
        x=0.02, y=0.04, ax=70, ay=-42, xref="x domain", yref="y domain", text="better", showarrow=True, arrowhead=2
    )
    return figure


def _add_front(figure: go.Figure, chart: Chart) -> None:
    """The broad line behind all others: of no point on it another is both faster and lower; and the time to prepare."""
    front = chart.front
    figure.add_trace(
        go.Scatter(
            x=[max(p.ms, 1e-2) for p in front],
            y=[max(p.gap, FLOOR) for p in front],
            mode="lines",
            line={"color": FRONT, "width": 9, "shape": "hv"},
            hoverinfo="skip",
            name="the front",
        ),
        row=1,
        col=1,
    )
    if chart.prepared:
        figure.add_shape(
            type="rect",
            x0=1e-2,
            x1=chart.prepared,
            y0=0.0,
            y1=1.0,
            xref="x",
            yref="y domain",
            fillcolor="#f2f2f2",
            line={"width": 0},
            layer="below",
            label={"text": PREPARING, "textposition": "bottom left", "font": {"size": 11}},
        )


def _trace(chart: Chart, name: str, style: Style, points: Sequence[Point], *, field: str) -> go.Scatter:
    """Plot line of a method, in the legend group of the method's name."""
    ms = [max(p.ms, 1e-2) for p in points]
    most = [max(p.ms_most, median) - median for p, median in zip(points, ms, strict=True)]
    least = [median - min(max(p.ms_least, 1e-2), median) for p, median in zip(points, ms, strict=True)]
    bars = {"type": "data", "symmetric": False, "array": most, "arrayminus": least, "thickness": 1.5, "width": 3}
    return go.Scatter(
        x=ms,
        y=[max(p.gap, FLOOR) if field == "gap" else getattr(p, field) for p in points],
        name=name,
        legendgroup=name,
        mode="markers" if name in SIGNS else "lines+markers",
        line={"color": style.colour, "dash": "dash" if style.dashed else "solid", "width": 2},
        marker={
            "symbol": SIGNS.get(name, "triangle-up" if style.outside else "circle"),
            "size": 16 if name == DEFAULT else 8,
            "color": style.colour,
        },
        error_x=bars if field == "gap" else None,
        customdata=["<br>".join([settings(p), *figures(p, touches=bool(chart.panels))]) for p in points],
        hovertemplate=f"<b>{html.escape(name)}</b><br>%{{customdata}}<extra></extra>",
    )


def _legend(chart: Chart) -> str:
    """A button for each method, to hide and show the method's lines in every plot."""
    style = styles(chart)
    buttons = []
    for name in chart.methods:
        line_style, label = style[name], html.escape(name)
        look = f"border-top:3px {'dashed' if line_style.dashed else 'solid'} {line_style.colour}"
        drawn = f"<i style='{look}'></i>{label}"
        buttons.append(f"<button type=button aria-pressed=true data-method='{label}'>{drawn}</button>")
    words = "A click hides a method, another shows it again. Bars reach from the fastest turn to the slowest."
    return f"<div id='methods'>{''.join(buttons)}</div><p class='note'>{words}</p>"


def _looks(chart: Chart, folder: Path) -> str:
    parts = []
    for file, caption in looks_of(chart, folder):
        data, words = base64.b64encode(file.read_bytes()).decode("ascii"), html.escape(caption)
        picture = f"<img alt='{words}' src='data:image/png;base64,{data}'>"
        parts.append(f"<figure>{picture}<figcaption>{words}</figcaption></figure>")
    title = "<h2>What these percentages look like</h2>"
    return f"{title}<div class='looks'>{''.join(parts)}</div>" if parts else ""


def _lead(chart: Chart) -> str:
    paragraphs = advice(chart), chart.words_of_degrees(), warm_advice(chart), contact_words(chart)
    sentences = [paragraph for paragraph in paragraphs if paragraph]
    times = chart.times_to(JUDGED)
    if times:
        order = ", ".join(f"{name} {ms:.0f} ms" for name, ms in list(times.items())[:4])
        sentences.append(f"First to 3%: {order}.")
    if chart.busy:
        sentences.append(f"Warning: {chart.busy}.")
    return f"<p>{html.escape(' '.join(sentences))}</p><p class='note'>{html.escape(READING)}</p>"


def _terms(chart: Chart) -> str:
    effects = changes(chart)
    if not effects:
        return ""
    rows = [
        (
            effect.name,
            f"{effect.cost_ms:.1f}",
            percent(effect.fraction),
            "-" if effect.moved_mm > FAR else f"{effect.moved_mm:.3f}",
            effect.buys,
        )
        for effect in effects
    ]
    return (
        "<h2>What each part of the model costs and buys</h2>"
        + table("terms", ("part", "costs [ms]", "of the frame", "moves [mm]", "buys"), rows, numbers=(1, 2, 3))
        + "<p class='note'>By refine's default, with the part less without it; a level less the one below it. The "
        "result moves by the RMS distance between the two; gaps are by the full potential at the finest level.</p>"
    )


def _notes(chart: Chart) -> str:
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
