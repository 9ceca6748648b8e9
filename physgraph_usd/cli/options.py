"""Options that several commands share, or that fill a page of help; their defaults are those of `RefineOptions`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import click

from .structure import Option
from .types import FrameRange, RefineLevel, RestShape

INTEGRATORS = (
    "auto", "quasi-newton", "quasi-newton-flat", "lbfgs", "adam", "gd", "newton", "physgraph", "physgraph-paper",
)  # fmt: skip
"""Names of `integrate.METHODS`, which imports torch."""
SHOW_HEADINGS = ("Scene", "Solver", "Layer")
"""Headings of the options that a show's file may give, too: they belong to no single run."""

Decorator = Callable[[Callable[..., None]], Callable[..., None]]

_scene, _solver, _layer = (partial(click.option, cls=Option, heading=heading) for heading in SHOW_HEADINGS)
_files = partial(click.option, cls=Option, heading="Files")
_batch = partial(click.option, cls=Option, heading="Several shots, and runs that were interrupted")
_farm = partial(click.option, cls=Option, heading="Many machines")
_said = partial(click.option, cls=Option, heading="What is said")


def together(*options: Decorator) -> Decorator:
    """One decorator that declares several options in order."""

    def apply(function: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            function = option(function)
        return function

    return apply


shot_argument = click.argument("shot", type=click.Path(dir_okay=False))
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
overwrite_option = _files("--overwrite", is_flag=True, help="Replace files that exist.")
asset_paths_option = _layer(
    "--asset-paths",
    type=click.Choice(["relative", "absolute"]),
    default="relative",
    help="How files written name other files.",
)


def _each(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> tuple[str, ...]:
    """The words of all values: a farm's parameter holds several paths, or none."""
    return tuple(word for value in values for word in value.split())


garment_option = _scene(
    "--garment",
    "garments",
    multiple=True,
    callback=_each,
    metavar="PATH",
    help="Prim path, glob or collection; repeatable.",
)
tag_collider_option = _scene(
    "--collider",
    "colliders",
    multiple=True,
    callback=_each,
    metavar="PATH",
    help="Prim path, glob or collection; repeatable.",
)
collider_option = _scene(
    "--collider",
    "colliders",
    multiple=True,
    callback=_each,
    metavar="PATH|auto",
    help="Prim path, glob or collection; auto: closed meshes that garments touch, too; repeatable.",
)
config_option = _said(
    "--config",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.toml",
    help="The show's defaults.  [default: PHYSGRAPH_CONFIG, or physgraph.toml above the shot]",
)
scene_options = together(
    _scene("--frames", type=FrameRange(), help="Time codes to refine.  [default: all of the shot]"),
    garment_option,
    collider_option,
    _scene(
        "--level",
        type=RefineLevel(),
        metavar="N|auto",
        help="Subdivisions; each makes four faces of one.  [default: each garment's own]",
    ),
    _scene(
        "--set",
        "overrides",
        multiple=True,
        metavar="PRIM.ATTR=VALUE",
        help="Override an attribute, such as bendStiffness=2e-4 for all garments; repeatable.",
    ),
    _scene(
        "--rest",
        "rest_frame",
        type=RestShape(),
        metavar="FRAME|auto",
        help="Rest shape: this frame, or fitted to all.  [default: each garment's own]",
    ),
)
solve_options = together(
    _solver(
        "--integrator",
        metavar="NAME",
        default="auto",
        help=f"How forces become displacements: {', '.join(INTEGRATORS)}.",
    ),
    _solver("--weights", type=click.Path(path_type=Path), metavar="FILE", help="Weights for a learned integrator."),
    _solver("--steps", type=click.IntRange(min=0), metavar="N", default=12, help="Most steps at the finest level."),
    _solver("--tolerance", type=float, metavar="T", default=2e-3, help="Stop when cloth moves less, in edge lengths."),
    _solver("--budget-ms", type=float, metavar="MS", help="Stop after this time per frame."),
    _solver(
        "--frame-limit",
        type=float,
        metavar="SECONDS",
        help="A frame that takes longer stops where it stands and counts as not settled; default: 20 times what the "
        "shot's frames take, never under two minutes.",
    ),
    _solver("--device", metavar="cpu|cuda", default="cpu", help="Where to compute."),
    _solver(
        "--potential", type=click.Choice(["continuum", "paper"]), default="continuum", help="Which form of the energy."
    ),
    _solver(
        "--contact",
        type=click.Choice(["quadratic", "paper", "off"]),
        default="quadratic",
        help="How bodies push the cloth.",
    ),
    _solver(
        "--self-contact", type=click.Choice(["auto", "paper", "off"]), default="auto", help="How cloth pushes cloth."
    ),
    _solver(
        "--temporal",
        type=click.Choice(["tether", "warm", "off"]),
        default="tether",
        help="How a frame uses the last one.",
    ),
    _solver(
        "--workers",
        type=click.IntRange(min=1),
        metavar="N",
        default=1,
        help="Processes; each begins 6 frames early. Of several shots, so many at a time.",
    ),
)
layer_options = together(
    _layer(
        "--mode",
        type=click.Choice(["over", "sibling"]),
        default="over",
        help="Refine in place, or beside the coarse mesh.",
    ),
    _layer("--velocities", is_flag=True, help="Write point velocities even where the shot has none."),
    _layer("--heat-map", is_flag=True, help="Also write depth inside bodies and crossings as primvars."),
    asset_paths_option,
    _layer(
        "--strict",
        is_flag=True,
        help="Exit with 3 where a frame did not settle or over a tenth of what crossed is left.",
    ),
)
file_options = together(
    _files("--root", type=click.Path(path_type=Path), help="Also write a .usda with the layer over the shot."),
    _files(
        "--report",
        type=click.Path(path_type=Path),
        metavar="FILE.json|DIR",
        help="Write what was done, or what failed; DIR: as a page too.",
    ),
    overwrite_option,
    _files("--dry-run", is_flag=True, help="Print what would be done; write nothing."),
)
run_options = together(
    _batch("--skip-existing", is_flag=True, help="Leave a shot whose layer is there."),
    _batch("--resume", is_flag=True, help="Go on from the frames and layers that an interrupted run finished."),
    _batch("--keep-frames/--no-keep-frames", default=True, help="Leave finished frames when interrupted."),
    _batch(
        "--summary",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE.json",
        help="Write a line for each shot: frames, seconds a frame, crossings, warnings, exit code.",
    ),
)
farm_options = together(
    _farm(
        "--preroll",
        type=click.IntRange(min=0),
        metavar="N",
        help="Write --frames as a chunk for stitch, which joins it to the one before over the N frames before it.",
    ),
    _farm(
        "--seam-bound",
        type=click.FloatRange(min=0),
        metavar="EDGES",
        help="With --preroll: fail where a seam to a chunk beside it, in the same folder, moves more (see stitch).",
    ),
    _farm("--openjd", is_flag=True, help="Say progress in the lines that OpenJD reads."),
    _farm(
        "--scheduler",
        metavar="ADDRESS",
        help="Solve on the workers of this Dask scheduler (extra farm); --workers is the number of chunks of a shot.",
    ),
)
said_options = together(
    config_option,
    _said("--progress", is_flag=True, help="Say each frame in a line of its own, into files and pipes too."),
    _said(
        "-v",
        "--verbose",
        count=True,
        default=0,
        show_default=False,
        help="Say more: -v each frame, -vv what it measured.",
    ),
    _said(
        "--log-file",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help="Also append what is said to a file, with times, each frame included.",
    ),
)


def out_option(metavar: str, help_text: str, *, required: bool = True) -> Decorator:
    """Declare ``-o``, where a command writes.

    Args:
        metavar: What the help shows for the value.
        help_text: The option's line in the help.
        required: Whether it must be there.
    """
    return _files("-o", "--out", required=required, type=click.Path(path_type=Path), metavar=metavar, help=help_text)
