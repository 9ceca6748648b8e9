"""Reads a garment's fabric at a time code, and the source of each value.

After ``--set``, the garment, its ancestors and the ``physgraph:material:`` values of the bound materials come the
values of the deformable-body proposal for UsdPhysics (AOUSD PR #111, commit 63c74d79); the schema's fallbacks are last.

In the proposal a stiffness is authored on the material (``physics:surfaceStretchStiffness`` and similar), or derived
from Young's modulus E, Poisson's ratio nu and the thickness h of the mesh:

    stretch = E h,   shear = E h / (2 (1 + nu)),   bend = E h^3 / (12 (1 - nu^2))

The proposal writes stretch = E h / (1 - nu^2), for a strip with fixed width; ours is for a free strip.

Stiffnesses are derived if the material authors E or nu, or has ``PhysicsSurfaceDeformableMaterialAPI``; missing values
are then the proposal's fallbacks: 1e6 Pa, 0.3, 1 mm, 1000 kg/m^3. -inf means a missing value, and so does a density of
0.

All are in stage units. With m = metersPerUnit and M = kilogramsPerUnit, SI values are: stretch and shear
M v [N/m], bending M m^2 v [N m], E M/m v [Pa], volumetric density M/m^3 v [kg/m^3], thickness m v [m].
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import SchemaError
from ...solver.fabric import Fabric
from ..lookup import (
    Found,
    Override,
    authored,
    bound_materials,
    check_limits,
    find_value,
    read_number,
    source_name,
)
from ..schema import GARMENT, Property
from ..stage import Notice, Units, first_value

STIFFNESSES = {
    "stretchStiffness": "physics:surfaceStretchStiffness",
    "shearStiffness": "physics:surfaceShearStiffness",
    "bendStiffness": "physics:surfaceBendStiffness",
}
"""Attributes of the proposal's material by our short names."""
_WOVEN = ("weftStretchStiffness", "weftBendStiffness", "stretchLimit")
_EASE = ("rest:warpEase", "rest:weftEase")
_FRAME_VALUES = (
    *(*STIFFNESSES, *_WOVEN, "density", "thickness", *_EASE),
    *("guide:stiffness", "refine:detail", "inertia", "contact:offset"),
    *("pressure", "wind:speed", "wind:heading", "wind:turbulence"),
    *("maxDistance", "backstop"),
)
DENSITY = "physics:density"
YOUNGS = "physics:youngsModulus"
POISSONS = "physics:poissonsRatio"
THICKNESSES = "physics:thicknesses"
OLD_THICKNESS = "physics:surfaceThickness"
"""Thickness on the material, before the proposal moved the thickness to the mesh."""
ON_MATERIAL = (*STIFFNESSES.values(), DENSITY, YOUNGS, POISSONS, OLD_THICKNESS)
"""All attributes read from a material."""
Thickness = tuple[Found, np.ndarray | None, tuple[Notice, ...]]
"""The mean, the thickness at each point over the mean, shape (V,), or None if constant, and notices."""
_API = "PhysicsSurfaceDeformableMaterialAPI"
_YOUNGS_FALLBACK, _POISSONS_FALLBACK, _DENSITY_FALLBACK = 1e6, 0.3, 1000.0


@dataclass(frozen=True, eq=False)
class Values:
    """All values of a garment allowed to change from frame to frame.

    Attributes:
        found: Source of each value, by short name.
        volumetric: Whether the density is per volume, to be multiplied by the thickness.
        thickness: Thickness at each point over the mean, shape (V,), if stiffnesses depend on the thickness; else None.
        notices: Warnings about the values.
    """

    found: dict[str, Found]
    volumetric: bool
    thickness: np.ndarray | None = None
    notices: tuple[Notice, ...] = ()

    @property
    def sources(self) -> dict[str, str]:
        """The source of each value in words, by short name."""
        return {name: value.source for name, value in self.found.items()}

    @property
    def animated(self) -> frozenset[str]:
        """Short names of the values with an animated source."""
        return frozenset(name for name, value in self.found.items() if value.animated)

    def fabric(self, time: float | None) -> Fabric:
        """Fabric at a time code, SI; SchemaError for an invalid value."""
        stretch, bend, thickness, density = (
            self.number(name, time) for name in ("stretchStiffness", "bendStiffness", "thickness", "density")
        )
        density *= thickness if self.volumetric else 1.0
        shear, weft_stretch, weft_bend, limit = (self.found[name].at(time) for name in ("shearStiffness", *_WOVEN))
        warp_ease, weft_ease = (self.number(name, time) / 100.0 for name in _EASE)
        limit = None if limit is None else limit / 100.0
        return Fabric(
            *(stretch, bend, density, thickness, shear, weft_stretch, weft_bend),
            stretch_limit=limit,
            warp_ease=warp_ease,
            weft_ease=weft_ease,
        )

    def thickness_scale(self, name: str) -> np.ndarray | float:
        """Factor of a stiffness at each point, shape (V,), if derived from the thickness, else 1.

        The painted stretch multiplier also scales shear: the factor is used if both are derived from the thickness.
        """
        names = ("bendStiffness",) if name == "bendStiffness" else ("stretchStiffness", "shearStiffness")
        if self.thickness is None or not all(self.found[short].compute for short in names):
            return 1.0
        return self.thickness ** (3 if name == "bendStiffness" else 1)

    def number(self, name: str, time: float | None) -> float:
        """A value at a time code, by short name; 0 if unset."""
        return float(self.found[name].at(time) or 0.0)


