"""The methods of a chart: every integrator there is, nested and flat, found when the chart is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ...errors import UsageError
from ...solver.integrate import METHODS, Method

DEFAULT = "refine's default"
UPSAMPLED, SMOOTH = "plain upsampling", "Loop subdivision"
"""Curves of one point each."""


@dataclass(frozen=True)
class Curve:
    """One line of the chart.

    Attributes:
        name: Its name in legends and tables.
        integrator: The name in `METHODS`.
        method: The integrator and whether it is nested.
    """

    name: str
    integrator: str
    method: Method


def find_curves(names: Sequence[str] = ()) -> tuple[Curve, ...]:
    """Every integrator as it is and, where that is not another's, with nesting switched over.

    What chooses between others frame by frame is none of them: it is refine's default.

    Args:
        names: Names of `METHODS` to keep; all when empty.

    Raises:
        UsageError: No integrator has one of the names.
    """
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise UsageError(f"unknown integrator '{unknown[0]}'; known integrators: {', '.join(METHODS)}")
    fixed = {name: method for name, method in METHODS.items() if method.nested is not None}
    kept = {name: method for name, method in fixed.items() if not names or name in names}
    known = {(method.build, method.nested) for method in METHODS.values()}
    curves = [Curve(name, name, method) for name, method in kept.items()]
    for name, method in kept.items():
        other = replace(method, nested=not method.nested)
        if (other.build, other.nested) not in known:
            curves.append(Curve(f"{name}, {'nested' if other.nested else 'flat'}", name, other))
    return tuple(curves)
