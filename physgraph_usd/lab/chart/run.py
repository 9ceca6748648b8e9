"""`chart_shot`: measures methods and budgets on a shot and writes the chart."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...errors import UsageError
from ...shot.findings.untagged import open_with_colliders
from ...shot.options import RefineOptions
from ...shot.solve import prepare_device
from ...shot.workers import cores
from ...solver.resolution import choose_levels, sample_frames
from ...solver.scene import Frame, Scene
from ...usd.files import check_targets, files_of
from ...usd.provenance import file_hashes
from ...usd.read.reader import Shot
from ...usd.write.atomic import check_place
from ...version import __version__
from .journal import NAME as JOURNAL
from .journal import Journal
from .looks import draw_looks
from .measure import Curve, CurveBench, find_curves
from .options import LONG, ChartOptions, Clock, Plan, make_plan
from .page import write_page
from .peers.run import measure_peers, parse_peers
from .plot import draw_chart
from .problem import COLD, Problem, plain_detail
from .reference import Solutions, find_reference
from .table import Chart, collate
from .terms import RUN, TermBench, measure_terms
from .warm import ROW, measure_warm

DEFAULTS = ChartOptions()
WRITTEN = ("chart.png", "chart.svg", "chart.html", "chart.csv", "chart.json")
"""Files written beside the chart's rows."""


def chart_shot(shot: str | Path, folder: str | Path, options: ChartOptions = DEFAULTS) -> Chart:
    """Chart speed against accuracy on a shot.

    Args:
        shot: The stage to read; never edited.
        folder: Folder for `WRITTEN` and the rows of all measurements; an unfinished chart in the folder is continued.

    Raises:
        UsageError: An option is wrong, or the folder holds the chart of another shot.
        StageError: The stage cannot be read as asked.
        SolveError: A frame cannot be solved.
    """
    options.check()
    parse_peers(options.peers)
    prepare_device(options.device)
    folder = Path(folder)
    _check_folder(folder, shot, overwrite=options.overwrite)
    opened = open_with_colliders(
        str(shot),
        garments=options.garments,
        colliders=options.colliders,
        frames=options.frames,
        level=options.level,
        overrides=options.overrides,
        rest_frame=options.rest_frame,
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        chart = _measure(opened, folder, options)
    finally:
        opened.close()
    chart.write(folder)
    draw_chart(chart, folder)
    write_page(chart, folder / "chart.html")
    return chart


def _check_folder(folder: Path, shot: str | Path, *, overwrite: bool) -> None:
    """Refuse to write over the shot's files, and over a chart whose rows are gone."""
    files = [folder / name for name in (*WRITTEN, JOURNAL)]
    check_targets([("the chart", file) for file in files], files_of(shot))
    existing = next((file for file in files if file.exists()), None)
    if existing is not None and not overwrite and not files[-1].exists():
        raise UsageError(f"{existing} exists; choose another folder or replace it by --overwrite")
    for file in files:
        check_place(file)


def _measure(opened: Shot, folder: Path, options: ChartOptions) -> Chart:
    """Measure the missing rows of the folder, and draw pictures of gaps."""
    clock = Clock(options.size().minutes, options.progress)
    clock.say("reading and building")
    levels = tuple(
        choice.level for choice in choose_levels(opened.scene, sample_frames(opened.every_time, opened.frame))
    )

    def build(scene: Scene, levels: Sequence[int], dtype: torch.dtype = torch.float32) -> Problem:
        threads = cores() if options.clock == "wall" else 1
        return Problem(scene, levels, device=options.device, threads=threads, dtype=dtype, clock=options.clock)

    problems = build(opened.scene, levels), build(opened.scene, levels, torch.float64)
    about = _about(opened, levels, options) | {"vertices": problems[0].vertex_count}
    journal = Journal(folder, about, overwrite=options.overwrite)
    solutions = Solutions(folder, fresh=not journal.rows("reference"))
    curves = find_curves(options.names())
    plan = _plan(journal, problems, _frame(opened, _times(opened, 1)[0]), curves=curves, options=options)
    clock.expect(60.0 * plan.minutes)
    frames = tuple(_frame(opened, time) for time in _times(opened, plan.frames))
    for frame in frames:
        if not journal.one("reference", frame=frame.time):
            clock.say("the least energy of a frame")
            reference = find_reference(problems[1], frame, seconds=plan.reference_seconds)
            solutions.keep(frame.time, reference.points)
            journal.add("reference", frame=frame.time, **reference.plain())
    bench = CurveBench(journal, problems, frames, plan=plan, clock=clock, solutions=solutions)
    bench.measure(curves)
    measure_peers(bench, parse_peers(options.peers), clock_name=options.clock)
    times: list[float | None] = list(opened.scene.times)
    end = times.index(frames[-1].time) + 1 if times else 0
    row = tuple(_frame(opened, time) for time in times[max(0, end - RUN) : end])
    clock.enter("warm")
    measure_warm(journal, problems, row[-ROW:], clock)
    measure_terms(journal, TermBench(*problems, opened.scene, levels, frames=frames, row=row, build=build), clock)
    chart = collate(journal)
    clock.say("pictures", 1.0)
    draw_looks(chart, problems[0], frames[-1], solutions.points(frames[-1].time), folder)
    return chart


def _plan(
    journal: Journal,
    problems: tuple[Problem, Problem],
    frame: Frame,
    *,
    curves: Sequence[Curve],
    options: ChartOptions,
) -> Plan:
    """The plan of a chart that was begun, or a new one from a probe of a frame."""
    if stored := journal.one("plan"):
        return Plan(**stored["plan"])
    timed, judge = problems
    spent = [timed.solve(frame, COLD) for _ in range(3)]
    judge.judge(frame, spent[-1].points)
    began = time.perf_counter()
    judge.judge(frame, spent[-1].points)
    plan_of = partial(
        make_plan,
        curves=len(curves),
        default_ms=statistics.median(frame.milliseconds for frame in spent[1:]),
        elapsed_ms=statistics.median(frame.elapsed for frame in spent[1:]),
        judge_ms=1e3 * (time.perf_counter() - began),
        least_ms=timed.solve(frame, replace(COLD, steps=1, tolerance=0.0)).elapsed,
    )
    plan = plan_of(options.size())
    journal.add("plan", plan=asdict(plan), long_minutes=plan_of(LONG).minutes)
    return plan


def _about(opened: Shot, levels: Sequence[int], options: ChartOptions) -> dict[str, Any]:
    """The measured problem: rows of a different problem do not belong to the chart."""
    device = options.device
    name = torch.cuda.get_device_name(device) if device.startswith("cuda") else platform.processor()
    return {
        "shot": Path(opened.path).name,
        "version": __version__,
        "levels": list(levels),
        "device": device,
        "processor": name or platform.machine(),
        "cores": cores(),
        "clock": options.clock,
        "default": {"integrator": RefineOptions().integrator, "steps": COLD.steps, "tolerance": COLD.tolerance},
        "options": options.plain(),
        "frames": list(options.frames or ()),
        "inputs": file_hashes(opened.stage, Path(opened.path).resolve().parent),
    }


def _frame(opened: Shot, time: float | None) -> Frame:
    return plain_detail(opened.frame(time))


def _times(opened: Shot, count: int) -> list[float | None]:
    """Frames spread over the shot, always including the last."""
    times = opened.scene.times
    if not times:
        return [None]
    picks = np.unique(np.linspace(0, len(times) - 1, min(count, len(times)) + 1).round().astype(int)[1:])
    return [times[i] for i in picks]
