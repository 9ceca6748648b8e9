"""One mutant tried: inspected, refined, validated, and what came of it."""

from __future__ import annotations

import json
import shutil
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType

from pxr import Tf

from physgraph_usd.errors import GarmentError, PhysGraphError
from physgraph_usd.shot.findings.table import Facts, texts
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import inspect_shot, refine_shot
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.usd.check.validate import validate_layer

from .files import sizes
from .mutant import Draft, Kind, make

GOOD = ("done", "in part", "refused")
BAD = ("traceback", "invalid layer", "worse", "files left", "input changed", "poor message", "hang", "died")
MADE_BY_US = {"out.usdc", "out.root.usda"}
READING = ("garments", "colliders", "frames", "level", "overrides", "rest_frame")
LONGEST_MESSAGE = 2000


@dataclass
class Outcome:
    """What came of a mutant: one of `GOOD` or `BAD`, what is wrong, what was done, and Python warnings that got out."""

    number: int
    kind: str
    result: str
    detail: str = ""
    said: list[str] = field(default_factory=list)
    noise: list[str] = field(default_factory=list)

    def to_json(self) -> str:
        return json.dumps(asdict(self))


def attempt(number: int, kinds: Sequence[Kind], bases: Path, folder: Path) -> Outcome:
    """Make a mutant in a new folder, which stays, and try it."""
    kind, draft = make(number, kinds, bases, folder)
    outcome = Outcome(number, kind.name, "done", said=draft.said)
    note = {"number": number, "kind": kind.name, "said": draft.said, "options": draft.options}
    (folder / "mutant.json").write_text(json.dumps(note, indent=2, default=str))
    before = sizes(folder)
    with warnings.catch_warnings(record=True) as noise:
        warnings.simplefilter("always")
        outcome.result, outcome.detail = _tried(draft)
    outcome.noise = sorted({f"{each.category.__name__}: {each.message} ({_place(each)})" for each in noise})
    if outcome.result in GOOD:
        _look_around(outcome, before, sizes(folder))
    return outcome


def _place(warning: warnings.WarningMessage) -> str:
    return f"{Path(warning.filename).name}:{warning.lineno}"


def _tried(draft: Draft) -> tuple[str, str]:
    """Result and detail of inspecting, refining and validating one shot."""
    out = draft.folder / "out.usdc"
    with Escape() as escape:
        return _refined(draft, out)
    if isinstance(escape.error, PhysGraphError):
        return _judged(escape.error)
    return "traceback", "".join(traceback.format_exception(escape.error))


class Escape:
    """A context that keeps whatever error leaves it: which one is what the fuzzer looks for."""

    error: BaseException | None = None

    def __enter__(self) -> Escape:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        """Keep the error; only the user's own interruption goes on."""
        self.error = error
        return error is not None and not isinstance(error, KeyboardInterrupt)


def _refined(draft: Draft, out: Path) -> tuple[str, str]:
    reading = {name: value for name, value in draft.options.items() if name in READING}
    try:
        inspect_shot(draft.shot, **reading)
    except PhysGraphError as error:
        if (judged := _judged(error))[0] not in GOOD:
            return judged
    report = refine_shot(draft.shot, out, RefineOptions(**draft.options))
    return _checked(report, out, draft.shot)


def _checked(report: RefineReport, out: Path, shot: Path) -> tuple[str, str]:
    try:
        errors = [str(problem) for problem in validate_layer(out, shot) if problem.severity == "error"]
    except Tf.ErrorException as error:
        return "traceback", f"validate_layer: {error}"
    if errors:
        return "invalid layer", "\n".join(errors)
    if more := texts("more", Facts(report=report)):
        return "worse", "; ".join(more)
    return ("in part" if report.failed else "done"), "; ".join(report.failed.values())


def _judged(error: PhysGraphError) -> tuple[str, str]:
    """Whether an error says what a user needs."""
    said, name = str(error), type(error).__name__
    faults = {
        "is empty": not said.strip(),
        "has several lines": "\n" in said,
        "is very long": len(said) > LONGEST_MESSAGE,
        "shows USD's own code": "Error in '" in said or "pxrInternal" in said,
        "has no remedy": isinstance(error, GarmentError) and not error.remedy,
    }
    wrong = [fault for fault, holds in faults.items() if holds]
    return ("poor message", f"{name} {', '.join(wrong)}: {said}") if wrong else ("refused", f"{name}: {said}")


def _look_around(outcome: Outcome, before: dict[str, bytes], after: dict[str, bytes]) -> None:
    """See that the input is untouched and that nothing else lies about."""
    changed = [name for name, data in before.items() if after.get(name) != data]
    allowed = set(before) | (MADE_BY_US if outcome.result != "refused" else set())
    left = sorted(set(after) - allowed)
    if changed:
        outcome.result, outcome.detail = "input changed", f"{changed}; {outcome.detail}"
    elif left:
        outcome.result, outcome.detail = "files left", f"{left}; {outcome.detail}"


def keep(outcome: Outcome, folder: Path, failures: Path) -> Path:
    """Move a failed mutant's folder to where it can be looked at."""
    target = failures / f"{outcome.number:06d}"
    shutil.rmtree(target, ignore_errors=True)
    shutil.move(folder, target)
    (target / "outcome.txt").write_text(f"{outcome.kind}: {outcome.result}\n{outcome.detail}\n", encoding="utf-8")
    return target
