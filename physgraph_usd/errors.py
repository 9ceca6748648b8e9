"""Every error that physgraph_usd raises on purpose.

    PhysGraphError
    |-- UsageError          an option or argument is wrong (exit code 2)
    |   `-- AbsentError     a file, a prim or a frame that was named is not there; a StageError too
    |-- StageError          the input stage cannot be read as asked
    |   |-- GarmentError    one garment prim is broken: names prim, time code and remedy
    |   `-- SchemaError     an attribute has an unusable type or value
    |-- SolveError          the solver met a state it cannot continue from
    |-- WeightsError        a network's weights are missing, damaged or of another version
    `-- LayerError          the output layer cannot be written or is invalid

A message gives the value, the place and the choices, in one line each; `counted` puts numbers of things into words.
"""

from __future__ import annotations

from typing import Any


class PhysGraphError(Exception):
    """Root of all errors raised on purpose; its text is meant for the user.

    Attributes:
        exit_code: What a command that it ends leaves with.
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
    """A file, a prim or a frame that was named is not there."""


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
        where = f"<{path}>" if time is None else f"<{path}> at time code {time:g}"
        super().__init__(f"{where}: {problem}" + (f"; {remedy}" if remedy else ""))


class SchemaError(StageError):
    """A physgraph attribute has a type or value that cannot be used."""


class SolveError(PhysGraphError):
    """The solver met a state it cannot continue from, such as a non-finite energy."""


class WeightsError(PhysGraphError):
    """A network's weights are missing, damaged, or of another kind or version."""


class LayerError(PhysGraphError):
    """The output layer cannot be written, or failed validation."""


NOTICE = 25
"""Level of what a run says without being asked and is nothing wrong, between logging's INFO and WARNING."""


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number of things: "1 frame", "1,024 frames".

    Args:
        number: How many.
        noun: One of them.
        plural: Several; the noun with an "s" where it is left out.
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"
