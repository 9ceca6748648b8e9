"""A garment's fabric at a time, and who gave each value.

After ``--set``, the garment, its ancestors and the ``physgraph:material:`` values of the bound materials come those of
the deformable-body proposal for UsdPhysics, which `deformable` reads; the table's fallbacks come last.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from ...errors import SchemaError
from ...solver.fabric import Fabric
from ..lookup import (
    Found,
    Override,
    authored,
    bound_materials,
    check_limits,
    find_value,
    nearest,
    read_number,
    source_name,
)
from ..schema import GARMENT, Property
from ..stage import Notice, Units

STIFFNESSES = {
    "stretchStiffness": "physics:surfaceStretchStiffness",
    "shearStiffness": "physics:surfaceShearStiffness",
    "bendStiffness": "physics:surfaceBendStiffness",
}
"""Attributes of the proposal's material by the short names of ours."""
_FRAME_VALUES = (*STIFFNESSES, "density", "thickness", "guide:stiffness", "refine:detail", "contact:offset")
DENSITY = "physics:density"
YOUNGS = "physics:youngsModulus"
POISSONS = "physics:poissonsRatio"
THICKNESSES = "physics:thicknesses"
OLD_THICKNESS = "physics:surfaceThickness"
"""On the material, before the thickness moved to the mesh."""
ON_MATERIAL = (*STIFFNESSES.values(), DENSITY, YOUNGS, POISSONS, OLD_THICKNESS)
"""Every attribute that is read from a material."""
_API = "PhysicsSurfaceDeformableMaterialAPI"
_YOUNGS_FALLBACK, _POISSONS_FALLBACK, _DENSITY_FALLBACK = 1e6, 0.3, 1000.0


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


@dataclass(frozen=True, eq=False)
class Derived:
    """A value computed from others; has the interface of `Found`.

    Attributes:
        row: The attribute of ours that it stands for.
        source: Who gives it, for the report.
        compute: SI value at a time code.
        animated: Whether one of the others is animated.
    """

    row: Property
    source: str
    compute: Callable[[float | None], float]
    animated: bool = False

    def at(self, time: float | None) -> float:
        """Value in SI at a time code.

        Raises:
            SchemaError: When it cannot be used.
        """
        return check_limits(self.row, self.compute(time), self.source)


@dataclass(frozen=True, eq=False)
class Thickness:
    """Thickness that the mesh or its material gives.

    Attributes:
        found: The mean.
        relative: Thickness at each point over the mean, shape (V,); None when it is the same everywhere.
        notices: What was odd.
    """

    found: Found
    relative: np.ndarray | None = None
    notices: tuple[Notice, ...] = ()


def given(attribute: Usd.Attribute | None) -> bool:
    """Whether an attribute gives a value: -inf is the proposal's word for none."""
    return attribute is not None and read_number(attribute, None) != -math.inf


def stiffness(
    materials: Sequence[Usd.Prim], row: Property, thickness: Found | Derived, *, units: Units
) -> Found | Derived | None:
    """A stiffness that a material authors, or that follows from its Young's modulus; None when there is neither."""
    scale = units.kilograms * (units.metres**2 if row.short == "bendStiffness" else 1.0)
    for material in materials:
        own = authored(material, STIFFNESSES[row.short])
        if own is not None and given(own):
            return Found(row, source_name(own), own, None, scale)
        if is_elastic(material):
            return _from_youngs(material, row, thickness, units=units)
    return None


def density(materials: Sequence[Usd.Prim], row: Property, units: Units) -> Found | None:
    """Density per volume that a material gives [kg/m^3], or None."""
    for material in materials:
        own = authored(material, DENSITY)
        if own is not None and given(own) and read_number(own, None) != 0:
            return Found(row, source_name(own), own, None, units.kilograms / units.metres**3)
    elastic = next(filter(is_elastic, materials), None)
    source = f"<{elastic.GetPath()}>: fallback of {DENSITY}, {_DENSITY_FALLBACK:g} kg/m^3" if elastic else ""
    return Found(row, source, None, _DENSITY_FALLBACK) if elastic else None


def read_thickness(prim: Usd.Prim, materials: Sequence[Usd.Prim], row: Property, *, units: Units) -> Thickness | None:
    """Thickness on the mesh, or by its older name on the material; None when there is neither.

    Raises:
        SchemaError: When the array does not fit its elementType, or holds what is no thickness.
    """
    on_mesh = authored(prim, THICKNESSES)
    if on_mesh is not None and np.size(on_mesh.Get(Usd.TimeCode.EarliestTime())):
        return _on_mesh(prim, on_mesh, row, units=units)
    for material in materials:
        old = authored(material, OLD_THICKNESS)
        if old is not None and read_number(old, None) > 0:
            message = f"{OLD_THICKNESS} is the proposal's older name; author {THICKNESSES} on <{prim.GetPath()}>"
            notice = Notice(str(material.GetPath()), None, message)
            return Thickness(Found(row, source_name(old), old, None, units.metres), None, (notice,))
    return None


