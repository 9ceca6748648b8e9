"""Which frames the solver left unsettled, unsolved, crossed or in bodies: what warnings, `--strict` and reports say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import groupby
from typing import Any

from ..errors import counted
from ..solver.integrate.solve import FAR

ROUNDING = 1e-3
"""Part of an energy that counts for nothing: sums are in single precision."""
COLLAPSED, LIMITED, UNSOLVED = "collapsed", "time limit", "not solved"


@dataclass(frozen=True)
class Unsettled:
    """A frame of a garment that did not settle.

    Attributes:
        level: The level at which it did not.
        remaining_move: RMS of H0^-1 F there, in local edge lengths; None where there was nothing to solve.
        stopped: Why its steps ended, as `LevelReport` says it, `COLLAPSED`, `LIMITED` or `UNSOLVED`.
        size: Of the cage over its rest shape's, where it has collapsed.
        error: Why it was not solved, "" where it was.
    """

    level: int
    remaining_move: float | None
    stopped: str
    size: float | None = None
    error: str = ""

    def __str__(self) -> str:
        """In words."""
        if self.error:
            return self.error
        if self.size is not None:
            return f"the cage has shrunk to {self.size:.2g} of its rest shape's size"
        why = "no step lowers the energy" if self.stopped == "stalled" else f"stopped by {self.stopped}"
        return f"level {self.level} would still move by {self.remaining_move:.2g} edges ({why})"


def unsettled(entry: Mapping[str, Any], tolerance: float) -> Unsettled | None:
    """Whether one garment's frame did not settle.

    It did not where a level's last descent ended because no step lowered the energy while it was not at rest, or where
    the finest level's remaining move is over `FAR` tolerances. A cage that has collapsed was not solved at all.

    Args:
        entry: The frame's telemetry of the garment.
        tolerance: Of the solve, in local edge lengths.
    """
    if "not_solved" in entry:
        return Unsettled(0, None, UNSOLVED, error=str(entry["not_solved"]))
    if "collapsed" in entry:
        return Unsettled(0, None, COLLAPSED, float(entry["collapsed"]))
    last = {each["level"]: each for each in entry.get("levels", ())}
    if "time_limit" in entry:
        level = max(last, default=0)
        return Unsettled(level, float(last[level]["remaining_move"]) if last else None, LIMITED)
    finest = max(last, default=0)
    for level in sorted(last, reverse=True):
        remaining, stopped = float(last[level]["remaining_move"]), str(last[level]["stopped"])
        far = level == finest and not remaining <= FAR * max(tolerance, 1e-6)
        if far or (stopped == "stalled" and remaining > tolerance):
            return Unsettled(level, remaining, stopped)
    return None


def unsettled_frames(
    garments: Sequence[Mapping[str, Any]], frames: Sequence[Mapping[str, Any]], *, tolerance: float
) -> list[dict[str, Any]]:
    """Every frame of every garment that did not settle, garment by garment.

    Args:
        garments: Of a report: with their paths.
        frames: Of the same report.
        tolerance: Of the solve, in local edge lengths.

    Returns:
        Plain values: path, time and the fields of `Unsettled`.
    """
    return [
        {"path": garment["path"], "time": frame["time"], **asdict(found)}
        for index, garment in enumerate(garments)
        for frame in frames
        if "garments" in frame and (found := unsettled(frame["garments"][index], tolerance))
    ]


def told_unsettled(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """Warnings of each garment: its frame that is farthest from rest, its first that collapsed, and all other ones."""
    said = []
    for path, each in groupby(found, key=lambda entry: str(entry["path"])):
        entries = list(each)
        named = {kind: [e for e in entries if e["stopped"] == kind] for kind in (COLLAPSED, LIMITED, UNSOLVED)}
        moving = [entry for entry in entries if entry["stopped"] not in named]
        moving.sort(key=lambda entry: -entry["remaining_move"])
        said += _told(path, moving, "the frame did not settle: {}; more --steps may help", others="nor did")
        reached = "the frame was not solved to its end: it reached its limit of time; see --frame-limit"
        said += _told(path, named[LIMITED], reached, others="nor was it")
        remedy = "cache that frame again, or leave it out with --frames"
        said += _told(
            path, named[COLLAPSED], f"{{}}; the frame is upsampled, not solved: {remedy}", others="so it is at"
        )
        said += _told(
            path, named[UNSOLVED], f"{{}}; it follows its cage there, not solved: {remedy}", others="so it is at"
        )
    return said


def told_contact(path: str, entries: Mapping[float | None, Mapping[str, Any]]) -> list[str]:
    """A warning for each kind of contact that a garment's result does not keep, with its worst frame.

    Args:
        path: The garment.
        entries: Its telemetry by time code.
    """
    found: dict[tuple[str, str], dict[float | None, tuple[int, int]]] = {}
    for time, entry in entries.items():
        contact = entry.get("contact", {})
        found.setdefault(("edge", "through cloth"), {})[time] = _counts(contact.get("cloth", {}), "crossings")
        for body, told in contact.get("bodies", {}).items():
            found.setdefault(("edge", f"through <{body}>"), {})[time] = _counts(told, "crossings")
            found.setdefault(("vertex", f"inside <{body}>"), {})[time] = _counts(told, "inside")
            passing = f"inside <{body}>, which lies between cloth and where the cage has it"
            found.setdefault(("vertex", passing), {})[time] = _counts(told, "passing")
    said = []
    for (noun, where), counts in found.items():
        left = {time: count for time, count in counts.items() if count[1]}
        if left:
            worst = max(left, key=lambda time: left[time][1])
            (before, after), code = left[worst], "default" if worst is None else f"{worst:g}"
            what = counted(after, noun, "vertices" if noun == "vertex" else "")
            others = f", and fewer in {counted(len(left) - 1, 'other frame')}" if len(left) > 1 else ""
            said.append(f"<{path}> at time code {code}: {what} left {where} ({before:,} in the input){others}")
    return said


def told_energy(path: str, entries: Mapping[float | None, Mapping[str, Any]]) -> list[str]:
    """A warning where refined cloth has more energy than its upsampled cage, with the worst frame.

    No descent ends above its start, but warm frames start from the last one's detail, and what is pushed out of bodies
    or drawn apart pays for it.

    Args:
        path: The garment.
        entries: Its telemetry by time code.
    """
    worse: dict[float | None, tuple[float, float]] = {}
    for time, entry in entries.items():
        if entry.get("together", [path])[0] != path:  # Garments that are solved together have one energy.
            continue
        before, after = (sum((entry.get("energy_joules") or {}).get(side, {}).values()) for side in ("input", "output"))
        if after > (1.0 + ROUNDING) * before:
            worse[time] = before, after
    if not worse:
        return []
    worst = max(worse, key=lambda time: worse[time][1] - worse[time][0])
    (before, after), code = worse[worst], "default" if worst is None else f"{worst:g}"
    others = f"; so it is in {counted(len(worse) - 1, 'other frame')}" if len(worse) > 1 else ""
    said = f"its energy is {after:.3g} J, its upsampled cage's {before:.3g} J; more --steps may help"
    return [f"<{path}> at time code {code}: {said}{others}"]


def _counts(told: Mapping[str, Any], name: str) -> tuple[int, int]:
    """A count of what touches in the upsampled input and in the result; 0 where it was not measured."""
    before, after = (int(told.get(side, {}).get(name, 0)) for side in ("before", "after"))
    return before, after


def _told(path: str, entries: Sequence[Mapping[str, Any]], said: str, *, others: str) -> list[str]:
    """A warning of the first entry, with the time codes of the others; none of no entries."""
    if not entries:
        return []
    first, *codes = ["default" if entry["time"] is None else f"{entry['time']:g}" for entry in entries]
    how = Unsettled(**{own.name: entries[0][own.name] for own in fields(Unsettled)})
    more = f"; {others} time code {', '.join(codes)}" if codes else ""
    place = f"<{path}> at time code {first}: "
    return [place + said.format(str(how).removeprefix(place)) + more]
