"""Every error that physgraph_usd raises on purpose.

    PhysGraphError
    |-- UsageError          an option or argument is wrong (exit code 2)
    |   `-- AbsentError     a file, a prim or a frame that was named is not there; a StageError too
    |-- StageError          the input stage cannot be read as asked
    |   |-- GarmentError    one garment prim is broken: names prim, time code and remedy
    |   `-- SchemaError     an attribute has an unusable type or value
    |-- SolveError          the solver met a state it cannot continue from
    |-- WeightsError        a network's weights are missing, damaged or of another version
    |-- LayerError          the output layer cannot be written or is invalid
    `-- UnexpectedError     any other exception: a fault of the program

A message gives the value, the place and the choices, in one line each; `counted` puts numbers of things into words,
`named_time` time codes.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

LONGEST_TEXT = 300
"""Most characters of an unexpected exception's text in a message."""
MOST_NAMED = 3
"""Most prims named in the message of an unexpected exception."""
_ROOMS = "cli|lab|shot|solver|studio|usd"
_OF_PACKAGE = re.compile(rf'File ".*physgraph_usd[\\/]((?:(?:{_ROOMS})[\\/].+|\w+\.py))", line (\d+), in (\S+)')
"""A line of a traceback in this package, wherever it is installed: a checkout may lie in a folder of its name."""


class PhysGraphError(Exception):
    """Root of all errors raised on purpose; its text is meant for the user.

    Attributes:
        exit_code: Exit code of a command that ends with this error.
    """

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes as text and fields, whatever the arguments of a subclass are."""
        return _restored, (type(self), self.args, self.__dict__)


def _restored(kind: type[PhysGraphError], args: tuple[Any, ...], fields: dict[str, Any]) -> PhysGraphError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(fields)
    return error


class UsageError(PhysGraphError):
    """An option or argument is wrong; the command line exits with 2."""

    exit_code = 2


class StageError(PhysGraphError):
    """The input stage cannot be opened or read as asked."""


class AbsentError(UsageError, StageError):
    """A named file, prim or frame does not exist."""


class GarmentError(StageError):
    """A garment prim is broken.

    Args:
        path: Prim path.
        problem: What is wrong, with the value or index found.
        time: Time code at which it was found, or None when it holds at all times.
        remedy: What the user can do.
    """

    def __init__(self, path: str, problem: str, *, time: float | None = None, remedy: str = "") -> None:
        """Compose the message from place, problem and remedy."""
        self.path, self.problem, self.time, self.remedy = path, problem, time, remedy
        location = f"<{path}>" if time is None else f"<{path}> at time code {named_time(time)}"
        super().__init__(f"{location}: {problem}" + (f"; {remedy}" if remedy else ""))


class SchemaError(StageError):
    """A physgraph attribute has a type or value that cannot be used."""


class SolveError(PhysGraphError):
    """The solver met a state it cannot continue from, such as a non-finite energy."""


class WeightsError(PhysGraphError):
    """A network's weights are missing, damaged, or of another kind or version."""


class LayerError(PhysGraphError):
    """The output layer cannot be written, or failed validation."""


class UnexpectedError(PhysGraphError):
    """An exception that the program did not raise on purpose.

    Args:
        kind: Name of the exception's class.
        text: Text of the exception.
        place: Where it was raised.
        trace: The traceback.
    """

    def __init__(self, kind: str, text: str, *, place: Place | None = None, trace: str = "") -> None:
        """Compose the message, in one line, from place, exception and remedy."""
        self.kind, self.text, self.trace = kind, " ".join(text.split())[:LONGEST_TEXT], trace
        self.place = Place() if place is None else place
        fault = f"unexpected {kind}: {self.text}" + (f" ({self.place.code})" if self.place.code else "")
        super().__init__(f"{self.place.named()}{fault}; {self._remedy()}")

    def _remedy(self) -> str:
        options = ["--frames"] * (self.place.time is not None) + ["--garment"] * bool(self.place.prims)
        leave_out = f"{' or '.join(options)} can leave out where it happens, " if options else ""
        return f"this is a fault of the program: {leave_out}--debug prints the traceback for a report of it"

    @classmethod
    def of(cls, error: BaseException, *, time: float | None = None) -> Self:
        """Describe an exception; ``time`` is the time code if the exception has none."""
        trace = "".join(traceback.format_exception(error))
        return cls(type(error).__name__, str(error), place=place_of(error, time=time), trace=trace)


