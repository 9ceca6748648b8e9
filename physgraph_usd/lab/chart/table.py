"""Rows to curves: gaps, medians, who is fastest to a gap, and whether refine's default is on the front."""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from ...errors import counted
from ...shot.plain_json import to_json
from .journal import Journal
from .measure import DEFAULT
from .problem import over_frames
from .reference import Reference

GAPS = (0.1, 0.03, 0.01)
"""Gaps with times in the table."""
TOLERANCE = 1.1
"""Times that differ by less than this factor count as equal: medians of a few runs are no better."""
BUSY = 0.1
"""Least fraction of time waiting for a core for a warning."""
TINY = 1e-12
CONTACT = {
    "percent": "vertices inside bodies [%]",
    "crossings": "edges through faces of bodies",
    "tangles": "edges of cloth through cloth",
}
SEEN = {"degrees": "angle of the folds to the converged frame [degrees]"}
LIKENESS = {"strain": "edge strain, 99th percentile", "apart_mm": "distance from Phi*'s shape [mm]"}
"""Fields of points, with titles."""


@dataclass(frozen=True)
class Point:
    """A method with a budget, on frames started cold, or on consecutive frames, each started from the previous result.

    Attributes:
        method: The curve's name.
        integrator: Name of the integrator, "" where none was asked for by name.
        nested: Whether coarse levels are solved first.
        steps: Budget of steps at the finest level.
        made: Steps made at the finest level, mean over the frames.
        tolerance: Remaining move for stopping [edge lengths]; 0 to make all steps.
        ms: Milliseconds a frame: `typical` over the repeats, mean over the frames.
        ms_median: Milliseconds by the median of all repeats.
        ms_least: Milliseconds of the fastest repeats.
        ms_most: Milliseconds of the slowest repeats.
        ms_prepared: Milliseconds of preparing the frame, in `ms`; 0 where no solver of ours ran.
        gap: (Phi - Phi*) / (Phi0 - Phi*), both summed over the frames.
        energy: Phi, mean over the frames [J].
        energies: Phi by term [J].
        strain, inside, percent, deepest_mm, crossings, tangles: As for `Judgement`, over the frames by `OVER_FRAMES`.
        frames: Number of judged frames: all, or the last of a row.
        repeats: Number of times that the time was taken.
        note: How much of the problem a solver outside was given, "" for ours.
        degrees: Median angle between the vertex normals and the reference's [degrees], mean over the frames; None where
            the reference's shape is not known.
        apart_mm: RMS distance from the reference's positions [mm], mean over the frames; None where they are not known.
    """

    method: str
    integrator: str
    nested: bool | None
    steps: int
    made: float
    tolerance: float
    ms: float
    ms_median: float
    ms_least: float
    gap: float
    energy: float
    energies: dict[str, float]
    strain: float
    inside: int
    percent: float
    deepest_mm: float
    crossings: int
    tangles: int
    frames: int
    repeats: int
    note: str
    apart_mm: float | None
    degrees: float | None
    ms_most: float
    ms_prepared: float


