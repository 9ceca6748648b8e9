"""The options of a refine, each declared once: the command line and a show's file are made from `RefineOptions`.

The solver is imported on demand, so a batch skips finished shots without loading the solver.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import UsageError
from ..usd.schema import AXES
from ..usd.write.atomic import ASSET_PATHS

if TYPE_CHECKING:
    from ..solver.contact.settings import ContactSettings
    from ..solver.frame.settings import SolveSettings
    from ..usd.read.reader import Shot

INTEGRATORS = ("physgraph", "quasi-newton")
"""Names of the solver's own methods in `integrate.METHODS`; repeated here because `integrate` imports torch."""
REPORT_NAME, PAGE_NAME = "report.json", "report.html"
"""File names of the report and its page in a report folder."""
PICTURE, PICTURE_SUFFIX = "the picture", ".png"
"""Description of the picture of the first frame among a run's files, and its suffix."""
LIST = "; repeatable"


@dataclass(frozen=True)
class Option:
    """One option, beside its name, type and default.

    Attributes:
        heading: Section of the command line's help; "" for an option of the Python interface only.
        help: Description, for the help and for `RefineOptions`.
        flag: Name on the command line if different from the field's name.
        metavar: Placeholder for the value in the help.
        choices: All allowed values; empty for any.
        least: Least allowed value, or None.
        above: Exclusive lower bound, or None.
        result: Whether the layer depends on the option.
    """

    heading: str
    help: str
    flag: str = ""
    metavar: str | None = None
    choices: Sequence[str] = ()
    least: int | None = None
    above: int | None = None
    result: bool = True


def _option(heading: str, default: Any, help_text: str, **properties: Any) -> Any:
    """A field of `RefineOptions`."""
    return dataclasses.field(default=default, metadata={"option": Option(heading, help_text, **properties)})


_scene, _solver, _layer = (partial(_option, heading) for heading in ("Scene", "Solver", "Layer"))
_files = partial(_option, "Files", result=False)
_batch = partial(_option, "Several shots, and runs that were interrupted", result=False)
_farm = partial(_option, "Many machines")


