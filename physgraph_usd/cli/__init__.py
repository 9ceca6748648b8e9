"""The console command: each subcommand declares options, imports the work and makes a single call.

Data goes to stdout; progress, warnings and errors go to stderr.
Exit codes: 0 done, 1 the work failed, 2 wrong usage, 3 done in part, 130 interrupted, 143 terminated.
"""

from __future__ import annotations

import click

from ..version import __version__
from . import commands
from .structure import Commands


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(__version__, prog_name="physgraph-usd")
def main() -> None:
    """Refine coarse animated garments in USD shots into fine cloth."""


for command in vars(commands).values():
    if isinstance(command, click.Command):
        main.add_command(command)
