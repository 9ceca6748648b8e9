"""The report of a run: terms modelled, terms left out with the reason, and the outcome of each frame."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from ..errors import named, place_of
from ..interrupts import SIGNALLED
from ..solver.scene import Result
from ..usd.write.atomic import write_text
from ..version import __version__
from .plain_json import to_json

FORMAT = 1
"""Version of the JSON format; increased when a reader of the previous version could fail. See report.schema.json."""
SCHEMA = Path(__file__).with_name("report.schema.json")
DONE, FAILED, IN_PART = 0, 1, 3
LEFT = 0.1
"""Fraction of the input's crossings allowed to remain in a strict run."""
LOG = logging.getLogger("physgraph_usd")
"""Logger of the whole package, for warnings and progress."""
MOST_NAMED = 3
"""Most prims, parts or time codes named in one warning."""
_OF_PRIM = re.compile(r"<([^>]+)>(?=[: ])")
_ALSO, _DIFFERS = re.compile(r"; also (?:at|in) .*$"), re.compile(r"<[^>]*>|[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")
_FRAME: dict[str, Any] = {"time": None, "read_ms": None, "run_in_ms": None, "poses": None, "garments": [], "error": ""}


def faults_of(contact: Mapping[str, Any], side: str) -> int:
    """Crossings of cloth and with all bodies, and vertices inside bodies, "before" or "after"."""
    names = ("crossings", "inside", "pinched")
    return sum(int(part.get(side, {}).get(name, 0)) for part in _parts_of(contact) for name in names)


