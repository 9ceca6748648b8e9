"""One colour and one sign a method, the same in pictures and on the page."""

from __future__ import annotations

from dataclasses import dataclass

from .methods import DEFAULT, SMOOTH, UPSAMPLED
from .table import Chart

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5195", "#8c6d31")
"""Okabe and Ito's colours, which colour-blind readers tell apart, and two more."""
OUTSIDE = ("#e6007e", "#7fa800", "#5a2d0c")
"""Colours of solvers outside."""
BASELINE = "#6e6e6e"


@dataclass(frozen=True)
class Style:
    """How a curve is drawn.

    Attributes:
        colour: As "#rrggbb".
        dashed: Whether the curve is broken: the method as it is not used by default.
        outside: Whether a solver outside drew it.
    """

    colour: str
    dashed: bool
    outside: bool = False


def styles(chart: Chart) -> dict[str, Style]:
    """A style for each curve: the colour is the integrator's, a broken line is flat."""
    nested = {point.method: point.nested for point in chart.points}
    family = {point.method: (point.integrator or point.method).removesuffix("-flat") for point in chart.points}
    names = {family[name] for name in chart.methods if name not in {DEFAULT, SMOOTH, UPSAMPLED}}
    outside = names & set(chart.notes)
    colours = {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(sorted(names - outside))}
    colours |= {name: OUTSIDE[i % len(OUTSIDE)] for i, name in enumerate(sorted(outside))}
    found = {
        name: Style(colours.get(family[name], BASELINE), nested[name] is False, family[name] in outside)
        for name in chart.methods
    }
    return found | {DEFAULT: Style("#111111", False)}