@dataclass(frozen=True)
class RefineOptions:
    """Options of `refine_shot`."""

    frames: tuple[float, float] | None = _scene(None, "First and last time code to refine.  [default: all of the shot]")
    garments: Sequence[str] = _scene(
        (), f"Prim path, glob or collection{LIST}.  [default: what has the schema]", flag="garment", metavar="PATH"
    )
    colliders: Sequence[str] = _scene(
        (),
        f"Prim path, glob or collection; auto: what the shot names and drawn meshes that garments touch{LIST}.",
        flag="collider",
        metavar="PATH|auto",
    )
    bind: Sequence[str] = _scene((), f"Mesh, curves or points that follow the nearest garment{LIST}.", metavar="PATH")
    level: int | None = _scene(
        None,
        "Subdivisions; each makes four faces of one; auto (in Python -1) chooses.  [default: each garment's own]",
        metavar="N|auto",
    )
    integrator: str = _solver(
        INTEGRATORS[0], f"How forces become displacements: {', '.join(INTEGRATORS)}.", metavar="NAME"
    )
    weights: Path | None = _solver(None, "Weights for the learned integrator.", metavar="FILE")
    steps: int = _solver(24, "Largest number of steps at the finest level.", metavar="N", least=0)
    tolerance: float = _solver(
        2e-3, "Convergence tolerance: remaining move, RMS, in local edge lengths.", metavar="T", least=0
    )
    budget_ms: float | None = _solver(None, "Time limit of the steps of a frame.", metavar="MS", above=0)
    frame_limit: float | None = _solver(
        None,
        "Limit per frame in processor time, all threads together; on cuda in wall time. A frame over the limit keeps "
        "its current state and is reported as not settled.  "
        "[default: 20 times the time of the shot's frames, at least two minutes]",
        metavar="SECONDS",
        above=0,
    )
    device: str = _solver(
        "cpu", "Where to compute; auto: on the graphics card, if there is one.", metavar="cpu|cuda|auto"
    )
    overrides: Sequence[str] = _scene(
        (),
        f"Override a value of garments or colliders, such as bendStiffness=2e-4 or preset=denim for all{LIST}.",
        flag="set",
        metavar="PRIM.ATTR=VALUE",
    )
    mode: str = _layer("over", "Refine in place, or beside the coarse mesh.", choices=("over", "sibling"))
    scheme: str = _layer(
        "keep",
        "Subdivision scheme of the refined mesh: the cage's, or none, which is polygons with normals.",
        choices=("keep", "none"),
    )
    temporal: str = _solver("tether", "How a frame uses the last one.", choices=("tether", "warm", "off"))
    pose_in: int | None = _solver(
        None,
        "Poses of skinned cloth, between the bind pose and the first frame, that are solved before that frame; 12 by "
        "default if the cloth would cross itself there; 0: none.",
        metavar="N",
        least=0,
    )
    contact: str = _solver("quadratic", "How bodies push the cloth.", choices=("quadratic", "off"))
    self_contact: str = _solver("auto", "How cloth pushes cloth.", choices=("auto", "off"))
    workers: int = _solver(
        1,
        "Number of processes, each starting 6 frames early; for several shots, number of shots at a time; with "
        "--scheduler, number of chunks.",
        metavar="N",
        least=1,
        result=False,
    )
    preroll: int | None = _farm(
        None,
        "Write --frames as a chunk in folder OUT; stitch blends it with the previous chunk over N overlapping frames.",
        metavar="N",
        least=0,
    )
    scheduler: str | None = _farm(
        None, "Solve on the workers of this Dask scheduler (extra farm).", metavar="ADDRESS", result=False
    )
    report: Path | None = _files(
        None, "Write a report of the run, also of a failed run; DIR: as a page too.", metavar="FILE.json|DIR"
    )
    preview: Path | None = _files(
        None,
        "Draw the first refined frame as soon as it is done; with --resume an existing picture stays.",
        metavar="FILE.png",
    )
    overwrite: bool = _files(False, "Replace files that exist.")
    dry_run: bool = _files(False, "Print the work to be done; write nothing.")
    resume: bool = _batch(False, "Continue from the finished frames and layers of an interrupted run.")
    skip_existing: bool = _batch(False, "Skip shots with an existing layer.")
    keep_frames: bool = _batch(True, "Keep finished frames after an interruption.")
    velocities: bool = _layer(False, "Write point velocities even where the shot has none.")
    heat_map: bool = _layer(False, "Also write depth inside bodies and intersections as primvars.")
    rest_frame: float | str | None = _scene(
        None,
        "Rest shape: this frame, or fitted to the shot.  [default: the authored one, else fitted]",
        flag="rest",
        metavar="FRAME|auto",
    )
    gravity: str | None = _scene(
        None,
        "Axis of the stage along which gravity pulls, such as -Y.  [default: the garments', the physics scene's, or "
        "against the stage's up axis]",
        metavar="AXIS",
        choices=AXES,
    )
    root: Path | None = _files(None, "Also write a root file (.usda) with the layer over the shot.")
    strict: bool = _layer(
        False,
        "Exit with 3 if a frame did not settle, or over a tenth of the input's intersections are left.",
        result=False,
    )
    asset_paths: str = _layer("relative", "How written files name other files.", choices=ASSET_PATHS, result=False)
    progress: Callable[[int, int], None] | None = _option(
        "", None, "Called with the number of frames done and of all frames.", result=False
    )
    sources: Mapping[str, str] = dataclasses.field(
        default_factory=dict,
        metadata={"option": Option("", "Where values are from, by name: command line or a file.", result=False)},
    )

    def plain(self) -> dict[str, Any]:
        """The options the result depends on, ready for JSON."""
        names = {name for name, option in OPTIONS.items() if option.result}
        # Unset, newer options leave the record as in older versions.
        later = ("heat_map", "weights", "preroll", "gravity", "pose_in")
        names -= {name for name in later if getattr(self, name) is None or getattr(self, name) is False}
        values = {name: getattr(self, name) for name in OPTIONS if name in names}
        if self.weights:
            from ..solver.integrate.weights import weights_hash

            values["weights"] = {"file": str(self.weights), "sha256": weights_hash(self.weights)}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def value_sources(self) -> dict[str, str]:
        """Origin of each option in `plain`: "command line", a file, "default", or "given" (Python)."""
        fields = {f.name: f for f in dataclasses.fields(self)}
        return {
            name: self.sources.get(name, "default" if getattr(self, name) == fields[name].default else "given")
            for name in self.plain()
        }

    def contact_settings(self) -> ContactSettings:
        """Settings of contact."""
        from ..solver.contact.settings import ContactSettings

        cloth = "off" if self.self_contact == "off" else "pairs"
        return ContactSettings(self.contact, cloth=cloth, measured=self.report is not None)

    def solve_settings(self) -> SolveSettings:
        """Settings of the solver."""
        from ..solver.frame.settings import SolveSettings
        from ..solver.integrate import method_named

        return SolveSettings(
            method=method_named(self.integrator, self.weights),
            steps=self.steps,
            tolerance=self.tolerance,
            budget_ms=self.budget_ms,
            frame_limit=self.frame_limit,
            temporal=self.temporal,
            contact=self.contact_settings(),
        )

    def check(self) -> None:
        """Refuse options invalid for every shot.

        Raises:
            UsageError: An option is wrong.
        """
        is_extended = "physgraph_usd.solver.integrate" in sys.modules  # Further methods register themselves there.
        if self.integrator not in INTEGRATORS and not is_extended:
            names = ", ".join(INTEGRATORS)
            raise UsageError(f"unknown integrator '{self.integrator}'; known integrators: {names}")
        if self.integrator not in INTEGRATORS or self.weights is not None:
            from ..solver.integrate import method_named

            method_named(self.integrator, self.weights)
        for name, option in OPTIONS.items():
            _check(name.replace("_", " "), getattr(self, name), option)
        if self.skip_existing and self.overwrite:
            raise UsageError("skip existing leaves layers that are there, overwrite replaces them; choose one")
        if self.preroll is not None and (self.skip_existing or self.root is not None):
            raise UsageError(
                "root and skip existing are for layers, preroll makes a chunk: give stitch the root, or resume"
            )
        _check_picture(self.preview)
        if self.device not in ("cpu", "auto") and not self.device.startswith("cuda"):
            raise UsageError(f"unknown device '{self.device}'; known: cpu, cuda, auto")

    def targets(self, layer: Path) -> list[tuple[str, Path]]:
        """Description and path of every file written by a run."""
        files = [("the layer" if self.preroll is None else "the chunk", layer)]
        if self.root is not None:
            files.append(("the root", Path(self.root)))
        if self.report is not None:
            report = json_of(Path(self.report))
            files.append(("the report", report))
            files += [("the report's page", report.with_name(PAGE_NAME))] if report != self.report else []
        files += [] if (picture := picture_of(self)) is None else [(PICTURE, picture)]
        return files


