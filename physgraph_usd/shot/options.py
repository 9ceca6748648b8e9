"""Everything that `refine_shot` can be told, and what it refuses.

The solver is imported where it is needed: what a batch has finished before is passed over without it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import UsageError
from ..usd.write.atomic import ASSET_PATHS

if TYPE_CHECKING:
    from ..solver.contact.settings import ContactSettings
    from ..solver.frame.settings import SolveSettings

AUTO = "auto"
"""The integrator that is chosen frame by frame; always known."""
TEMPORAL = ("tether", "warm", "off")
POTENTIALS = ("continuum", "paper")
MODES = ("over", "sibling")
CONTACTS = {"quadratic": "quadratic", "paper": "linear", "off": "off"}
"""Forms of contact by their names on the command line."""
REPORT_NAME, PAGE_NAME = "report.json", "report.html"
"""Names of the report and its page in a folder of their own."""
SELF_CONTACTS = {"auto": "pairs", "paper": "spheres", "off": "off"}
"""Forms of contact of cloth with cloth by their names on the command line."""
_NOT_OF_THE_RESULT = {
    "progress", "report", "overwrite", "dry_run", "workers", "root", "asset_paths", "resume", "keep_frames", "strict",
    "skip_existing", "sources", "scheduler",
}  # fmt: skip


@dataclass(frozen=True)
class RefineOptions:
    """Everything that `refine_shot` can be told.

    Attributes:
        frames: First and last time code, or None for all of the shot.
        garments: Prim paths, globs or collections; empty finds applied schemas.
        colliders: Prim paths, globs or collections; "auto" for what the shot names and closed meshes that garments
            touch; empty finds applied schemas.
        level: Subdivisions; -1 chooses, None takes the stage's.
        integrator: A name of `integrate.METHODS`.
        weights: Weights for a learned integrator in place of those that ship, or None.
        steps: Most steps at the finest level.
        tolerance: Stop when the cloth would move less than this, RMS, in local edge lengths.
        budget_ms: Milliseconds a frame, or None.
        frame_limit: Seconds after which a frame stops where it stands, as one that did not settle; None for 20 times
            what the shot's frames take, never under two minutes.
        device: "cpu" or "cuda".
        overrides: "</Prim>.attribute=value" or "attribute=value", as ``--set`` takes them.
        mode: "over" or "sibling".
        temporal: "tether", "warm" or "off": how a frame uses the last one.
        potential: "continuum" or "paper".
        contact: Against bodies: "quadratic", "paper" (its linear form) or "off".
        self_contact: Of cloth with cloth: "auto" (where parts come near one another), "paper" (its spheres) or "off".
        workers: Processes that share the frames; with a scheduler, tasks.
        preroll: Frames solved before ``frames`` and no samples: the layer is a chunk, which `stitch` joins to others.
            None for a layer by itself.
        scheduler: Address of a Dask scheduler whose workers solve the frames, or None.
        report: JSON file to write, or a folder for it and a page, or None.
        overwrite: Replace files that exist.
        dry_run: Read and check everything, write nothing.
        resume: Go on from the finished frames of a run that was interrupted, in ``<layer>.frames``; a layer that the
            same run has finished is left as it is.
        skip_existing: Leave a shot whose layer is there already as it is.
        keep_frames: Leave finished frames there when the run is interrupted.
        velocities: Also write point velocities of garments that have none in the shot.
        heat_map: Also write how deep each vertex is in bodies, and what crosses, as primvars.
        rest_frame: Time code whose points are the rest shape, "auto" for one fitted to the shot, or None.
        root: A .usda to write that lays the new layer over the shot, or None.
        strict: Count a shot with frames that did not settle as done in part.
        asset_paths: "relative" or "absolute": how the layer and the root name other files.
        progress: Called with (frames done, frames in all), or None.
        sources: Where values are from, by the option's name, for the report: "command line" or a file.
    """

    frames: tuple[float, float] | None = None
    garments: Sequence[str] = ()
    colliders: Sequence[str] = ()
    level: int | None = None
    integrator: str = AUTO
    weights: Path | None = None
    steps: int = 12
    tolerance: float = 2e-3
    budget_ms: float | None = None
    frame_limit: float | None = None
    device: str = "cpu"
    overrides: Sequence[str] = ()
    mode: str = "over"
    temporal: str = "tether"
    potential: str = "continuum"
    contact: str = "quadratic"
    self_contact: str = "auto"
    workers: int = 1
    preroll: int | None = None
    scheduler: str | None = None
    report: Path | None = None
    overwrite: bool = False
    dry_run: bool = False
    resume: bool = False
    skip_existing: bool = False
    keep_frames: bool = True
    velocities: bool = False
    heat_map: bool = False
    rest_frame: float | str | None = None
    root: Path | None = None
    strict: bool = False
    asset_paths: str = "relative"
    progress: Callable[[int, int], None] | None = None
    sources: Mapping[str, str] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """The options that decide the result, ready for JSON."""
        names = {f.name for f in dataclasses.fields(self)} - _NOT_OF_THE_RESULT
        # A layer without these is as it was before there were any.
        names -= {
            name
            for name in ("heat_map", "weights", "preroll")
            if getattr(self, name) is None or getattr(self, name) is False
        }
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name in names}
        if self.weights:
            from ..solver.integrate.weights import weights_hash

            values["weights"] = {"file": str(self.weights), "sha256": weights_hash(self.weights)}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def told_sources(self) -> dict[str, str]:
        """Where the value of each option that decides the result is from: as told, "default", or "given" to Python."""
        fields = {f.name: f for f in dataclasses.fields(self)}
        return {
            name: self.sources.get(name, "default" if getattr(self, name) == fields[name].default else "given")
            for name in self.plain()
        }

    def contact_settings(self) -> ContactSettings:
        """The part that concerns contact."""
        from ..solver.contact.settings import ContactSettings

        return ContactSettings(
            CONTACTS[self.contact], cloth=SELF_CONTACTS[self.self_contact], measured=self.report is not None
        )

    def solve_settings(self) -> SolveSettings:
        """The part that concerns the solver."""
        from ..solver.frame.settings import SolveSettings
        from ..solver.integrate import method_named

        return SolveSettings(
            method=method_named(self.integrator, self.weights),
            steps=self.steps,
            tolerance=self.tolerance,
            budget_ms=self.budget_ms,
            frame_limit=self.frame_limit,
            temporal=self.temporal,
            potential=self.potential,
            contact=self.contact_settings(),
        )

    def check(self) -> None:
        """Refuse what no shot could be refined with.

        Raises:
            UsageError: An option is wrong.
        """
        if self.integrator != AUTO or self.weights is not None:
            from ..solver.integrate import method_named

            method_named(self.integrator, self.weights)
        for name, value, known in (
            ("temporal", self.temporal, TEMPORAL),
            ("potential", self.potential, POTENTIALS),
            ("mode", self.mode, MODES),
            ("contact", self.contact, tuple(CONTACTS)),
            ("self contact", self.self_contact, tuple(SELF_CONTACTS)),
            ("asset paths", self.asset_paths, ASSET_PATHS),
        ):
            if value not in known:
                raise UsageError(f"unknown {name} '{value}'; known: {', '.join(known)}")
        if self.skip_existing and self.overwrite:
            raise UsageError("skip existing leaves layers that are there, overwrite replaces them; choose one")
        if self.workers < 1 or self.steps < 0 or not self.tolerance >= 0:
            raise UsageError("workers must be at least 1, steps and tolerance at least 0")
        if self.preroll is not None and self.preroll < 0:
            raise UsageError(f"pre-roll of {self.preroll} frames: give 0 or more")
        if self.budget_ms is not None and not self.budget_ms > 0:
            raise UsageError(f"budget of {self.budget_ms:g} ms: give a time above 0")
        if self.frame_limit is not None and not self.frame_limit > 0:
            raise UsageError(f"frame limit of {self.frame_limit:g} s: give a time above 0")
        if self.device != "cpu" and not self.device.startswith("cuda"):
            raise UsageError(f"unknown device '{self.device}'; known: cpu, cuda")

    def targets(self, layer: Path) -> list[tuple[str, Path]]:
        """Every file that a run writes, in words and where."""
        files = [("the layer", layer)]
        if self.root is not None:
            files.append(("the root", Path(self.root)))
        if self.report is not None:
            report = json_of(Path(self.report))
            files.append(("the report", report))
            files += [("the report's page", report.with_name(PAGE_NAME))] if report != self.report else []
        return files


def json_of(report: Path) -> Path:
    """The JSON file of a report: the path itself when it is named so, else in the folder of that name."""
    return report if report.suffix == ".json" and not report.is_dir() else report / REPORT_NAME
