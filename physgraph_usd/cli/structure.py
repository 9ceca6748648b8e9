"""Common parts of commands: exit codes, errors as one line on stderr, help in groups."""

from __future__ import annotations

import errno
import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Never

import click

from ..errors import PhysGraphError
from ..interrupts import SIGNALLED, importing

DONE, FAILED = 0, 1
EXTRAS = {"pxr": "usd", "PIL": "preview", "matplotlib": "chart", "plotly": "chart", "viser": "tune"}
"""Which extra brings a module that only some commands need."""


class Commands(click.Group):
    """A group whose commands end with ``error: ...`` and the error's exit code instead of a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command; an error of our tree, or one of the disk or of memory, becomes one line on stderr."""
        from ..shot.processes import memory_is_named

        _open_closed_streams()
        try:
            with memory_is_named():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("interrupted", err=True)
            ctx.exit(SIGNALLED + signal.SIGINT)
        except PhysGraphError as error:
            _leave(ctx, str(error), error.exit_code)
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            _leave(ctx, f"{error.filename or 'cannot read or write'}: {error.strerror}", FAILED)
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing not in EXTRAS:
                raise
            _leave(ctx, f"{missing} is not installed: pip install 'physgraph-usd[{EXTRAS[missing]}]'", FAILED)


def _open_closed_streams() -> None:
    """Let output go nowhere where its stream was closed by who started this: a file opened later would get it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.dup2(nowhere, number)
            if nowhere != number:
                os.close(nowhere)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8"))


@contextmanager
def imports_uncollected() -> Iterator[None]:
    """Keep the garbage collector from torch's million objects, which live as long as the process: 3 s become 2."""
    gc.disable()
    try:
        with importing():
            yield
    finally:
        gc.freeze()
        gc.enable()


def _leave(ctx: click.Context, message: str, code: int) -> Never:
    click.echo(f"error: {message}", err=True)
    ctx.exit(code)


class Option(click.Option):
    """An option that the help shows under a heading.

    Attributes:
        heading: The heading.
    """

    def __init__(self, *args: Any, heading: str = "Options", **settings: Any) -> None:
        """Declare it, as `click.Option` is declared."""
        super().__init__(*args, **settings)
        self.heading = heading


class GroupedCommand(click.Command):
    """A command whose help shows its options under their headings, in the order in which they are declared."""

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