@dataclass(frozen=True)
class Chart:
    """Measurements on a shot.

    Attributes:
        about: The shot, the machine, the plan and refine's default.
        points: Every method with every budget, curve by curve, in the order of the budgets.
        references: Per frame, Phi0, Phi*, the method behind Phi* and the distance to the second best.
        terms: What each term, the last frame's detail and each level cost and buy.
        failed: Runs with an error.
        warm: Methods on consecutive frames, each started from the previous result.
    """

    about: dict[str, Any]
    points: tuple[Point, ...]
    references: tuple[dict[str, Any], ...]
    terms: tuple[dict[str, Any], ...]
    failed: tuple[dict[str, Any], ...]
    warm: tuple[Point, ...]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the curves, the most accurate ones first."""
        names = dict.fromkeys(point.method for point in self.points)
        return tuple(sorted(names, key=lambda name: min(p.gap for p in self.points if p.method == name)))

    @property
    def busy(self) -> str:
        """Warning of programs using the cores during measurement; "" without any."""
        waited = self.about["waited"]
        if waited < BUSY or self.about.get("clock") == "cpu":
            return ""
        return f"the machine was busy: threads waited for a core {waited:.0%} of the time, so trust no single time"

    @property
    def panels(self) -> dict[str, str]:
        """Titles of the measures of contact that are not 0 for every method, by field of `Point`."""
        return {name: title for name, title in CONTACT.items() if self._has(name)}

    @property
    def zeros(self) -> tuple[str, ...]:
        """Titles of the measures of contact that are 0 for every method; without bodies only those of cloth alone."""
        touches = any("contact" in point.energies for point in self.points)
        return tuple(title for name, title in CONTACT.items() if not self._has(name) and (touches or name == "tangles"))

    @property
    def prepared(self) -> float:
        """Milliseconds of preparing a cold frame by refine's default; 0 if unknown."""
        return next((point.ms_prepared for point in self.curve(DEFAULT)), 0.0)

    @property
    def likeness(self) -> dict[str, str]:
        """Titles of measured similarities to external solvers, by field of `Point`; empty without such solvers."""
        return {name: title for name, title in LIKENESS.items() if self.notes and self._has(name)}

    @property
    def seen(self) -> dict[str, str]:
        """Title of the angle to the converged frame by field of `Point`; empty where no reference's shape is known."""
        return SEEN if self._has("degrees") else {}

    def words_of_degrees(self) -> str:
        """How far refine's default ends from the converged frame, in a sentence; "" if unknown."""
        default = next(iter(self.curve(DEFAULT)), None)
        if default is None or default.degrees is None:
            return ""
        return f"Refine's default: half of the folds are within {default.degrees:.2g} degrees of the converged frame."

    @property
    def notes(self) -> dict[str, str]:
        """How much of the problem each solver outside was given, by its name."""
        return {point.integrator: point.note for point in self.points if point.note}

    def _has(self, name: str) -> bool:
        """Whether a field of any point is not zero."""
        return any(getattr(point, name) for point in self.points)

    def curve(self, method: str) -> tuple[Point, ...]:
        """The points of one method, in the order of the budgets."""
        return tuple(sorted((p for p in self.points if p.method == method), key=lambda p: p.steps))

    @property
    def front(self) -> tuple[Point, ...]:
        """The points that no other is both faster and lower than, the fastest first; none of solvers outside."""
        best: list[Point] = []
        for point in sorted((p for p in self.points if not p.note), key=lambda p: (p.ms, p.gap)):
            if not best or point.gap < best[-1].gap:
                best.append(point)
        return tuple(best)

    def time_to(self, method: str, gap: float) -> float | None:
        """Time of a method to a gap [ms], interpolated between budgets by a power law; None for a gap never reached."""
        best: list[Point] = []
        for point in self.curve(method):
            if not best or point.gap < best[-1].gap:
                best.append(point)
        if best and best[0].gap <= gap:
            return best[0].ms
        for last, point in pairwise(best):
            if point.gap <= gap:
                part = math.log(last.gap / gap) / math.log(last.gap / max(point.gap, TINY))
                return last.ms * (point.ms / last.ms) ** part
        return None

    def times_to(self, gap: float) -> dict[str, float]:
        """Milliseconds to a gap of the methods reaching the gap, the fastest first."""
        time_of = {name: t for name in self.methods if name != DEFAULT and (t := self.time_to(name, gap)) is not None}
        return dict(sorted(time_of.items(), key=lambda item: item[1]))

    def default_place(self) -> dict[str, Any] | None:
        """Whether refine's default is on the front: its time over the least time to the same gap."""
        default = next(iter(self.curve(DEFAULT)), None)
        if default is None:
            return None
        fastest, least = next(iter(self.times_to(default.gap).items()), (DEFAULT, default.ms))
        ratio = default.ms / least
        standing = {"gap": default.gap, "ms": default.ms, "fastest": fastest, "fastest_ms": least, "ratio": ratio}
        return standing | {"on_front": ratio <= TOLERANCE}

    def to_dict(self) -> dict[str, Any]:
        """The chart as plain values."""
        times = {f"{gap:g}": self.times_to(gap) for gap in GAPS}
        return {"default": self.default_place(), "milliseconds_to_gap": times, **asdict(self)}

    def write(self, folder: Path) -> None:
        """Write ``chart.json`` and ``chart.csv``."""
        (folder / "chart.json").write_text(to_json(self.to_dict()) + "\n", encoding="utf-8")
        terms = sorted({name for point in self.points for name in point.energies})
        with (folder / "chart.csv").open("w", encoding="utf-8", newline="") as file:
            rows = [asdict(point) for name in self.methods for point in self.curve(name)]
            for row in rows:
                energies = row.pop("energies")
                row |= {f"{name}_joules": energies.get(name, "") for name in terms}
            writer = csv.DictWriter(file, list(rows[0]) if rows else ["method"])
            writer.writeheader()
            writer.writerows(rows)

    def lines(self) -> Iterator[str]:
        """The printed summary: a table in Markdown, and the default's standing."""
        yield "| method | " + " | ".join(f"ms to {gap:.0%}" for gap in GAPS) + " | least gap | degrees | at ms |"
        yield "|" + "---|" * (len(GAPS) + 4)
        for name in self.methods:
            best = min(self.curve(name), key=lambda point: point.gap)
            times = [self.time_to(name, gap) for gap in GAPS]
            cells = ["-" if t is None else f"{t:.0f}" for t in times]
            degrees = "-" if best.degrees is None else f"{best.degrees:.1f}"
            yield f"| {name} | {' | '.join(cells)} | {best.gap:.2%} | {degrees} | {best.ms:.1f} |"
        standing = self.default_place()
        if standing is not None:
            where = "on the front" if standing["on_front"] else "not on the front"
            yield ""
            yield (
                f"refine's default: {standing['gap']:.2%} in {standing['ms']:.0f} ms, {standing['ratio']:.2f} times "
                f"the {standing['fastest_ms']:.0f} ms of the fastest to that gap ({standing['fastest']}): {where}"
            )
        if words := self.words_of_degrees():
            yield words
        for reference in self.references:
            where = "" if reference["frame"] is None else f"frame {reference['frame']:g}: "
            yield f"{where}{Reference.of(reference)}"
        if self.busy:
            yield self.busy
        yield from (f"{name} was given {note}" for name, note in self.notes.items())
        if longer := self.about.get("long_minutes"):
            yield f"the long form would take about {longer:.0f} minutes here"