def find_values(prim: Usd.Prim, units: Units, overrides: Sequence[Override]) -> Values:
    """Find the source of every fabric value, the guide's stiffness and the detail's gain.

    Values given by neither the garment nor the garment's materials come from the materials of most faces.
    """
    return values_by(prim, prim, _materials_of_most(prim), units=units, overrides=overrides)


def _materials_of_most(prim: Usd.Prim) -> list[Usd.Prim]:
    """Materials bound to a garment, then materials bound to most of the garment's faces by subsets."""
    bound, counts = bound_materials(prim), Counter[tuple[Usd.Prim, ...]]()
    uncovered = len(first_value(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr()) or ())
    for subset in UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(prim), UsdGeom.Tokens.face):
        subset_materials = tuple(material for material in bound_materials(subset.GetPrim()) if material not in bound)
        size = len(subset.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime()) or ()) if subset_materials else 0
        counts[subset_materials] += size
        uncovered -= size
    most, count = counts.most_common(1)[0] if counts else ((), 0)
    return [*bound, *(most if count > uncovered else ())]


def values_by(
    prim: Usd.Prim, mesh: Usd.Prim, materials: Sequence[Usd.Prim], *, units: Units, overrides: Sequence[Override] = ()
) -> Values:
    """Fabric values of a garment or a subset of faces; the first material with a value gives the value."""
    values_by_name = {name: find_value(prim, GARMENT[name], overrides, materials=materials) for name in _FRAME_VALUES}
    open_rows = [name for name in _FRAME_VALUES if values_by_name[name].source == "fallback"]
    relative, notices = None, ()
    if "thickness" in open_rows and (thick := read_thickness(mesh, materials, GARMENT["thickness"], units=units)):
        values_by_name["thickness"], relative, notices = thick
    for name in STIFFNESSES:
        if name in open_rows:
            values_by_name[name] = (
                stiffness(materials, GARMENT[name], values_by_name["thickness"], units=units) or values_by_name[name]
            )
    volume = density(materials, GARMENT["density"], units) if "density" in open_rows else None
    if volume is not None:
        values_by_name["density"] = volume
    return Values(values_by_name, volume is not None, relative, notices)


def has_value(attribute: Usd.Attribute | None) -> bool:
    """Whether an attribute gives a value: the proposal uses -inf for none."""
    return attribute is not None and read_number(attribute, None) != -math.inf


def stiffness(materials: Sequence[Usd.Prim], row: Property, thickness: Found, *, units: Units) -> Found | None:
    """A stiffness authored on a material, or derived from its Young's modulus; None without either."""
    scale = units.kilograms * (units.metres**2 if row.short == "bendStiffness" else 1.0)
    for material in materials:
        attribute = authored(material, STIFFNESSES[row.short])
        if attribute is not None and has_value(attribute):
            return Found(row, source_name(attribute), attribute, None, scale)
        if is_elastic(material):
            return _from_youngs(material, row, thickness, units=units)
    return None


def density(materials: Sequence[Usd.Prim], row: Property, units: Units) -> Found | None:
    """Density per volume given by a material [kg/m^3], or None."""
    for material in materials:
        attribute = authored(material, DENSITY)
        if attribute is not None and has_value(attribute) and read_number(attribute, None) != 0:
            return Found(row, source_name(attribute), attribute, None, units.kilograms / units.metres**3)
    elastic = next(filter(is_elastic, materials), None)
    source = f"<{elastic.GetPath()}>: fallback of {DENSITY}, {_DENSITY_FALLBACK:g} kg/m^3" if elastic else ""
    return Found(row, source, None, _DENSITY_FALLBACK) if elastic else None


