"""`refine_shot`: the one place where USD meets the solver; picks device, dtype and threads."""

from __future__ import annotations

import dataclasses
import resource
import sys
import time as clock
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from . import __version__
from .chunks import Outcome, solve_in_chunks
from .errors import LayerError, SolveError, UsageError
from .group import SolveSettings
from .integrate import method_named
from .levels import choose_levels
from .mesh.defects import defects
from .pipeline import Refiner
from .report import RefineReport
from .usd.provenance import file_hashes, write_root
from .usd.reader import Shot, open_shot
from .usd.writer import LayerWriter

TEMPORAL = ("tether", "warm", "off")
POTENTIALS = ("continuum", "paper")


@dataclass(frozen=True)
class RefineOptions:
    """Everything that `refine_shot` can be told.

    Attributes:
        frames: First and last time code, or None for all of the shot.
        garments: Prim paths, globs or collections; empty finds applied schemas.
        colliders: Prim paths, globs or collections; empty finds applied schemas.
        level: Subdivisions; -1 chooses, None takes the stage's.
        integrator: A name of `integrate.METHODS`.
        steps: Most steps at the finest level.
        tolerance: Stop when the cloth would move less than this, RMS, in local edge lengths.
        budget_ms: Milliseconds a frame, or None.
        device: "cpu" or "cuda".
        overrides: "</Prim>.attribute=value" or "attribute=value", as ``--set`` takes them.
        mode: "over" or "sibling".
        temporal: "tether", "warm" or "off": how a frame uses the last one.
        potential: "continuum" or "paper".
        workers: Processes that share the frames.
        report: JSON file to write, or None.
        overwrite: Replace files that exist.
        dry_run: Read and check everything, write nothing.
        velocities: Also write point velocities.
        rest_frame: Time code whose points are the rest shape, or None.
        root: A .usda to write that lays the new layer over the shot, or None.
        progress: Called with (frames done, frames in all), or None.
    """

    frames: tuple[float, float] | None = None
    garments: Sequence[str] = ()
    colliders: Sequence[str] = ()
    level: int | None = None
    integrator: str = "quasi-newton"
    steps: int = 12
    tolerance: float = 2e-3
    budget_ms: float | None = None
    device: str = "cpu"
    overrides: Sequence[str] = ()
    mode: str = "over"
    temporal: str = "tether"
    potential: str = "continuum"
    workers: int = 1
    report: Path | None = None
    overwrite: bool = False
    dry_run: bool = False
    velocities: bool = False
    rest_frame: float | None = None
    root: Path | None = None
    progress: Callable[[int, int], None] | None = None

    def plain(self) -> dict[str, Any]:
        """The options that decide the result, ready for JSON."""
        skipped = {"progress", "report", "overwrite", "dry_run", "workers", "root"}
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in skipped}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def refine_shot(shot: str | Path, out: str | Path, options: RefineOptions = RefineOptions()) -> RefineReport:
    """Refine a shot's garments into a new layer.

    Args:
        shot: The stage to read; never edited.
        out: The layer to write.
        options: What to do and how.

    Returns:
        The report. Frames that could not be solved are in ``failed`` and have no sample in the layer.

    Raises:
        UsageError: An option is wrong or the output exists.
        StageError: The stage cannot be read as asked.
        SolveError: No frame could be solved.
        LayerError: The layer cannot be written.
    """
    began = clock.perf_counter()
    out = Path(out)
    _check(options, out)
    opened = open_shot_for(shot, options)
    try:
        report = _begin_report(opened, options)
        report.seconds["open"] = clock.perf_counter() - began
        if options.dry_run:
            return report
        solver = _ShotSolver(str(shot), options)
        solver.adopt(opened)
        _write_layer(opened, solver, out, options, report)
    finally:
        opened.close()
    report.seconds["total"] = clock.perf_counter() - began
    report.peak_memory_mb = _peak_memory_mb()
    report.out = out
    if options.root is not None:
        write_root(Path(options.root), layer=out, shot=Path(shot), overwrite=options.overwrite)
    if options.report is not None:
        report.write(Path(options.report))
    return report


