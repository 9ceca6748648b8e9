"""Values that an artist tunes: how each is found in a frame, named and drawn as a slider."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from ..solver.mesh.subdivide import Refinement
from ..solver.scene import Garment, GarmentFrame
from ..usd.schema import GARMENT


@dataclass(frozen=True)
class Tunable:
    """A value of a garment, and its slider.

    Attributes:
        name: The schema's short name.
        unit: Unit shown.
        factor: Times the SI value, it is the number shown.
        read: Finds the value [SI] in a frame; None where nothing gives one.
        decades: Whether the slider is logarithmic.
    """

    name: str
    unit: str
    factor: float
    read: Callable[[GarmentFrame], float | None]
    decades: bool = True

    @property
    def label(self) -> str:
        """The schema's display name."""
        return GARMENT[self.name].label

    @property
    def group(self) -> str:
        """The schema's display group."""
        return GARMENT[self.name].group

    @property
    def ends(self) -> tuple[float, float]:
        """The slider's ends, SI: the schema's soft limits."""
        return GARMENT[self.name].soft or (0.0, 1.0)

    def text(self, value: float | None) -> str:
        """A value as the page writes it."""
        return "not set" if value is None else f"{float(f'{value * self.factor:.3g}'):,.8g} {self.unit}".strip()

    def place(self, value: float) -> float:
        """The place of a value on the slider, 0 to 1; values beyond its ends are at them."""
        numbers = (*self.ends, value)
        low, high, at = np.log10(np.maximum(numbers, 1e-12)) if self.decades else numbers
        return float(np.clip((at - low) / (high - low), 0.0, 1.0))

    def at(self, place: float) -> float:
        """The value [SI] at a place on the slider."""
        low, high = self.ends
        return low * (high / low) ** place if self.decades else low + (high - low) * place


def _percent(value: float | None) -> float | None:
    """A fraction as the attribute holds it."""
    return None if value is None else 100.0 * value


TUNABLES: dict[str, Tunable] = {
    each.name: each
    for each in (
        Tunable("rest:weftEase", "%", 1.0, lambda f: _percent(f.fabric.weft_ease), decades=False),
        Tunable("rest:warpEase", "%", 1.0, lambda f: _percent(f.fabric.warp_ease), decades=False),
        Tunable("rest:creaseTime", "s", 1.0, lambda f: f.fabric.crease_time, decades=False),
        Tunable("stretchStiffness", "N/m", 1.0, lambda f: f.fabric.stretch),
        Tunable("weftStretchStiffness", "N/m", 1.0, lambda f: f.fabric.weft_stretch),
        Tunable("shearStiffness", "N/m", 1.0, lambda f: f.fabric.shear),
        Tunable("bendStiffness", "µN·m", 1e6, lambda f: f.fabric.bend),
        Tunable("weftBendStiffness", "µN·m", 1e6, lambda f: f.fabric.weft_bend),
        Tunable("density", "g/m²", 1e3, lambda f: f.fabric.density),
        Tunable("thickness", "mm", 1e3, lambda f: f.fabric.thickness),
        Tunable("stretchLimit", "%", 1.0, lambda f: _percent(f.fabric.stretch_limit), decades=False),
        Tunable("guide:stiffness", "N/m³", 1.0, lambda f: f.guide),
        Tunable("refine:detail", "", 1.0, lambda f: f.detail, decades=False),
        Tunable("contact:offset", "mm", 1e3, lambda f: f.offset),
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
    """A map of `PAINTED` on a garment's finest vertices, shape (V,), by its subdivisions, coarsest first."""
    return reduce(lambda values, step: np.asarray(step.linear @ values), refinements, PAINTED[name](garment))