def read_thickness(prim: Usd.Prim, materials: Sequence[Usd.Prim], row: Property, *, units: Units) -> Thickness | None:
    """Thickness on the mesh, or by its older name on the material; None without either, SchemaError for a bad value."""
    on_mesh = authored(prim, THICKNESSES)
    if on_mesh is not None and np.size(on_mesh.Get(Usd.TimeCode.EarliestTime())):
        return _on_mesh(prim, on_mesh, row, units=units)
    for material in materials:
        old = authored(material, OLD_THICKNESS)
        if old is not None and read_number(old, None) > 0:
            message = f"{OLD_THICKNESS} is the proposal's older name; author {THICKNESSES} on <{prim.GetPath()}>"
            notice = Notice(str(material.GetPath()), None, message)
            return Found(row, source_name(old), old, None, units.metres), None, (notice,)
    return None


def is_elastic(material: Usd.Prim) -> bool:
    """Whether unauthored stiffnesses of a material are derived from its Young's modulus, authored or not."""
    schemas = material.GetMetadata("apiSchemas")
    named = schemas.GetAddedOrExplicitItems() if isinstance(schemas, Sdf.TokenListOp) else []
    return _API in named or any(has_value(authored(material, name)) for name in (YOUNGS, POISSONS))


def _from_youngs(material: Usd.Prim, row: Property, thickness: Found, *, units: Units) -> Found:
    """A stiffness by the formulas at the top of this file."""
    attributes = (authored(material, YOUNGS), authored(material, POISSONS))
    modulus, ratio = (attribute if has_value(attribute) else None for attribute in attributes)
    per_pascal = units.kilograms / units.metres

    def compute(time: float | None) -> float:
        youngs = read_number(modulus, time) * per_pascal if modulus is not None else _YOUNGS_FALLBACK
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

    source = source_name(modulus) if modulus is not None else f"<{material.GetPath()}>: fallback of {YOUNGS}, 1e6 Pa"
    animated = thickness.animated or any(
        attribute.ValueMightBeTimeVarying() for attribute in (modulus, ratio) if attribute
    )
    return Found(row, f"{source}, with the thickness", compute=compute, varies=animated)


def _on_mesh(prim: Usd.Prim, attribute: Usd.Attribute, row: Property, *, units: Units) -> Thickness:
    code, source = Usd.TimeCode.EarliestTime(), source_name(attribute)
    values = np.asarray(attribute.Get(code))
    if values.ndim != 1 or not np.issubdtype(values.dtype, np.number):
        raise SchemaError(f"{source} is {attribute.GetTypeName()}; author float[]")
    values = values.astype(np.float64)
    mesh = UsdGeom.Mesh(prim)
    topology = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    counts, indices = (np.asarray(first_value(attribute)) for attribute in topology)
    count = len(first_value(mesh.GetPointsAttr()) or ())
    element = prim.GetAttribute(f"{THICKNESSES}:elementType").Get()
    expected = {"constant": 1, "face": len(counts), "point": count}.get(str(element))
    if len(values) != expected:
        message = f"{len(values)} values, and {THICKNESSES}:elementType is {element!r}"
        message += f", which takes {expected or 'none'}; author constant (one), face or point"
        raise SchemaError(f"{source} has {message}")
    for index in (int(values.argmin()), int(values.argmax())):
        check_limits(row, float(values[index]) * units.metres, f"{source}[{index}]")
    mean = float(values.mean())
    result = Found(row, source if len(values) == 1 else f"{source}, mean of {len(values)}", None, mean * units.metres)
    if values.min() == values.max():
        return result, None, ()
    if element == "face":
        faces = np.bincount(indices, minlength=count)
        sums = np.bincount(indices, np.repeat(values, counts), minlength=count)
        values = np.divide(sums, faces, out=np.full(count, mean), where=faces > 0)
    low, high = 1e3 * values.min() * units.metres, 1e3 * values.max() * units.metres
    message = f"{THICKNESSES} goes from {low:.3g} to {high:.3g} mm: stiffnesses derived from {YOUNGS} follow it,"
    notice = Notice(str(prim.GetPath()), None, f"{message} contact and mass take the mean")
    return result, values / mean, (notice,)