def inspect_shot(shot: str | Path, **given: Any) -> dict[str, Any]:
    """What would be refined, with what, from where, and every defect found.

    Args:
        shot: The stage to read.
        given: Options of `RefineOptions` that concern reading.

    Raises:
        StageError: The stage cannot be read.
    """
    options = RefineOptions(**given)
    opened = open_shot_for(shot, options)
    try:
        report = _begin_report(opened, options).to_dict()
        report["defects"] = {
            garment.path: [defect.message for defect in defects(garment.mesh, garment.rest)]
            for garment in opened.scene.garments
        }
        report["times"] = list(opened.scene.times)
        report["colliders"] = list(opened.colliders)
    finally:
        opened.close()
    wanted = ("shot", "times", "garments", "colliders", "defects", "modelled", "left_out", "warnings")
    return {name: report[name] for name in wanted}


def open_shot_for(shot: str | Path, options: RefineOptions) -> Shot:
    """Open a shot with the options that concern reading."""
    return open_shot(
        str(shot),
        garments=options.garments,
        colliders=options.colliders,
        frames=options.frames,
        level=options.level,
        overrides=options.overrides,
        rest_frame=options.rest_frame,
    )


class _ShotSolver:
    """Solves time codes of a shot; opens the shot for itself where it was not handed one."""

    def __init__(self, shot: str, options: RefineOptions) -> None:
        self._shot, self._options = shot, dataclasses.replace(options, progress=None)
        self._opened: Shot | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the stage behind: each process opens its own."""
        return self.__dict__ | {"_opened": None}

    def adopt(self, opened: Shot) -> None:
        """Use an open shot in this process."""
        self._opened = opened

    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        """Solve time codes in order; one that fails yields its error and the next starts cold."""
        prepare_device(self._options.device)
        shot = self._opened or open_shot_for(self._shot, self._options)
        levels = [choice.level for choice in choose_levels(shot.scene, shot.frame)]
        refiner = Refiner(
            shot.scene, settings_of(self._options), levels=levels, dtype=torch.float32, device=self._options.device
        )
        for time in times:
            read = clock.perf_counter()
            try:
                frame = shot.frame(time)
                read = 1e3 * (clock.perf_counter() - read)
                state = refiner.solve(frame, sampled_at(shot, time))
            except SolveError as error:
                refiner.forget()
                yield Outcome(time, (), (), {"time": time, "error": str(error)})
                continue
            record = {"time": time, "read_ms": round(read, 3), "garments": list(state.telemetry)}
            yield Outcome(time, state.points, state.reused, record)


def sampled_at(shot: Shot, time: float | None) -> list[bool]:
    """For each garment, whether the layer gets a sample at a time code: its own authored times, or the first of all."""
    first = shot.scene.times[0] if shot.scene.times else None
    return [time in source.times if source.times else time == first for source in shot.sources]


def settings_of(options: RefineOptions) -> SolveSettings:
    """The solver's settings for a run's options."""
    return SolveSettings(
        method=method_named(options.integrator),
        steps=options.steps,
        tolerance=options.tolerance,
        budget_ms=options.budget_ms,
        temporal=options.temporal,
        potential=options.potential,
    )


def prepare_device(device: str) -> None:
    """Start Warp, and keep torch on one thread: its sums depend on how many share them.

    Raises:
        UsageError: CUDA was asked for and is not there.
    """
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    torch.set_num_threads(1)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError("device 'cuda' was asked for and no CUDA device is there; use --device cpu")


def _write_layer(opened: Shot, solver: _ShotSolver, out: Path, options: RefineOptions, report: RefineReport) -> None:
    times: list[float | None] = list(opened.scene.times) or [None]
    choices = choose_levels(opened.scene, opened.frame)
    refinements = Refiner.subdivide(opened.scene, [choice.level for choice in choices])
    record = _provenance(opened, out, options)
    began, written = clock.perf_counter(), 0.0
    with LayerWriter(
        opened,
        refinements,
        out,
        mode=options.mode,
        velocities=options.velocities,
        provenance=record,
        overwrite=options.overwrite,
    ) as writer:
        run_up = 0 if options.temporal == "off" else None
        for done, outcome in enumerate(_outcomes(solver, times, options, run_up), start=1):
            report.frames.append(outcome.record)
            if outcome.points:
                start = clock.perf_counter()
                writer.write(outcome.time, outcome.points, changed=[not kept for kept in outcome.reused])
                written += clock.perf_counter() - start
            else:
                report.failed[_name(outcome.time)] = str(outcome.record["error"])
            if options.progress:
                options.progress(done, len(times))
        if report.failed and len(report.failed) == len(times):
            raise SolveError(next(iter(report.failed.values())))
        start = clock.perf_counter()
        writer.close()
        report.seconds["close"] = clock.perf_counter() - start
        report.warnings += [str(notice) for notice in writer.notices]
    report.seconds["write"] = written
    report.seconds["frames"] = clock.perf_counter() - began
    report.warnings += [str(notice) for notice in opened.warnings if str(notice) not in report.warnings]


def _outcomes(
    solver: _ShotSolver, times: list[float | None], options: RefineOptions, run_up: int | None
) -> Iterator[Outcome]:
    if run_up is None:
        return solve_in_chunks(solver, times, workers=options.workers)
    return solve_in_chunks(solver, times, workers=options.workers, run_up=run_up)


def _begin_report(opened: Shot, options: RefineOptions) -> RefineReport:
    """Everything that is known before the first frame is solved."""
    report = RefineReport(opened.path, None, options.plain())
    choices = choose_levels(opened.scene, opened.frame)
    first = opened.frame(opened.scene.times[0] if opened.scene.times else None)
    for garment, source, frame, choice in zip(
        opened.scene.garments, opened.sources, first.garments, choices, strict=True
    ):
        report.garments.append(
            {
                "path": garment.path,
                "points": garment.mesh.vertex_count,
                "faces": len(garment.mesh.counts),
                "size_m": [round(float(v), 4) for v in np.ptp(garment.rest, axis=0)]
                if len(garment.rest)
                else [0, 0, 0],
                "samples": len(source.times),
                "level": choice.level,
                "level_reason": choice.reason,
                "fabric": dataclasses.asdict(frame.fabric) | {"guide": frame.guide},
                "sources": dict(source.sources),
                "pinned_points": int((garment.pin > 0).sum()),
            }
        )
    report.modelled = {
        **_in_plane(report),
        "bending": "dihedral angles, " + ("rest shape" if any(g.bent_rest for g in opened.scene.garments) else "flat"),
        "gravity": f"{np.linalg.norm(opened.scene.gravity):.3g} m/s^2",
        "guide": "ties the local average to the coarse animation",
    }
    if options.temporal == "tether" and len(opened.scene.times) > 1:
        report.modelled["tether"] = "ties each frame to the last one's detail"
    report.left_out = {
        "contact": f"not in this version; {len(opened.colliders)} collider(s) found and ignored",
        "self contact": "not in this version",
        "network": "not in this version; quasi-Newton integrates",
    }
    if "membrane" not in report.modelled:
        report.left_out["triangle membrane"] = "no garment authors shear stiffness: edge springs have G = 0.375 Y"
    report.warnings += [str(notice) for notice in opened.warnings]
    return report


def _in_plane(report: RefineReport) -> dict[str, str]:
    """Which garments are sheets of edge springs, and which of triangles because shear stiffness is authored."""
    springs = [g["path"] for g in report.garments if g["fabric"]["shear"] is None]
    triangles = [g["path"] for g in report.garments if g["fabric"]["shear"] is not None]
    modelled = {"stretch": "edge springs" + (f" for {', '.join(springs)}" if triangles else "")} if springs else {}
    return modelled | ({"membrane": f"triangle membrane for {', '.join(triangles)}"} if triangles else {})


def _provenance(opened: Shot, out: Path, options: RefineOptions) -> dict[str, Any]:
    inputs = file_hashes(opened.stage, out.resolve().parent)
    return {"version": __version__, "options": options.plain(), "inputs": inputs}


def _check(options: RefineOptions, out: Path) -> None:
    """Refuse options that no shot could be refined with."""
    method_named(options.integrator)
    for name, value, known in (
        ("temporal", options.temporal, TEMPORAL),
        ("potential", options.potential, POTENTIALS),
    ):
        if value not in known:
            raise UsageError(f"unknown {name} '{value}'; known: {', '.join(known)}")
    if options.workers < 1 or options.steps < 0 or options.tolerance < 0:
        raise UsageError("workers must be at least 1, steps and tolerance at least 0")
    if options.device != "cpu" and not options.device.startswith("cuda"):
        raise UsageError(f"unknown device '{options.device}'; known: cpu, cuda")
    if not options.dry_run and not out.resolve().parent.is_dir():
        raise LayerError(f"the folder {out.resolve().parent} does not exist")


def _name(time: float | None) -> str:
    return "default" if time is None else f"{time:g}"


def _peak_memory_mb() -> float:
    """Peak resident memory of this process [MB]; Linux counts kilobytes, macOS bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)
