"""Common parts of commands: exit codes, errors as a line on stderr, help in groups."""

from __future__ import annotations

import gc
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Never

import click

from ..errors import PhysGraphError, UnexpectedError, exceptions_named
from ..interrupts import SIGNALLED, importing

DONE, FAILED = 0, 1
PACKAGES = {
    "pxr": "'usd-core<28'",
    "PIL": "pillow",
    "matplotlib": "matplotlib",
    "plotly": "plotly",
    "viser": "'viser<2'",
}
"""Package to install for each optional module."""


DEBUG = "physgraph_usd.debug"
"""Key of ``--debug`` in the context of a command."""


class Commands(click.Group):
    """A group of commands ending with ``error: ...`` and the error's exit code; a traceback only with ``--debug``."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command; an exception becomes a line on stderr."""
        _open_closed_streams()
        try:
            with errors_named():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("interrupted", err=True)
            ctx.exit(SIGNALLED + signal.SIGINT)
        except PhysGraphError as error:
            show_trace(error)
            _leave(ctx, str(error), error.exit_code)

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command, with the option ``--debug``."""
        cmd.params.append(_debug_option())
        super().add_command(cmd, name)


def _debug_option() -> click.Option:
    def keep(ctx: click.Context, _param: click.Parameter, value: bool) -> None:
        ctx.meta[DEBUG] = value

    return Option(
        ["--debug"],
        is_flag=True,
        expose_value=False,
        callback=keep,
        heading="Messages",
        help="Print the traceback of an error too.",
    )


@contextmanager
def errors_named() -> Iterator[None]:
    """Convert exceptions, except click's and a closed pipe's, to errors with a line for the user.

    Raises:
        PhysGraphError: The block raised an exception.
    """
    from ..shot.workers import memory_is_named

    of_click = (click.ClickException, click.Abort, click.exceptions.Exit, BrokenPipeError)
    with exceptions_named(besides=of_click), memory_is_named():
        try:
            yield
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing not in PACKAGES:
                raise
            raise PhysGraphError(f"{missing} is not installed: pip install {PACKAGES[missing]}") from error


def show_trace(error: PhysGraphError) -> None:
    """Print the traceback of an error on stderr, with ``--debug`` only."""
    if click.get_current_context().meta.get(DEBUG):
        trace = error.trace if isinstance(error, UnexpectedError) else "".join(traceback.format_exception(error))
        click.echo(trace, err=True, nl=False)


def _open_closed_streams() -> None:
    """Discard output to streams closed by the parent process: a file opened later would receive the output."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.dup2(nowhere, number)
            if nowhere != number:
                os.close(nowhere)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8"))


@contextmanager
def imports_uncollected() -> Iterator[None]:
    """Import modules without garbage collection, and freeze the imported objects, in later `importing` blocks too."""
    gc.freeze()
    with importing():
        yield


def _leave(ctx: click.Context, message: str, code: int) -> Never:
    click.echo(f"error: {message}", err=True)
    ctx.exit(code)


class Option(click.Option):
    """An option with a heading in the help.

    Attributes:
        heading: The heading.
    """

    def __init__(self, *args: Any, heading: str = "Options", **settings: Any) -> None:
        """Declare the option, as in `click.Option`."""
        super().__init__(*args, **settings)
        self.heading = heading


class GroupedCommand(click.Command):
    """A command with options grouped by heading in the help, in order of declaration."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options into the help."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx) if isinstance(param, click.Option) else None
            if record is not None:
                groups.setdefault(param.heading if isinstance(param, Option) else "Options", []).append(record)
        for heading in sorted(groups, key="Options".__eq__):  # what has no heading comes last
            with formatter.section(heading):
                formatter.write_dl(groups[heading])
