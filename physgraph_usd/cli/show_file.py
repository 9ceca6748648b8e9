"""A show's defaults: the table ``[refine]`` of ``physgraph.toml``, by the options' names on the command line.

[refine]
level = 2
self-contact = "auto"
set = ["bendStiffness=2e-4"]
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from ..errors import UsageError
from .options import SHOW_HEADINGS
from .structure import Option

NAME, VARIABLE, TABLE = "physgraph.toml", "PHYSGRAPH_CONFIG", "refine"


def find_show_file(shot: str, config: Path | None) -> Path | None:
    """The file named by the option or by the environment, or else the first in the folders above a shot."""
    named = config or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    above = (folder / NAME for folder in Path(shot).absolute().parents)
    return named or next((file for file in above if file.is_file()), None)


def values_for(ctx: click.Context, shot: str, known: click.Command) -> tuple[dict[str, Any], dict[str, str]]:
    """Values of a command's options for a shot: from the command line, the show's file, or the defaults, in this order.

    Args:
        ctx: The command's context.
        shot: The shot.
        known: Command defining the keys of the file; options missing in ``ctx``'s command are ignored.

    Returns:
        Values by the options' names in Python, and the source of each.

    Raises:
        UsageError: The file cannot be read, has an unknown key, or a value invalid for the option.
    """
    file = find_show_file(shot, ctx.params.get("config"))
    table = {} if file is None else _read(file, known)
    values, sources = {}, {}
    for param in (parameter for parameter in ctx.command.params if parameter.expose_value):
        name, key = str(param.name), _key(param)
        if ctx.get_parameter_source(name) not in (ParameterSource.DEFAULT, None):
            values[name], sources[name] = ctx.params[name], "command line"
        elif file is not None and key in table:
            values[name], sources[name] = _converted(ctx, param, table[key], file=file), str(file)
        else:
            values[name], sources[name] = ctx.params[name], "default"
    return values, sources


def _key(param: click.Parameter) -> str:
    """An option's name in the file."""
    return max(param.opts, key=len).lstrip("-")


def _read(file: Path, command: click.Command) -> Mapping[str, Any]:
    """The table of a file, with option names as keys."""
    if file.exists() and not file.is_file():
        raise UsageError(f"cannot read {file}: it is a folder or a pipe, and no file")
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # The last from values nested too deep.
        raise UsageError(f"cannot read {file}: {error}") from error
    _check_names(file, "table", tables, [TABLE])
    table = tables.get(TABLE, {})
    if not isinstance(table, dict):
        raise UsageError(f"{file}: {TABLE} is no table; write [{TABLE}]")
    options = [parameter for parameter in command.params if isinstance(parameter, Option)]
    names = [_key(option) for option in options if option.heading in SHOW_HEADINGS]
    for key in sorted({_key(option) for option in options if option.heading not in SHOW_HEADINGS} & set(table)):
        raise UsageError(f"{file}: {key} is of one run; give it on the command line")
    _check_names(file, "key", table, names)
    return table


def _check_names(file: Path, kind: str, names: Mapping[str, Any], allowed: list[str]) -> None:
    for name in names:
        if name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1)
            meant = f"did you mean {near[0]}?" if near else f"known: {', '.join(sorted(allowed))}"
            raise UsageError(f"{file}: unknown {kind} '{name}'; {meant}")


def _converted(ctx: click.Context, param: click.Parameter, value: Any, *, file: Path) -> Any:
    """A value of the file, converted like a command-line value; a path is relative to the file's folder."""
    key = _key(param)
    try:
        if isinstance(param, click.Option) and param.is_flag:
            return _checked(value, bool, "true or false")
        if param.multiple:
            return param.type_cast_value(ctx, [str(item) for item in _checked(value, list, "a list")])
        converted = param.type_cast_value(ctx, str(_checked(value, (str, int, float), "a text or a number")))
    except (click.BadParameter, TypeError) as error:
        raise UsageError(f"{file}: {key}: {getattr(error, 'message', error)}") from error
    return file.parent / converted if isinstance(converted, Path) else converted


def _checked(value: Any, kind: type | tuple[type, ...], words: str) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise TypeError(f"{value!r} is not {words}")
    return value
