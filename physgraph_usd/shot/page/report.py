"""Writes a run's report into a folder: ``report.json`` and ``report.html``."""

from __future__ import annotations

import base64
import html
import importlib
import io
import time as clock
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ...errors import LayerError, StageError, named_time
from ...usd.read.reader import Shot
from ...usd.write.atomic import write_text
from ..options import PAGE_NAME, REPORT_NAME
from ..report import RefineReport
from .document import document, table
from .plot import SCRIPT, plot
from .series import Series, add_jerk, read_series
from .worst import close_up, verdict

SIZE = (1280, 640)
PLOTS = (
    ("energy", "Energy by term [mJ]"),
    ("strain", "Extension of the edges: median, 99th percentile and largest [%]"),
    ("remaining", "Move that the end of the solve leaves: RMS [mm]"),
    ("inside", "Vertices inside bodies"),
    ("depth", "Deepest vertex inside bodies [mm]"),
    ("crossings", "Edges through faces"),
    ("jerk", "Jerk of the detail: third difference between samples, RMS [fine edges]"),
    ("time", "Wall time [ms]"),
)


def write_folder(report: RefineReport, folder: Path, shot: Shot) -> None:
    """Write a run's report as JSON and as a page.

    Args:
        report: The report of a run with a written layer.
        folder: The folder; created if missing.
        shot: The shot, open.

    Raises:
        LayerError: A file cannot be written.
    """
    began = clock.perf_counter()
    series = [read_series(report, index) for index in range(len(report.garments))]
    assert report.out is not None
    add_jerk(series, report, shot, report.out)
    pictures = _pictures(report, shot)
    report.seconds["report"] = clock.perf_counter() - began
    report.seconds["total"] += report.seconds["report"]
    report.write(folder / REPORT_NAME)
    write_text(folder / PAGE_NAME, page(report, series, pictures))


def page(report: RefineReport, series: Sequence[Series], pictures: str = "") -> str:
    """The page as HTML.

    Args:
        series: Lines of every garment.
        pictures: The pictures, as HTML.
    """
    parts = [_head(report), pictures, _warnings(report), _model(report), _garments(report), _times(report)]
    times = [frame["time"] for frame in report.frames]
    for index, (garment, lines) in enumerate(zip(report.garments, series, strict=True)):
        parts.append(f"<h2>&lt;{html.escape(garment['path'])}&gt; over time</h2>")
        drawn = [
            plot(f"{name}-{index}", title, [0.0 if t is None else t for t in times], lines.get(name, {}))
            for name, title in PLOTS
        ]
        parts.append("".join(drawn) or "<p>No frame says anything of it.</p>")
    parts.append(_options(report))
    return document(f"Refined: {Path(report.shot).name}", "\n".join(parts), script=SCRIPT)


def _head(report: RefineReport) -> str:
    memory = "" if report.peak_memory_mb is None else f" Peak memory {report.peak_memory_mb:.0f} MB."
    return (
        f"<h1>{html.escape(Path(report.shot).name)}</h1>"
        f"<p id='verdict'>{html.escape(verdict(report))}</p>"
        f"<p class='note'>Written to {html.escape(str(report.out))}.{memory}{_largest_remaining(report)}</p>"
    )


def _largest_remaining(report: RefineReport) -> str:
    """A sentence on the frame whose solve was ended farthest from rest; "" if no frame was solved."""
    remaining = [
        (garment["remaining_mm"], frame["time"])
        for frame in report.frames
        for garment in frame.get("garments", ())
        if garment.get("remaining_mm") is not None
    ]
    if not remaining:
        return ""
    most, time = max(remaining, key=lambda entry: entry[0])
    frame_name = "the only frame" if time is None else f"time code {named_time(time)}"
    return f" The end of a frame's solve leaves a move of at most {most:.2g} mm (RMS over the cloth), in {frame_name}."


def _warnings(report: RefineReport) -> str:
    """Warnings, each with its prim and time code, and notes."""
    return "".join(
        f"<h2>{name.title()}</h2>"
        + (
            f"<ul class='warnings' id='{name}'>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>"
            if lines
            else f"<p id='{name}'>None.</p>"
        )
        for name, lines in (("warnings", report.warnings), ("notes", report.notes))
    )


def _pictures(report: RefineReport, shot: Shot) -> str:
    """A close picture of the worst place or the best fold, and coarse beside fine at a few time codes."""
    title = "<h2>Before and after</h2>"
    if find_spec("PIL") is None:
        return f"{title}<p class='note'>No pictures: PIL is missing; pip install pillow</p>"
    kind = importlib.import_module(".preview", __package__).Pictures  # Needs an optional extra.
    written = [frame["time"] for frame in report.frames if "garments" in frame]
    times = [written[0], written[-1]][: len(written)]
    picture = close_up(report, shot)
    try:
        pictures = kind(report.out, Path(report.shot), SIZE, codes=[time for time in written if time is not None])
        image, words = (None, "") if picture is None else pictures.draw_close(picture)
        close = "" if picture is None else _figure(image, "; ".join(filter(None, (picture.caption, words))))
        drawn = pictures.draw(times) if times else []
    except (StageError, LayerError) as error:
        return f"{title}<p class='note'>No pictures: {html.escape(str(error))}</p>"
    captions = ["the only frame" if time is None else f"time code {named_time(time)}" for time in times]
    return close + title + "".join(map(_figure, drawn, captions))


def _figure(picture: Any, caption: str) -> str:
    stream = io.BytesIO()
    picture.save(stream, "PNG", compress_level=1)
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return (
        f"<figure><img alt='input beside refined, {html.escape(caption)}' width='{SIZE[0]}' height='{SIZE[1]}' "
        f"src='data:image/png;base64,{data}'><figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _times(report: RefineReport) -> str:
    rows = [(name, f"{seconds:.2f}") for name, seconds in report.seconds.items()]
    return "<h2>Time</h2>" + table("time", ("stage", "seconds of wall time"), rows, numbers=[1])


def _model(report: RefineReport) -> str:
    """Modelled terms and omitted terms, with reasons."""
    return (
        "<h2>What was modelled</h2>"
        + table("modelled", ("term", "how"), list(report.modelled.items()))
        + "<h2>What was left out</h2>"
        + table("left-out", ("what", "why"), list(report.left_out.items()))
    )


def _garments(report: RefineReport) -> str:
    """Size, level and fabric of each garment, and the sources of the values."""
    rows = [
        (
            garment["path"],
            f"{garment['points']:,} points, {' x '.join(f'{length:.2f}' for length in garment['size_m'])} m",
            f"level {garment['level']}, edges of {garment['fine_edge_mm']:.2f} mm: {garment['level_reason']}",
            ", ".join(f"{name} {value:.4g}" for name, value in garment["fabric"].items() if value is not None),
            ", ".join(f"{name}: {source}" for name, source in garment["sources"].items()) or "fallbacks",
        )
        for garment in report.garments
    ]
    return "<h2>Garments</h2>" + table("garments", ("garment", "cage", "level", "values (SI)", "from"), rows)


def _options(report: RefineReport) -> str:
    rows = [(name, _plain(value)) for name, value in report.options.items()]
    return "<h2>Options</h2>" + table("options", ("option", "value"), rows)


def _plain(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "-"
    return "-" if value is None else str(value)
