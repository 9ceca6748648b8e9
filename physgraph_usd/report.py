"""The report of a run: what was modelled, what was left out and why, and how far each frame got."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .usd.atomic import write_text

DONE, FAILED, IN_PART = 0, 1, 3


def is_of_failure(path: Path) -> bool:
    """Whether a file is the report of a run that failed, which the next run may replace."""
    try:
        plain = json.loads(path.read_text(encoding="utf-8")) if path.suffix == ".json" else None
    except (OSError, ValueError):
        return False
    return isinstance(plain, dict) and bool(plain.get("error")) and "exit_code" in plain


@dataclass(eq=False)
class RefineReport:
    """What `refine_shot` did.

    Attributes:
        shot: Input file.
        out: Layer written, or None after a dry run.
        options: The options used.
        estimate: What it was expected to cost, as `Estimate.plain` gives it.
        garments: Per garment: path, counts, level and why, material values and their sources.
        modelled: Terms of the potential that were on, with the reason.
        left_out: What was left out, with the reason.
        frames: Telemetry, one entry a time code.
        failed: Time codes that have no sample in the layer, with the error.
        unsettled: Frames that were written though the solver left them unsettled: path, time and in what way.
        strict: Whether a run with unsettled frames counts as done in part.
        variants: Variant selections in force on what the garments depend on, as paths ``/World/coat{fit=loose}``.
        warnings: What the user should know.
        seconds: Wall time of each stage [s].
        peak_memory_mb: Peak resident memory of this process [MB].
        error: What ended the run; "" for one that came to its end.
    """

    shot: str
    out: Path | None
    options: dict[str, Any]
    estimate: dict[str, float] = field(default_factory=dict)
    garments: list[dict[str, Any]] = field(default_factory=list)
    modelled: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    frames: list[dict[str, Any]] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    unsettled: list[dict[str, Any]] = field(default_factory=list)
    strict: bool = False
    variants: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_mb: float = 0.0
    error: str = ""

    @property
    def exit_code(self) -> int:
        """0 done, 1 it failed, 3 done in part: some frames failed, or where that is strict some did not settle."""
        if self.error:
            return FAILED
        if not self.failed:
            return IN_PART if self.unsettled and self.strict else DONE
        return FAILED if len(self.failed) == len(self.frames) else IN_PART

    def to_dict(self) -> dict[str, Any]:
        """The report as plain values."""
        plain = {name: value for name, value in vars(self).items() if name != "out"}
        return {"out": None if self.out is None else str(self.out), "exit_code": self.exit_code, **plain}

    def to_json(self) -> str:
        """The report as JSON."""
        return json.dumps(self.to_dict(), indent=2, default=str)

    def write(self, path: Path) -> None:
        """Write the report as JSON, whole or not at all.

        Raises:
            LayerError: It cannot be written.
        """
        write_text(path, self.to_json() + "\n")
