"""Options of commands as click declares them: the fields of `RefineOptions`, and options of the command line alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from ..shot.options import OPTIONS, RefineOptions
from .structure import Option
from .types import FRAME_RANGE, LEVEL, REST

SHOW_HEADINGS = ("Scene", "Solver", "Layer")
"""Headings of the options also allowed in a show's file: options not tied to a single run."""
HEADINGS = ("Files", *SHOW_HEADINGS, "Several shots, and runs that were interrupted", "Many machines")
"""Headings of the options of `RefineOptions`, in the order of the help."""
Decorator = Callable[[Callable[..., None]], Callable[..., None]]
_FIELDS = {field.name: field for field in dataclasses.fields(RefineOptions)}
_TYPES = {"frames": FRAME_RANGE, "level": LEVEL, "rest_frame": REST}
_PATH = click.Path(path_type=Path)
_FILE = click.Path(path_type=Path, dir_okay=False)


def _words(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> tuple[str, ...]:
    """The words of all values: a farm's parameter holds several paths, or none."""
    return tuple(word for value in values for word in value.split())


def _existing(ctx: click.Context, param: click.Parameter, path: str) -> str:
    """Refuse a missing file before the command imports libraries; "-" is standard input."""
    from ..usd.resolve import check_there

    if path != "-":
        check_there(path)
    return path


def existing_or_stopped(ctx: click.Context, param: click.Parameter, path: str) -> str:
    """Refuse a missing file, unless finished frames of a stopped run are at the path or beside it.

    Args:
        ctx: Context of the command.
        param: The argument.
        path: A file, or the folder or layer of a stopped run.
    """
    from ..usd.write.atomic import FRAMES_SUFFIX

    is_stopped = Path(path).is_dir() or Path(path + FRAMES_SUFFIX).is_dir()
    return path if is_stopped else _existing(ctx, param, path)


def _type_of(name: str) -> click.ParamType | type:
    """Function to turn text into the value of a field."""
    option, kind = OPTIONS[name], str(_FIELDS[name].type).removesuffix(" | None")
    if name in _TYPES:
        return _TYPES[name]
    if option.choices:
        return click.Choice(option.choices)
    if kind in ("int", "float") and option.least is not None:
        return (click.IntRange if kind == "int" else click.FloatRange)(min=option.least)
    return {"Path": _PATH, "float": click.FLOAT}.get(kind, click.STRING)


def of_field(name: str, **settings: Any) -> Decorator:
    """The option of a field of `RefineOptions`.

    Args:
        name: The field.
        settings: Further arguments for `click.option`, replacing the field's.
    """
    option, default = OPTIONS[name], _FIELDS[name].default
    flag = "--" + (option.flag or name.replace("_", "-"))
    declaration: dict[str, Any] = {"help": option.help, "heading": option.heading, "default": default}
    if isinstance(default, bool):
        flag += f"/--no-{flag.removeprefix('--')}" if default else ""
        declaration |= {"is_flag": True}
    else:
        declaration |= {"type": _type_of(name), "metavar": option.metavar, "multiple": default == ()}
    if name in ("garments", "colliders"):
        declaration |= {"callback": _words}
    return click.option(flag, name, cls=Option, **declaration | settings)


def together(*options: Decorator) -> Decorator:
    """A decorator to declare several options in order."""

    def apply(function: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            function = option(function)
        return function

    return apply


def under(heading: str) -> Decorator:
    """The options of all fields of `RefineOptions` under a heading of the help."""
    return together(*(of_field(name) for name, option in OPTIONS.items() if option.heading == heading))


_files, *_, _batch, _farm, _messages = (
    partial(click.option, cls=Option, heading=heading) for heading in (*HEADINGS, "Messages")
)
shot_argument = click.argument("shot", type=click.Path(dir_okay=False), callback=_existing)
layer_argument = click.argument("layer", type=click.Path(dir_okay=False), callback=_existing)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
overwrite_option = of_field("overwrite")
scene_options = under("Scene")
config_option = _messages(
    "--config",
    type=_FILE,
    metavar="FILE.toml",
    help="The show's defaults.  [default: PHYSGRAPH_CONFIG, or physgraph.toml above the shot]",
)
run_options = together(
    _batch(
        "--summary",
        type=_FILE,
        metavar="FILE.json",
        help="Write a record of each shot: frames, seconds per frame, crossings, warnings, exit code.",
    ),
    _farm(
        "--seam-bound",
        type=click.FloatRange(min=0),
        metavar="EDGES",
        help="With --preroll: fail if a seam to a neighbouring chunk in the same folder moves more (see stitch).",
    ),
    _farm("--openjd", is_flag=True, help="Print progress in the lines that OpenJD reads."),
    config_option,
    _messages("--progress", is_flag=True, help="Print a line for each frame, into files and pipes too."),
    _messages("-q", "--quiet", is_flag=True, help="Print only errors on stderr."),
    _messages("--json", "as_json", is_flag=True, help="Print the shots' summary as JSON on stdout, not the paths."),
    _messages(
        "-v",
        "--verbose",
        count=True,
        default=0,
        show_default=False,
        help="Print more: -v each frame, -vv also measurements.",
    ),
    _messages(
        "--log-file",
        type=_FILE,
        metavar="FILE",
        help="Also append messages to a file, with times, each frame included.",
    ),
)


def out_option(metavar: str, help_text: str, *, required: bool = True) -> Decorator:
    """Declare ``-o``, the output of a command.

    Args:
        metavar: Placeholder for the value in the help.
        help_text: The option's line in the help.
        required: Whether the option is required.
    """
    return _files("-o", "--out", required=required, type=_PATH, metavar=metavar, help=help_text)
