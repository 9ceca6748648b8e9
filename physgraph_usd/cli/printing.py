"""Output of commands: warnings and progress on stderr, reports in words, a log in a file."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from ..errors import NOTICE, PhysGraphError, UsageError, counted

if TYPE_CHECKING:
    from ..shot.stitch import Seam

MOST_LISTED = 8
"""Longest list of numbers printed in full."""
LOGGER = "physgraph_usd"
_LEVELS = (NOTICE, logging.INFO, logging.DEBUG)
_CLEAR_LINE = "\r\033[K"
_LINE = "%(asctime)s %(levelname)s %(shot)s: %(message)s"
_LOGGED = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} [A-Z]+ .*: ")
"""Beginning of a log's first line."""


@dataclass(frozen=True)
class Output:
    """Output of a command: amount, form and destination.

    Attributes:
        verbose: 0 warnings, 1 each frame too, 2 the frame's measurements too.
        log_file: A file to append to, with each frame at least, or None.
        in_lines: Print progress in lines, into files and pipes too.
        several: Name the shot in each line.
        openjd: Print progress in lines for OpenJD.
        quiet: Print errors alone on stderr.
        as_json: Print a summary of all shots as JSON on stdout, in place of the layers' paths.
    """

    verbose: int = 0
    log_file: Path | None = None
    in_lines: bool = False
    several: bool = False
    openjd: bool = False
    quiet: bool = False
    as_json: bool = False

    def __post_init__(self) -> None:
        """Refuse (UsageError) to print more and less at once."""
        wordy = {"--verbose": self.verbose > 0, "--progress": self.in_lines, "--openjd": self.openjd}
        if self.quiet and any(wordy.values()):
            raise UsageError(f"--quiet and {next(name for name in wordy if wordy[name])} exclude each other; give one")

    @contextmanager
    def logged(self) -> Iterator[None]:
        """Send the package's log to stderr and into the file; an error ending the block goes only into the file.

        Raises:
            OSError: The file cannot be written.
            UsageError: The file is a link, or exists and is no log.
        """
        from ..usd.write.atomic import check_no_link

        level = logging.ERROR if self.quiet else _LEVELS[min(self.verbose, 2)]
        logger, on_stderr = logging.getLogger(LOGGER), _OnStderr(level, self.several)
        handlers: list[logging.Handler] = [on_stderr]
        if self.log_file is not None:
            check_no_link(self.log_file)
            _check_log(self.log_file)
            into_file = _IntoFile(self.log_file, encoding="utf-8")
            into_file.setLevel(_LEVELS[max(min(self.verbose, 2), 1)])
            into_file.setFormatter(logging.Formatter(_LINE, defaults={"shot": "-"}))
            handlers.append(into_file)
        logging.addLevelName(NOTICE, "NOTICE")
        before = logger.level
        logger.setLevel(min(handler.level for handler in handlers))
        for handler in handlers:
            logger.addHandler(handler)
        try:
            yield
        except PhysGraphError as error:
            logger.removeHandler(on_stderr)
            if logger.hasHandlers():  # Without any, logging itself would write to stderr.
                logger.error(str(error))
            raise
        finally:
            logger.setLevel(before)
            for handler in handlers:
                logger.removeHandler(handler)
                handler.close()

    @contextmanager
    def progress(self, label: str) -> Iterator[Callable[[int, int], None]]:
        """A bar of finished frames, only on a terminal, or progress in lines."""
        hidden = self.quiet or self.in_lines or self.openjd or self.verbose > 0 or not sys.stderr.isatty()
        with click.progressbar(length=1, label=label, file=sys.stderr, hidden=hidden) as bar:

            def show(done: int, total: int) -> None:
                bar.length = total
                bar.update(done - bar.pos)
                if self.openjd:
                    say(f"openjd_progress: {100.0 * done / total:.1f}", err=True)
                    say(f"openjd_status: {done} of {counted(total, 'frame')}, {_left(bar.eta)}", err=True)
                elif self.in_lines:
                    print_progress(bar.pct, bar.eta, f"{done} of {counted(total, 'frame')}")

            yield show


class _OnStderr(logging.Handler):
    """Warnings and errors with the level's name, other messages unchanged."""

    def __init__(self, level: int, several: bool) -> None:
        super().__init__(level)
        self._several = several

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        kind = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        shot = getattr(record, "shot", "") if self._several else ""
        say(f"{kind}{shot}{': ' if shot else ''}{record.getMessage()}", err=True)


class _IntoFile(logging.FileHandler):
    """The log; a full disk ends the log, not the run."""

    _full = False

    def handleError(self, record: logging.LogRecord) -> None:
        """Report once the end of the log; called by `logging`."""
        if not self._full:
            self._full = True
            say(f"warning: cannot write {self.baseFilename}: {sys.exc_info()[1]}; the log ends here", err=True)

    def close(self) -> None:
        """Close the file, after an error too."""
        with suppress(OSError):
            super().close()


def _check_log(file: Path) -> None:
    """Refuse (UsageError) to append to a file without a log line at the beginning."""
    if not file.is_file() or not file.stat().st_size:
        return
    with file.open(encoding="utf-8", errors="replace") as stream:
        if not _LOGGED.match(stream.readline(4096)):
            raise UsageError(f"{file} exists and is no log of this program; choose another name")


def say(text: str, *, err: bool = False) -> None:
    """Print a line, on a terminal over the progress bar, if any; a closed stream loses the line only."""
    if err and sys.stderr.isatty():
        text = _CLEAR_LINE + text
    try:
        click.echo(text, err=err)
    except OSError:
        _to_nowhere(sys.stderr if err else sys.stdout)


def _to_nowhere(stream: TextIO) -> None:
    """Discard pending output: Python's own flush at the end would fail too."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def print_progress(part: float, seconds: float, what: str) -> None:
    """Print a line of progress on stderr.

    Args:
        part: Finished fraction, 1 for all.
        seconds: Estimated remaining time [s].
        what: Name of the work.
    """
    say(f"{part:4.0%}  {_left(seconds):20s}  {what}", err=True)


def _left(seconds: float) -> str:
    return f"about {seconds / 60.0:.0f} min left" if seconds > 90.0 else f"about {seconds:.0f} s left"


def seam_lines(seams: Iterable[Seam], bound: float) -> Iterator[str]:
    """A line for each seam: its move, the bound, and the remedy where less than a third of the bound is left."""
    from ..shot.stitch import SPARE

    for seam in seams:
        if seam.rms > (1 - SPARE) * bound:
            yield f"{seam}; near the bound of {bound:g} RMS, and a longer --preroll moves the seam less"
        else:
            yield f"{seam}; the bound is {bound:g} RMS"


def outline(value: Any, indent: str = "") -> Iterator[str]:
    """Lines of a report for reading: nested records indented, plain lists on one line."""
    pairs = value.items() if isinstance(value, dict) else (("-", item) for item in value)
    for key, item in pairs:
        label = key if key == "-" else f"{key}:"
        if isinstance(item, dict | list) and any(isinstance(part, dict | list | str) for part in item):
            yield f"{indent}{label}"
            yield from outline(item, indent + "  ")
        else:
            yield f"{indent}{label} {_in_words(item)}"


def _in_words(value: Any) -> str:
    if isinstance(value, list) and len(value) > MOST_LISTED:
        return f"{_in_words(value[:3])}, ..., {_in_words(value[-1])} ({len(value)} in all)"
    if isinstance(value, list) and value:
        return ", ".join(map(_in_words, value))
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None or value in ([], {}) else str(value)
