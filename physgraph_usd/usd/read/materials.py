"""A garment's fabric at a time, and who gave each value.

After ``--set``, the garment, its ancestors and the ``physgraph:material:`` values of the bound materials come those of
the deformable-body proposal for UsdPhysics, which `deformable` reads; the table's fallbacks come last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from ...solver.fabric import Fabric
from ..lookup import Found, Override, bound_materials, find_value
from ..schema import GARMENT
from ..stage import Notice, Units
from .deformable import STIFFNESSES, Derived, density, read_thickness, stiffness

_FRAME_VALUES = (*STIFFNESSES, "density", "thickness", "guide:stiffness", "refine:detail", "contact:offset")


@dataclass(frozen=True, eq=False)
class Values:
    """Every value of a garment that may change from frame to frame.

    Attributes:
        found: Source of each value, by short name.
        volumetric: Whether the density is per volume, to be multiplied by the thickness.
        thickness: Thickness at each point over the mean, shape (V,), where stiffnesses follow it; else None.
        notices: What was odd.
    """

    found: dict[str, Found | Derived]
    volumetric: bool
    thickness: np.ndarray | None = None
    notices: tuple[Notice, ...] = ()

    @property
    def sources(self) -> dict[str, str]:
        """Who gives each value, by short name."""
        return {name: found.source for name, found in self.found.items()}

    @property
    def animated(self) -> frozenset[str]:
        """Short names of the values whose source is animated."""
        return frozenset(name for name, found in self.found.items() if found.animated)

    def fabric(self, time: float | None) -> Fabric:
        """Fabric at a time code, SI.

        Raises:
            SchemaError: When a value cannot be used.
        """
        stretch, bend, thickness, density = (
            self.number(name, time) for name in ("stretchStiffness", "bendStiffness", "thickness", "density")
        )
        density *= thickness if self.volumetric else 1.0
        return Fabric(stretch, bend, density, thickness, self.found["shearStiffness"].at(time))

    def thickness_scale(self, name: str) -> np.ndarray | float:
        """Factor of a stiffness at each point where it follows the thickness there, shape (V,), else 1.

        The painted multiplier of stretching is shear's too: it follows the thickness where both do.
        """
        names = ("bendStiffness",) if name == "bendStiffness" else ("stretchStiffness", "shearStiffness")
        if self.thickness is None or not all(isinstance(self.found[each], Derived) for each in names):
            return 1.0
        return self.thickness ** (3 if name == "bendStiffness" else 1)

    def number(self, name: str, time: float | None) -> float:
        """Any other value at a time code, by short name."""
        return float(self.found[name].at(time) or 0.0)


def find_values(prim: Usd.Prim, units: Units, overrides: Sequence[Override]) -> Values:
    """Find the source of every fabric value, the guide's stiffness and the detail's gain."""
    materials = bound_materials(prim)
    found: dict[str, Found | Derived] = {name: find_value(prim, GARMENT[name], overrides) for name in _FRAME_VALUES}
    open_rows = [name for name in _FRAME_VALUES if found[name].source == "fallback"]
    thick = read_thickness(prim, materials, GARMENT["thickness"], units=units) if "thickness" in open_rows else None
    if thick is not None:
        found["thickness"] = thick.found
    for name in STIFFNESSES:
        given = stiffness(materials, GARMENT[name], found["thickness"], units=units) if name in open_rows else None
        found[name] = given or found[name]
    volume = density(materials, GARMENT["density"], units) if "density" in open_rows else None
    if volume is not None:
        found["density"] = volume
    return Values(
        found,
        volumetric=volume is not None,
        thickness=thick.relative if thick else None,
        notices=thick.notices if thick else (),
    )


def is_collision_prim(prim: Usd.Prim) -> bool:
    """Whether UsdPhysics makes a prim collide."""
    collision = UsdPhysics.CollisionAPI(prim)
    return bool(collision) and bool(UsdGeom.Imageable(prim)) and collision.GetCollisionEnabledAttr().Get() is not False
