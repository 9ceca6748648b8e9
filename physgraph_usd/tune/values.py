"""What an artist tunes: how each value is found in a frame, named and drawn as a slider."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from ..mesh.subdivide import Refinement
from ..scene import Garment, GarmentFrame


@dataclass(frozen=True)
class Tunable:
    """A value of a garment, and its slider.

    Attributes:
        name: The schema's short name.
        label: What artists call it.
        unit: Unit shown.
        factor: Times the SI value, it is the number shown.
        low, high: The slider's ends, SI.
        read: Finds the value [SI] in a frame; None where nothing gives one.
        decades: Whether the slider is logarithmic.
    """

    name: str
    label: str
    unit: str
    factor: float
    low: float
    high: float
    read: Callable[[GarmentFrame], float | None]
    decades: bool = True

    def said(self, value: float | None) -> str:
        """A value as the page writes it."""
        return "not set" if value is None else f"{float(f'{value * self.factor:.3g}'):,.8g} {self.unit}".strip()

    def place(self, value: float) -> float:
        """Where a value is on the slider, 0 to 1; values beyond its ends are at them."""
        ends = self.low, self.high, value
        low, high, at = np.log10(np.maximum(ends, 1e-12)) if self.decades else ends
        return float(np.clip((at - low) / (high - low), 0.0, 1.0))

    def at(self, place: float) -> float:
        """The value [SI] at a place on the slider."""
        if self.decades:
            return self.low * (self.high / self.low) ** place
        return self.low + (self.high - self.low) * place


TUNABLES: dict[str, Tunable] = {
    each.name: each
    for each in (
        Tunable("stretchStiffness", "Stretch", "N/m", 1.0, 1.0, 1e4, lambda f: f.fabric.stretch),
        Tunable("shearStiffness", "Shear", "N/m", 1.0, 0.1, 1e4, lambda f: f.fabric.shear),
        Tunable("bendStiffness", "Bending", "µN·m", 1e6, 1e-7, 1e-2, lambda f: f.fabric.bend),
        Tunable("density", "Density", "g/m²", 1e3, 0.01, 2.0, lambda f: f.fabric.density),
        Tunable("thickness", "Thickness", "mm", 1e3, 1e-4, 1e-2, lambda f: f.fabric.thickness),
        Tunable("guide:stiffness", "Follow the animation", "N/m³", 1.0, 10.0, 1e6, lambda f: f.guide),
        Tunable("refine:detail", "Detail", "", 1.0, 0.0, 2.0, lambda f: f.detail, decades=False),
        Tunable("contact:offset", "Distance from bodies", "mm", 1e3, 1e-4, 3e-2, lambda f: f.offset),
    )
}
"""Every value that can be tuned, by the schema's short name, in the page's order."""

PAINTED: dict[str, Callable[[Garment], np.ndarray]] = {
    "stretchScale": lambda garment: garment.stretch_scale,
    "bendScale": lambda garment: garment.bend_scale,
    "guideScale": lambda garment: garment.guide_scale,
    "detailScale": lambda garment: garment.detail_scale,
    "pin": lambda garment: garment.pin,
}
"""How each painted map is found in a garment, by the schema's short name."""


def painted_on(garment: Garment, refinements: Sequence[Refinement], name: str) -> np.ndarray:
    """A painted map on a garment's finest vertices, shape (V,).

    Args:
        garment: The garment.
        refinements: Its subdivisions, coarsest first.
        name: The map's short name, a name of `PAINTED`.
    """
    return reduce(lambda values, step: np.asarray(step.linear @ values), refinements, PAINTED[name](garment))