OPTIONS: dict[str, Option] = {field.name: field.metadata["option"] for field in dataclasses.fields(RefineOptions)}
"""Each option by its field."""
RefineOptions.__doc__ = f"{RefineOptions.__doc__}\n\nAttributes:\n" + "\n".join(
    f"    {name}: {option.help}" for name, option in OPTIONS.items()
)


def _check(name: str, value: Any, option: Option) -> None:
    if option.choices and value is not None and value not in option.choices:
        raise UsageError(f"unknown {name} '{value}'; known: {', '.join(option.choices)}")
    if option.least is not None and value is not None and not value >= option.least:
        raise UsageError(f"{name} is {value:g}: give {option.least} or more")
    if option.above is not None and value is not None and not value > option.above:
        raise UsageError(f"{name} is {value:g}: give a value above {option.above}")


def picture_of(options: RefineOptions) -> Path | None:
    """The picture of the first frame, if one is to be drawn: a resumed run leaves an existing one."""
    picture = None if options.preview is None else Path(options.preview)
    return None if picture is None or (options.resume and picture.is_file()) else picture


def _check_picture(picture: Path | None) -> None:
    if picture is not None and Path(picture).suffix.lower() != PICTURE_SUFFIX:
        raise UsageError(f"cannot draw {picture}; known suffixes: {PICTURE_SUFFIX}")
    if picture is not None and find_spec("PIL") is None:
        raise UsageError("a preview needs Pillow, which is not installed: pip install pillow")


def json_of(report: Path) -> Path:
    """The JSON file of a report: the path itself if named ``.json``, else `REPORT_NAME` in a folder at the path."""
    return report if report.suffix == ".json" and not report.is_dir() else report / REPORT_NAME


def scene_words(options: RefineOptions) -> list[str]:
    """Command-line arguments of the Scene options without default values."""
    words = []
    for field in dataclasses.fields(options):
        value, option = getattr(options, field.name), OPTIONS[field.name]
        if option.heading == "Scene" and value != field.default:
            values = value if field.default == () else [_text(value)]
            words += options_of("--" + (option.flag or field.name), values)
    return words


def _text(value: Any) -> str:
    """Command-line text of a level, a time code, a range of time codes, or a word."""
    if isinstance(value, tuple):
        return ":".join(map(_text, value))
    if value == -1 and isinstance(value, int):
        return "auto"
    return value if isinstance(value, str) else f"{value:.15g}"


def options_of(name: str, values: Iterable[str]) -> list[str]:
    """Command-line arguments that repeat an option, once per value."""
    return [word for value in values for word in (name, value)]


def why_not_posed(shot: Shot, options: RefineOptions) -> str:
    """Why requested poses from the bind pose to the first frame are not solved; "" if they are."""
    if options.temporal == "off":
        return "--temporal off solves each frame by itself"
    return "" if shot.is_skinned else "no garment is skinned"