def typical(times: Sequence[float]) -> float:
    """Median of the faster half: whatever else a machine does only ever adds to a time."""
    return statistics.median(sorted(times)[: -(-len(times) // 2)])


def collate(journal: Journal) -> Chart:
    """Put a journal's rows together."""
    cold, warm = journal.rows("point"), journal.rows("warm")
    references_of = {row["frame"]: Reference.of(row) for row in journal.rows("reference")}
    for row in (*cold, *warm):
        if row["frame"] in references_of and "energies" in row:
            by = f"{row['method']}, {counted(row['steps'], 'step')}" + (", warm" if row["row"] == "warm" else "")
            references_of[row["frame"]] = references_of[row["frame"]].lowered(row["energies"], by)
    last = {row["frame"]: references_of[row["frame"]] for row in warm if row["frame"] in references_of}
    plan = journal.one("plan") or {}
    about = journal.rows("problem")[0]["problem"] | {name: plan.get(name) for name in ("plan", "long_minutes")}
    about["waited"] = sum(r.get("waited") or 0.0 for r in cold) / max(sum(r.get("elapsed", 0.0) for r in cold), TINY)
    terms, failed = (
        tuple({name: value for name, value in row.items() if name != "row"} for row in journal.rows(kind))
        for kind in ("term", "failed")
    )
    references = tuple({"frame": frame, **reference.plain()} for frame, reference in references_of.items())
    in_rows = sorted(_points(warm, last), key=lambda point: (point.method, point.steps))
    return Chart(about, tuple(_points(cold, references_of)), references, terms, failed, tuple(in_rows))


def _points(rows: Sequence[dict[str, Any]], references: dict[Any, Reference]) -> Iterator[Point]:
    """The point of each method at each budget for which all frames were measured."""
    for key in dict.fromkeys((row["method"], row["steps"]) for row in rows):
        matching = [row for row in rows if (row["method"], row["steps"]) == key]
        if {row["frame"] for row in matching if "energies" in row} == set(references):
            yield _point(matching, references)


def _point(rows: Sequence[dict[str, Any]], references: dict[Any, Reference]) -> Point:
    judged = {row["frame"]: row for row in rows if "energies" in row}
    times = [[row["ms"] for row in rows if row["frame"] == frame] for frame in judged]
    first, values = rows[0], list(judged.values())
    energies = {name: statistics.fmean(v["energies"].get(name, 0.0) for v in values) for name in values[0]["energies"]}
    least, start = (sum(getattr(reference, name) for reference in references.values()) for name in ("least", "start"))
    energy = sum(energies.values())
    return Point(
        method=first["method"],
        integrator=first.get("integrator", ""),
        nested=first.get("nested"),
        steps=first["steps"],
        made=statistics.fmean(v.get("made", v["steps"]) for v in values),
        tolerance=first.get("tolerance", 0.0),
        ms=statistics.fmean(typical(repeats) for repeats in times),
        ms_median=statistics.fmean(statistics.median(repeats) for repeats in times),
        ms_least=statistics.fmean(min(repeats) for repeats in times),
        ms_most=statistics.fmean(max(repeats) for repeats in times),
        ms_prepared=statistics.fmean(row.get("prepared", 0.0) for row in values),
        gap=(len(values) * energy - least) / max(start - least, TINY),
        energy=energy,
        energies=energies,
        percent=statistics.fmean(v["percent"] for v in values),
        **over_frames(values),
        frames=len(values),
        repeats=min(len(repeats) for repeats in times),
        note=first.get("note", ""),
        apart_mm=_mean_known(values, "apart_mm"),
        degrees=_mean_known(values, "degrees"),
    )


def _mean_known(values: Sequence[dict[str, Any]], name: str) -> float | None:
    """Mean of a value over the frames; None if some frame has none."""
    values_known = [value for v in values if (value := v.get(name)) is not None]
    return statistics.fmean(values_known) if len(values_known) == len(values) else None
