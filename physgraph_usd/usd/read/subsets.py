"""Reads a garment's subsets of faces, and how their fabrics differ from the garment's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom

from ...errors import counted
from ...solver.fabric import Fabric
from ..lookup import authored, bound_materials
from ..schema import GARMENT, every_fabric_value
from ..stage import Units
from .materials import Values, find_values, values_by

SCALED = {"stretchStiffness": "stretch", "bendStiffness": "bend", "density": "density"}
"""Values with a multiplier on each face, and their fields in a fabric."""
_ROUNDING = 1e-6
"""Relative difference up to which two values are equal: attributes are in single precision."""


@dataclass(frozen=True, eq=False)
class Subsets:
    """A garment's subsets of faces, with the subsets' differing fabrics.

    Attributes:
        faces: Faces of the cage in each subset, by name.
        scale: Multipliers of stretch, bending and density on each face of the cage, shape (F, 3); None if all are 1.
        words: How each subset of another fabric differs from the garment, in words, by name; "" are other faces.
        sources: Source of each of their values, as "bendStiffness of leather".
    """

    faces: dict[str, np.ndarray]
    scale: np.ndarray | None
    words: dict[str, str]
    sources: dict[str, str]


def read_subsets(prim: Usd.Prim, cage_faces: np.ndarray, *, units: Units, time: float | None) -> Subsets:
    """Read a garment's subsets, and compare the subsets' fabrics with the garment's.

    Fabrics are compared without ``--set``, which changes all in proportion.

    Args:
        prim: The garment.
        cage_faces: Authored face of each face of the cage, shape (F,).
        units: The stage's units.
        time: Time code at which values are read; the multipliers are constant.

    Raises:
        SchemaError: A value is invalid.
    """
    subsets = {}
    for subset in UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(prim), UsdGeom.Tokens.face):
        faces = subset.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime())
        members = np.isin(cage_faces, [] if faces is None else np.asarray(faces))
        subsets[subset.GetPrim().GetName()] = np.flatnonzero(members)
    return Subsets(subsets, *_fabrics(prim, subsets, len(cage_faces), units=units, time=time))


def _fabrics(
    prim: Usd.Prim, subsets: Mapping[str, np.ndarray], count: int, *, units: Units, time: float | None
) -> tuple[np.ndarray | None, dict[str, str], dict[str, str]]:
    """`Subsets.scale`, ``words`` and ``sources`` of a garment with a number of faces."""
    whole_fabric, scale, words, sources = find_values(prim, units, ()), np.ones((count, 3)), {}, {}
    fabric = whole_fabric.fabric(time)
    for name, faces, values in _parts(prim, subsets, count, units):
        differing = [
            short for short in every_fabric_value(fabric) if values.sources[short] != whole_fabric.sources[short]
        ]
        if differing and len(faces):
            subset_fabric = values.fabric(time)
            scale[faces] = ratios = [
                _ratio(getattr(subset_fabric, short), getattr(fabric, short)) for short in SCALED.values()
            ]
            animated = [short for short in differing if values.found[short].animated]
            suffix = "" if name else " of no such subset"
            words[name] = (
                f"{counted(len(faces), 'face')}{suffix} of another fabric: {_in_words(fabric, subset_fabric, ratios)}"
            )
            words[name] += f"; {', '.join(animated)} as at the first time code" if animated else ""
            sources |= {f"{short} of {name or 'other faces'}": values.sources[short] for short in differing}
    return scale if (scale != 1.0).any() else None, words, sources


def _parts(
    prim: Usd.Prim, subsets: Mapping[str, np.ndarray], count: int, units: Units
) -> Iterator[tuple[str, np.ndarray, Values]]:
    """Name, faces and values of each subset with a separate material or values, then of all remaining faces."""
    bound, is_outside = bound_materials(prim), np.ones(count, bool)
    for name, faces in subsets.items():
        subset = prim.GetChild(name)
        materials = bound_materials(subset)
        if {*materials} - {*bound} or any(
            authored(subset, GARMENT[short].name) for short in every_fabric_value(Fabric())
        ):
            is_outside[faces] = False
            yield name, faces, values_by(subset, prim, [*materials, *bound], units=units)
    if not is_outside.all():
        yield "", np.flatnonzero(is_outside), values_by(prim, prim, bound, units=units)


def _ratio(value: float, whole_value: float) -> float:
    """A subset's value over the garment's; 1 where the garment has none to multiply."""
    return 1.0 if whole_value <= 0.0 or math.isclose(value, whole_value, rel_tol=_ROUNDING) else value / whole_value


def _in_words(fabric: Fabric, subset_fabric: Fabric, ratios: list[float]) -> str:
    """Multiples of the garment's stretch, bending and density, and the unused values, in words."""
    stretch, bend, density = ratios
    shear, weft_stretch = (None if ratio is None else stretch * ratio for ratio in (fabric.shear, fabric.weft_stretch))
    scaled = replace(
        fabric,
        stretch=stretch * fabric.stretch,
        shear=shear,
        weft_stretch=weft_stretch,
        bend=bend * fabric.bend,
        weft_bend=None if fabric.weft_bend is None else bend * fabric.weft_bend,
        density=density * fabric.density,
    )
    used, wanted = every_fabric_value(scaled), every_fabric_value(subset_fabric)
    unused = [name for name in used if not math.isclose(used[name] or 0.0, wanted[name] or 0.0, rel_tol=_ROUNDING)]
    times = [f"{name} times {ratio:.3g}" for name, ratio in zip(SCALED, ratios, strict=True) if ratio != 1.0]
    return ", ".join(times or ["none of its values differ"]) + (
        f"; not used: its {', '.join(unused)}" if unused else ""
    )