def _parts_of(contact: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Measurements of contact with cloth, if any, and with each body."""
    return [part for part in (contact.get("cloth"), *(contact.get("bodies") or {}).values()) if part]


def is_first(path: str, entry: Mapping[str, Any]) -> bool:
    """Whether a garment is the first of a group solved together in a frame: the group shares energy and contact."""
    return entry.get("together", [path])[0] == path


def levels_of(garments: Iterable[Mapping[str, Any]]) -> list[int]:
    """Number of subdivisions of each of a report's garments."""
    return [garment["level"] for garment in garments]


def is_of_failure(path: Path) -> bool:
    """Whether a file is the report of a failed run, replaceable by the next run."""
    try:
        plain = json.loads(path.read_text(encoding="utf-8")) if path.suffix == ".json" else None
    except (OSError, ValueError):
        return False
    ours = RefineReport("", None, {}).to_dict().keys()
    return isinstance(plain, dict) and bool(plain.get("error")) and plain.keys() == ours


@dataclass(eq=False)
class RefineReport:
    """Report of a run of `refine_shot`.

    Attributes:
        shot: Input file.
        out: Layer written, or None after a dry run.
        option_sources: Origin of each option's value: "command line", a file, "default", or "given" from Python.
        estimate: Expected cost, from `Estimate.plain`.
        garments: Per garment: path, counts, level and reason, material values and their sources.
        modelled: Active terms of the potential, with the reason.
        left_out: Omitted terms, with the reason.
        frames: Telemetry, an entry per time code.
        failed: Time codes without a sample in the layer, with the error.
        unsettled: Frames written but not settled: path, time and reason.
        strict: Whether a run with unsettled frames counts as done in part.
        candidates: Why ``--collider auto`` takes or leaves meshes that are neither garments nor colliders, by path.
        variants: Active variant selections the garments depend on, as paths ``/World/coat{fit=loose}``.
        warnings: Warnings for the user; equal warnings about several prims are merged, naming a few prims.
        notes: Notes for the user without a fault: slack of the cages, fabrics by name, the level.
        warned: All prims of each merged warning.
        seconds: Wall time of each stage [s].
        peak_memory_mb: Peak resident memory of this process [MB]; None if the system does not tell.
        error: Error that ended the run; "" for a complete run.
        failure: Class of the error, place and exit code; None for a complete or interrupted run.
        signal: Number of the signal that interrupted the run; None for none.
        skipped: Whether an existing layer was kept unchanged.
    """

    shot: str
    out: Path | None
    options: dict[str, Any]
    option_sources: dict[str, str] = field(default_factory=dict)
    estimate: dict[str, float] = field(default_factory=dict)
    garments: list[dict[str, Any]] = field(default_factory=list)
    modelled: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    frames: list[dict[str, Any]] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    unsettled: list[dict[str, Any]] = field(default_factory=list)
    strict: bool = False
    candidates: dict[str, str] = field(default_factory=dict)
    variants: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warned: dict[str, list[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_mb: float | None = None
    error: str = ""
    failure: dict[str, Any] | None = None
    signal: int | None = None
    skipped: bool = False

    @property
    def exit_code(self) -> int:
        """0 done, 1 failed, 2 wrong usage, 3 done in part, 128 plus the signal's number if the run was interrupted.

        A run is done in part if some frames failed or some garment was not solved in a frame. A strict run is also done
        in part if some frames did not settle, or more than a tenth of the input's crossings remain.
        """
        if self.signal is not None:
            return SIGNALLED + self.signal
        if self.error:
            return FAILED if self.failure is None else self.failure["exit_code"]
        if not self.failed:
            unsolved = any(entry.get("error") for entry in self.unsettled)
            return IN_PART if unsolved or (self.strict and (self.unsettled or self.leaves_crossings)) else DONE
        return FAILED if len(self.failed) == len(self.frames) else IN_PART

    @property
    def crossings(self) -> int | None:
        """Edges through faces in the result, of cloth and of bodies, in all frames; None if not measured."""
        crossings = self._crossed("after")
        return sum(crossings) if crossings else None

    @property
    def leaves_crossings(self) -> bool:
        """Whether more than a tenth of the upsampled input's edges through faces remain."""
        return sum(self._crossed("after")) > LEFT * sum(self._crossed("before"))

    def _crossed(self, side: str) -> list[int]:
        """Edges through faces of each measurement, "before" or "after"."""
        contacts = [contact for frame in self.frames for contact in self.measured(frame)]
        return [part[side]["crossings"] for contact in contacts for part in _parts_of(contact)]

    def add(self, result: Result) -> None:
        """Add a frame: its telemetry, and that of each garment if the frame could be solved."""
        garments = {"garments": [garment.telemetry for garment in result.garments]} if result.garments else {}
        self.frames.append({"time": result.time, **result.telemetry, **garments})

    def measured(self, frame: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Measurements of contact in a frame: one per garment or group of garments solved together."""
        entries = [entry for garment, entry in self.garments_in(frame) if is_first(garment["path"], entry)]
        return [entry["contact"] for entry in entries if entry.get("contact")]

    def garments_in(self, frame: Mapping[str, Any]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """Each garment with its telemetry in a frame; [] for a frame that could not be solved."""
        return list(zip(self.garments, frame.get("garments", ()), strict=False))

    def entries(self) -> Iterator[tuple[dict[str, Any], dict[str, Any], dict[str, Any]]]:
        """Each frame with each garment and the garment's telemetry there, frame by frame."""
        return ((frame, garment, entry) for frame in self.frames for garment, entry in self.garments_in(frame))

    def fail(self, error: Exception) -> None:
        """Record the error that ends the run."""
        ours, location = named(error), place_of(error)
        self.error = str(ours)
        self.failure = {
            "kind": getattr(ours, "kind", type(error).__name__),
            "prims": list(location.prims),
            "time": location.time,
            "code": location.code,
            "exit_code": ours.exit_code,
        }

    def warn(self, *warnings: str) -> None:
        """Add new warnings, merge warnings of a kind about several prims, and log them."""
        for warning, paths in of_a_kind(warnings).items():
            if warning not in self.warnings:
                self.warnings.append(warning)
                self.warned |= {warning: paths} if paths else {}
                LOG.warning(warning, extra={"shot": self.shot})

    def note(self, *notes: str) -> None:
        """Add notes, and log the notes as information."""
        for note in notes:
            self.notes.append(str(note))
            LOG.info("%s", note, extra={"shot": self.shot})

    def to_dict(self) -> dict[str, Any]:
        """The report as plain values; every frame and garment entry has the same keys."""
        plain = {name: value for name, value in vars(self).items() if name != "out"}
        return {
            "format": FORMAT,
            "version": __version__,
            "out": None if self.out is None else str(self.out),
            "exit_code": self.exit_code,
            **plain,
            "frames": [_whole_frame(frame) for frame in self.frames],
        }

    def to_json(self) -> str:
        """The report as JSON."""
        return to_json(self.to_dict(), default=str)

    def write(self, path: Path) -> None:
        """Write the report as JSON, whole or not at all.

        Raises:
            LayerError: The file cannot be written.
        """
        write_text(path, self.to_json() + "\n")


def of_a_kind(warnings: Iterable[str]) -> dict[str, list[str]]:
    """Remove duplicate warnings and merge warnings of a kind about several prims, in order.

    Warnings are of a kind if marked with the same kind, or if only prims and figures differ.

    Args:
        warnings: Warnings; a warning about a prim begins with the prim's path in angle brackets.

    Returns:
        Each warning with the paths of its prims if merged; an empty list if unchanged.
    """
    kinds: dict[str, list[str]] = {}
    for warning in dict.fromkeys(warnings):
        kind = getattr(warning, "kind", "") or _DIFFERS.sub("#", _ALSO.sub("", warning))
        kinds.setdefault(kind if _OF_PRIM.match(warning) else warning, []).append(warning)
    paths_of: dict[str, list[str]] = {}
    for alike in kinds.values():
        paths = list(dict.fromkeys(match[1] for match in map(_OF_PRIM.match, alike) if match))
        paths_of |= {str(warning): [] for warning in alike} if len(paths) <= 1 else {_for_all(alike, paths): paths}
    return paths_of


def _for_all(alike: Sequence[str], paths: Sequence[str]) -> str:
    """One warning for several of a kind, with the figures of the first."""
    texts = [warning.partition(">")[2] for warning in alike]
    figures = "" if len(set(texts)) == 1 else " (the figures are those of the first)"
    named, unnamed = ", ".join(f"<{path}>" for path in paths[:MOST_NAMED]), len(paths) - MOST_NAMED
    return f"{named}{f' and {unnamed:,} more' if unnamed > 0 else ''}{texts[0]}{figures}"


def _whole_frame(frame: Mapping[str, Any]) -> dict[str, Any]:
    """A frame's entry with a value for every key."""
    return {**_FRAME, **frame, "garments": [_whole_garment(entry) for entry in frame.get("garments", ())]}


def _whole_garment(entry: Mapping[str, Any]) -> dict[str, Any]:
    complete = {**_fields("garment_frame"), **entry}
    return complete | {"contact": _fields("contact") | entry["contact"]} if "contact" in entry else complete


@cache
def _schema() -> dict[str, Any]:
    schema: dict[str, Any] = json.loads(SCHEMA.read_text(encoding="utf-8"))
    return schema


def _fields(name: str) -> dict[str, Any]:
    """The fields of a definition of the schema, without values."""
    return dict.fromkeys(_schema()["$defs"][name]["properties"])