@dataclass(frozen=True)
class Place:
    """Where an exception was raised.

    Attributes:
        prims: Paths of the prims at work.
        time: The time code at work, or None if unknown.
        code: File, line and function of this package, such as "solver/level.py, line 7, in build".
    """

    prims: tuple[str, ...] = ()
    time: float | None = None
    code: str = ""

    def named(self) -> str:
        """The beginning of a message, such as "</World/Coat> at time code 3: "; "" if nothing is known."""
        named, more = ", ".join(f"<{path}>" for path in self.prims[:MOST_NAMED]), len(self.prims) - MOST_NAMED
        prims = f"{named} and {more:,} more" if more > 0 else named
        parts = [prims] * bool(prims) + ([] if self.time is None else [f"at time code {named_time(self.time)}"])
        return f"{' '.join(parts)}: " if parts else ""


class At(AbstractContextManager[None]):
    """Notes prims and time code on exceptions raised inside the block, for `place_of`; inner blocks go first."""

    def __init__(self, *, prims: tuple[str, ...] = (), time: float | None = None) -> None:
        """Take what is at work in the block."""
        self._at = {"prims": prims} if prims else {}
        self._at |= {} if time is None else {"time": time}

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Note the place; the exception goes on."""
        if error is not None:
            vars(error)["physgraph_at"] = self._at | vars(error).get("physgraph_at", {})


def place_of(error: BaseException, *, time: float | None = None) -> Place:
    """Where an exception was raised, in this process or in another.

    Args:
        error: The exception.
        time: The time code if the exception has none.
    """
    if isinstance(error, UnexpectedError):
        return error.place
    at = vars(error).get("physgraph_at", {})
    if isinstance(error, GarmentError):
        at = at | {"prims": (error.path,)} | ({} if error.time is None else {"time": error.time})
    lines = _OF_PACKAGE.findall("".join(traceback.format_exception(error)))
    own_frames = [(file.replace("\\", "/"), line, name) for file, line, name in lines]
    code = "{}, line {}, in {}".format(*own_frames[-1]) if own_frames else ""
    return Place(tuple(at.get("prims", ())), at.get("time", time), code)


def named(error: BaseException, *, time: float | None = None) -> PhysGraphError:
    """An exception as an error of this tree; an error of the disk gives file and reason.

    Args:
        error: The exception.
        time: The time code if the exception has none.
    """
    if isinstance(error, PhysGraphError):
        return error
    if isinstance(error, OSError) and error.strerror:
        return PhysGraphError(f"{error.filename or 'cannot read or write'}: {error.strerror}")
    return UnexpectedError.of(error, time=time)


@contextmanager
def exceptions_named(besides: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Convert exceptions raised inside the block to errors of this tree, with one line for the user and the traceback.

    For the ends of a process: the command line, and a worker, whose exceptions may not travel to the parent.

    Args:
        besides: Exceptions to let through.

    Raises:
        PhysGraphError: The block raised an exception.
    """
    try:
        yield
    except (PhysGraphError, *besides):
        raise
    except Exception as error:
        raise named(error) from error


NOTICE = 25
"""Level of what a run says without being asked and is nothing wrong, between logging's INFO and WARNING."""


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number with its noun: "1 frame", "1,024 frames".

    Args:
        number: The number, printed with thousands separators.
        noun: The noun's singular.
        plural: The noun's plural; "" for the singular with an "s".
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def named_time(time: float | None) -> str:
    """A time code in words, "default" for None; different time codes never read alike, not even about a jump."""
    return "default" if time is None else f"{time:.12g}"
