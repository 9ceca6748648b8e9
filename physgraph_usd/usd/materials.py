"""A garment's fabric at a time, and who gave each value.

After the ``physgraph:material:`` values of the bound materials come those of the deformable-body proposal for
UsdPhysics (``physics:surfaceStretchStiffness`` and its relatives), which are in stage units. With m = metersPerUnit and
M = kilogramsPerUnit, their SI values are: stretch and shear M v [N/m], bending M m^2 v [N m], volumetric density
M/m^3 v [kg/m^3], thickness m v [m].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pxr import Usd, UsdGeom, UsdPhysics

from ..fabric import Fabric
from .lookup import Found, Override, authored, bound_materials, find_value, read_number, source_name
from .schema import GARMENT, Property
from .stage import Units

PROPOSAL = {
    "stretchStiffness": "physics:surfaceStretchStiffness",
    "shearStiffness": "physics:surfaceShearStiffness",
    "bendStiffness": "physics:surfaceBendStiffness",
    "density": "physics:density",
    "thickness": "physics:surfaceThickness",
}
"""Attributes of the UsdPhysics proposal by the short names of ours."""
_FRAME_VALUES = (*PROPOSAL, "guide:stiffness", "refine:detail", "contact:offset")


@dataclass(frozen=True, eq=False)
class Values:
    """Every value of a garment that may change from frame to frame.

    Attributes:
        found: Source of each value, by short name.
        volumetric: Whether the density is per volume, to be multiplied by the thickness.
    """

    found: dict[str, Found]
    volumetric: bool

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

    def number(self, name: str, time: float | None) -> float:
        """Any other value at a time code, by short name."""
        return float(self.found[name].at(time) or 0.0)


def find_values(prim: Usd.Prim, units: Units, overrides: Sequence[Override]) -> Values:
    """Find the source of every fabric value, the guide's stiffness and the detail's gain."""
    materials = bound_materials(prim)
    found = {name: find_value(prim, GARMENT[name], overrides) for name in _FRAME_VALUES}
    given = {
        name: _from_proposal(materials, GARMENT[name], units) for name in PROPOSAL if found[name].source == "fallback"
    }
    proposed = {name: value for name, value in given.items() if value is not None}
    return Values(found | proposed, volumetric="density" in proposed)


def _from_proposal(materials: Sequence[Usd.Prim], row: Property, units: Units) -> Found | None:
    """Take a value from a material of the UsdPhysics proposal; there zero means that it is not given."""
    metres, kilograms = units.metres, units.kilograms
    scale = {"bendStiffness": kilograms * metres**2, "density": kilograms / metres**3, "thickness": metres}
    for material in materials:
        attribute = authored(material, PROPOSAL[row.short])
        if attribute is not None and read_number(attribute, None) > 0:
            return Found(row, source_name(attribute), attribute, None, scale.get(row.short, kilograms))
    return None


def is_collision_prim(prim: Usd.Prim) -> bool:
    """Whether UsdPhysics makes a prim collide."""
    collision = UsdPhysics.CollisionAPI(prim)
    return bool(collision) and bool(UsdGeom.Imageable(prim)) and collision.GetCollisionEnabledAttr().Get() is not False