def is_elastic(material: Usd.Prim) -> bool:
    """Whether stiffnesses that a material does not author follow from its Young's modulus, authored or not."""
    schemas = material.GetMetadata("apiSchemas")
    named = schemas.GetAddedOrExplicitItems() if isinstance(schemas, Sdf.TokenListOp) else []
    return _API in named or any(given(authored(material, name)) for name in (YOUNGS, POISSONS))


def _from_youngs(material: Usd.Prim, row: Property, thickness: Found | Derived, *, units: Units) -> Derived:
    """A stiffness by the formulas at the top of this file."""
    own, ratio = (each if given(each) else None for each in (authored(material, YOUNGS), authored(material, POISSONS)))
    per_pascal = units.kilograms / units.metres

    def compute(time: float | None) -> float:
        youngs = read_number(own, time) * per_pascal if own is not None else _YOUNGS_FALLBACK
        nu = read_number(ratio, time) if ratio is not None else _POISSONS_FALLBACK
        if not (0.0 <= youngs < math.inf and -1.0 < nu <= 0.5):
            message = f"{YOUNGS} is {youngs:g} Pa and {POISSONS} {nu:g}; they must be in [0, inf) and (-1, 0.5]"
            raise SchemaError(f"<{material.GetPath()}>: {message}")
        sheet = youngs * float(thickness.at(time) or 0.0)
        if row.short == "shearStiffness":
            return sheet / (2 * (1 + nu))
        if row.short == "bendStiffness":
            return sheet * float(thickness.at(time) or 0.0) ** 2 / (12 * (1 - nu**2))
        return sheet

    source = source_name(own) if own is not None else f"<{material.GetPath()}>: fallback of {YOUNGS}, 1e6 Pa"
    animated = thickness.animated or any(each.ValueMightBeTimeVarying() for each in (own, ratio) if each is not None)
    return Derived(row, f"{source}, with the thickness", compute, animated)


def _on_mesh(prim: Usd.Prim, attribute: Usd.Attribute, row: Property, *, units: Units) -> Thickness:
    """Thickness from the array on a mesh."""
    code, where = Usd.TimeCode.EarliestTime(), source_name(attribute)
    values = np.asarray(attribute.Get(code))
    if values.ndim != 1 or not np.issubdtype(values.dtype, np.number):
        raise SchemaError(f"{where} is {attribute.GetTypeName()}; author float[]")
    values = values.astype(np.float64)
    counts, indices = (np.asarray(a.Get(code)) for a in _topology(prim))
    count = len(UsdGeom.Mesh(prim).GetPointsAttr().Get(code) or ())
    element = prim.GetAttribute(f"{THICKNESSES}:elementType").Get()
    expected = {"constant": 1, "face": len(counts), "point": count}.get(str(element))
    if len(values) != expected:
        message = (
            f"{len(values)} values, and {THICKNESSES}:elementType is {element!r}, which takes {expected or 'none'}"
        )
        raise SchemaError(f"{where} has {message}; author constant (one), face or point")
    for index in (int(values.argmin()), int(values.argmax())):
        check_limits(row, float(values[index]) * units.metres, f"{where}[{index}]")
    mean = float(values.mean())
    found = Found(row, where if len(values) == 1 else f"{where}, mean of {len(values)}", None, mean * units.metres)
    if values.min() == values.max():
        return Thickness(found)
    if element == "face":
        faces = np.bincount(indices, minlength=count)
        sums = np.bincount(indices, np.repeat(values, counts), minlength=count)
        values = np.divide(sums, faces, out=np.full(count, mean), where=faces > 0)
    low, high = 1e3 * values.min() * units.metres, 1e3 * values.max() * units.metres
    message = f"{THICKNESSES} goes from {low:.3g} to {high:.3g} mm: stiffnesses derived from {YOUNGS} follow it,"
    notice = Notice(str(prim.GetPath()), None, f"{message} contact and mass take the mean")
    return Thickness(found, values / mean, (notice,))


def _topology(prim: Usd.Prim) -> tuple[Usd.Attribute, Usd.Attribute]:
    mesh = UsdGeom.Mesh(prim)
    return mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()


def rest_angle_notices(prim: Usd.Prim) -> list[Notice]:
    """Tell of older words in ``physics:restBendAnglesDefault``."""
    attribute = nearest(prim, "physics:restBendAnglesDefault")
    value = str(attribute.Get()) if attribute is not None else ""
    new = {"restShapeDefault": "restShape", "flatDefault": "flat"}.get(value)
    message = f"physics:restBendAnglesDefault is {value!r}, the proposal's older name; author {new!r}"
    return [Notice(str(attribute.GetPrim().GetPath()), None, message)] if attribute is not None and new else []
