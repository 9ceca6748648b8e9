"""Values that an artist tunes: how each is found in a frame, named and drawn as a slider."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from ..solver.mesh.subdivide import Refinement
from ..solver.scene import GarmentFrame
from ..usd.schema import GARMENT, PAINTED


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
    def title(self) -> str:
        """The label, shortened by "Stiffness" to fit beside a number box, and the unit."""
        short = self.label.removesuffix(" Stiffness")
        return f"{short} [{self.unit}]" if self.unit else short

    @property
    def hint(self) -> str:
        """Visible effect of the value, and the attribute's name."""
        return f"{SAYS[self.name]} {GARMENT[self.name].name}"

    @property
    def ends(self) -> tuple[float, float]:
        """The slider's ends, SI: the schema's soft limits."""
        return GARMENT[self.name].soft or (0.0, 1.0)

    def shown(self, value: float) -> tuple[float, int]:
        """A value in the shown unit, rounded to three figures, and its number of decimals."""
        number = float(f"{value * self.factor:.3g}")
        return number, max(0, 2 - int(np.floor(np.log10(abs(number))))) if number else 0

    def place(self, value: float) -> float:
        """The place of a value on the slider, clamped to 0 to 1."""
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


def _limits(frame: GarmentFrame) -> tuple[float | None, float | None]:
    """Max distance and backstop in a frame [m]."""
    limits = frame.limits
    return (None, None) if limits is None else (limits.max_distance, limits.backstop)


TUNABLES: dict[str, Tunable] = {
    each.name: each
    for each in (
        Tunable("rest:weftEase", "%", 1.0, lambda f: _percent(f.fabric.weft_ease), decades=False),
        Tunable("rest:warpEase", "%", 1.0, lambda f: _percent(f.fabric.warp_ease), decades=False),
        Tunable("stretchStiffness", "N/m", 1.0, lambda f: f.fabric.stretch),
        Tunable("weftStretchStiffness", "N/m", 1.0, lambda f: f.fabric.weft_stretch),
        Tunable("shearStiffness", "N/m", 1.0, lambda f: f.fabric.shear),
        Tunable("bendStiffness", "µN·m", 1e6, lambda f: f.fabric.bend),
        Tunable("weftBendStiffness", "µN·m", 1e6, lambda f: f.fabric.weft_bend),
        Tunable("density", "g/m²", 1e3, lambda f: f.fabric.density),
        Tunable("thickness", "mm", 1e3, lambda f: f.fabric.thickness),
        Tunable("stretchLimit", "%", 1.0, lambda f: _percent(f.fabric.stretch_limit), decades=False),
        Tunable("guide:stiffness", "N/m³", 1.0, lambda f: f.guide),
        Tunable("maxDistance", "mm", 1e3, lambda f: _limits(f)[0], decades=False),
        Tunable("backstop", "mm", 1e3, lambda f: _limits(f)[1], decades=False),
        Tunable("refine:detail", "", 1.0, lambda f: f.detail, decades=False),
        Tunable("contact:offset", "mm", 1e3, lambda f: f.offset),
    )
}
"""Every value that can be tuned, by the schema's short name, in the page's order."""

SAYS = {
    "rest:weftEase": "Higher: more folds, running along the warp.",
    "rest:warpEase": "Higher: more folds, running along the weft.",
    "stretchStiffness": "Lower: cloth gives way and folds less; higher: it folds.",
    "weftStretchStiffness": "Along the weft. Lower: cloth gives way and folds less.",
    "shearStiffness": "Lower: cloth drapes round shapes; higher: it buckles in slanting folds.",
    "bendStiffness": "Higher: fewer, larger folds.",
    "weftBendStiffness": "Along the weft. Higher: fewer, larger folds.",
    "density": "Higher: cloth hangs more heavily between the places that hold it.",
    "thickness": "Higher: layers and folds keep farther apart.",
    "stretchLimit": "Cloth resists far more beyond this strain.",
    "guide:stiffness": "Higher: closer to the animation, with shallower folds.",
    "maxDistance": "Lower: no place farther from the smooth animation; folds get shallower.",
    "backstop": "Lower: no place deeper inside the smooth animation.",
    "refine:detail": "Times the folds that were added; 0: a smooth surface.",
    "contact:offset": "Higher: cloth keeps farther off the bodies.",
}
"""Visible effect of each value, by the schema's short name."""

MAPS = tuple(name for name, row in GARMENT.items() if row.group == PAINTED and name != "grain")
"""The painted maps that can be seen and painted, by the schema's short names."""


def on_fine(values: np.ndarray, refinements: Sequence[Refinement]) -> np.ndarray:
    """Values of a cage's vertices on the finest, shape (V,), by the cage's subdivisions, coarsest first."""
    return reduce(lambda found, step: np.asarray(step.linear @ found), refinements, values)
