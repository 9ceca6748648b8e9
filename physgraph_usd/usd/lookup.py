"""Looks up values at ``--set``, the prim, its ancestors, the bound material, the fallback.

Any numeric type is accepted, and Blender's ``userProperties:`` namespace: a round trip through a host program changes
both and moves the attribute to the parent transform.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from ..errors import SchemaError, UsageError
from ..solver.fabric import PRESETS
from .schema import AUTO_LEVEL, COLLIDER, GARMENT, MATERIAL, Property, every_fabric_value, find_property
from .stage import at_time, in_brief, timecode

_OVERRIDE = re.compile(r"^(?:<?(?P<prim>/[^<>=.]*)>?\.)?(?P<name>[A-Za-z_][\w:]*)=(?P<value>.*)$")
_WORDS = {"true": 1.0, "on": 1.0, "yes": 1.0, "false": 0.0, "off": 0.0, "no": 0.0}
USER_PROPERTIES = "userProperties:"
"""Blender's namespace for exported custom properties."""
PRESET = "preset"
"""Name by which ``--set`` takes the values of a preset, as in ``preset=denim``."""
_OWN = ("thickness", "rest:warpEase", "rest:weftEase")
"""Garment values kept under a preset that has no thickness or ease."""


@dataclass(frozen=True)
class Override:
    """One ``--set``.

    Attributes:
        prim: Prim path at or above the affected garments or colliders; "/" means all.
        value: The value; None for a value that a preset leaves unset.
    """

    prim: Sdf.Path
    row: Property
    value: float | str | None


@dataclass(frozen=True, eq=False)
class Found:
    """A value and its source.

    Attributes:
        source: The source in words, for the report.
        attribute: The authored attribute, or None for a constant.
        constant: The value when there is no attribute; None without any value.
        scale: Factor from the stage's number to SI.
        compute: For a derived value, the SI value at a time code; else None.
        varies: Whether an input of a derived value is animated.
    """

    row: Property
    source: str
    attribute: Usd.Attribute | None = None
    constant: float | None = None
    scale: float = 1.0
    compute: Callable[[float | None], float] | None = None
    varies: bool = False

    @property
    def animated(self) -> bool:
        """Whether the source has more than one sample."""
        return self.varies or (self.attribute is not None and self.attribute.ValueMightBeTimeVarying())

    def at(self, time: float | None) -> float | None:
        """Value in SI at a time code, None without a value; SchemaError for a wrong type or a value beyond limits."""
        if self.compute is not None:
            return check_limits(self.row, self.compute(time), self.source)
        if self.attribute is None:
            return self.constant
        source = self.source + (at_time(time) if self.animated else "")
        return check_limits(self.row, read_number(self.attribute, time) * self.scale, source)


def check_known(kind: str, word: object, choices: Collection[object]) -> None:
    """Refuse (UsageError) an unknown word; the message lists the known words in order."""
    if word not in choices:
        raise UsageError(f"unknown {kind} '{word}'; known {kind}s: {', '.join(map(str, choices))}")


def parse_overrides(texts: Sequence[str]) -> tuple[Override, ...]:
    """Read ``</prim>.attribute=value`` or ``attribute=value`` texts; UsageError names an invalid text.

    `PRESET` stands for the values of a fabric.
    """
    return tuple(override for text in texts for override in _parse_override(text))


def _parse_override(text: str) -> list[Override]:
    match = _OVERRIDE.match(text.strip())
    if match is None:
        raise UsageError(f"cannot read {text!r}; write </prim>.attribute=value or attribute=value")
    prim, word = Sdf.Path(match["prim"] or "/"), match["value"].strip().lower()
    if match["name"] == PRESET:
        check_known(PRESET, word, sorted(PRESETS))
        values = [(GARMENT[name], value) for name, value in every_fabric_value(PRESETS[word]).items()]
        return [Override(prim, row, v) for row, v in values if row.short not in _OWN or v not in (None, row.fallback)]
    row = find_property(match["name"])
    if row.type == "rel" or (row.type == "token" and row is not COLLIDER["collider:side"]):
        raise UsageError(f"{row.name} is not a single number; author it on the prim")
    try:
        if row.type == "token":
            return [Override(prim, row, check_token(row, word, text))]
        words = _WORDS | ({"auto": AUTO_LEVEL} if row is GARMENT["refine:level"] else {})
        value = words[word] if word in words else float(word)
        if row is GARMENT["gather"] and 0.0 < abs(value) < 1.0:
            raise ValueError(f"it is in percent; write {row.short}={100.0 * value:g} for {value:g} times the length")
        return [Override(prim, row, check_limits(row, value, text))]
    except (ValueError, SchemaError) as error:
        raise UsageError(f"cannot use {text!r}: {error}") from error


def check_overrides(
    overrides: Sequence[Override], garments: Sequence[Sdf.Path], colliders: Sequence[Sdf.Path] = ()
) -> None:
    """Refuse an override without a matching garment or collider; UsageError lists the known paths."""
    for override in overrides:
        kind, paths = ("collider", colliders) if override.row.short in COLLIDER else ("garment", garments)
        if not any(path.HasPrefix(override.prim) for path in paths):
            listed = ", ".join(map(str, paths)) or "none"
            raise UsageError(f"--set {override.prim}.{override.row.name}: no such {kind}; {kind}s: {listed}")


def family_of(subset: UsdGeom.Subset) -> str:
    """Name of a subset's family; "" for none, and for a value of another type."""
    name = subset.GetFamilyNameAttr().Get()
    return name if isinstance(name, str) else ""


def with_ancestors(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Iterate over a prim and its ancestors, nearest first, without the pseudo-root."""
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def authored(prim: Usd.Prim, name: str) -> Usd.Attribute | None:
    """Return the attribute for a prim's value, under the name or Blender's variant of the name.

    The attribute is the prim's own, or the source of its connection, as for a material's interface.
    """
    for full in (name, USER_PROPERTIES + name):
        attribute = prim.GetAttribute(full)
        attribute = connected(attribute) or attribute
        if attribute and attribute.HasAuthoredValue():
            return attribute
    return None


def connected(attribute: Usd.Attribute) -> Usd.Attribute | None:
    """Return the source attribute of a single, one-step connection if the source has a value, else None."""
    sources = attribute.GetConnections() if attribute else []
    source = attribute.GetStage().GetAttributeAtPath(sources[0]) if len(sources) == 1 else None
    return source if source and source.HasAuthoredValue() and not source.HasAuthoredConnections() else None


def nearest(prim: Usd.Prim, name: str) -> Usd.Attribute | None:
    """Return the authored attribute on the prim or the nearest ancestor."""
    return next((attribute for ancestor in with_ancestors(prim) if (attribute := authored(ancestor, name))), None)


def bound_materials(prim: Usd.Prim) -> tuple[Usd.Prim, ...]:
    """Materials bound to a prim, the physics purpose first, without repeats."""
    binding = UsdShade.MaterialBindingAPI(prim)
    materials: list[Usd.Prim] = []
    for purpose in ("physics", UsdShade.Tokens.allPurpose):
        material = binding.ComputeBoundMaterial(purpose)[0]
        if material and material.GetPrim() not in materials:
            materials.append(material.GetPrim())
    return tuple(materials)


def find_value(
    prim: Usd.Prim, row: Property, overrides: Sequence[Override] = (), *, materials: Sequence[Usd.Prim] | None = None
) -> Found:
    """Find the source of a garment's or a collider's value: ``--set``, a prim, or else the fallback as a constant.

    Materials count for ``physgraph:material:`` values only; None: those bound to the prim.
    """
    override = _override(prim, row, overrides)
    if override is not None:
        return Found(row, "--set", None, None if override.value is None else float(override.value))
    attribute = nearest(prim, row.name)
    if attribute is None and row.name.startswith(MATERIAL):
        materials = bound_materials(prim) if materials is None else materials
        attribute = next(
            (material_value for material in materials if (material_value := authored(material, row.name))), None
        )
    if attribute is not None:
        return Found(row, source_name(attribute), attribute)
    return Found(row, "fallback", None, None if row.fallback is None else float(row.fallback))


def _override(prim: Usd.Prim, row: Property, overrides: Sequence[Override]) -> Override | None:
    """The ``--set`` nearest to a prim for an attribute, the last if several name the same prim; None without any."""
    matching = [
        override for override in overrides if override.row.name == row.name and prim.GetPath().HasPrefix(override.prim)
    ]
    return max(reversed(matching), key=lambda override: override.prim.pathElementCount, default=None)


def find_token(prim: Usd.Prim, row: Property, overrides: Sequence[Override] = ()) -> tuple[str, str]:
    """Token from ``--set``, the prim, its nearest ancestor, or the fallback, and the source in words.

    Raises:
        SchemaError: The value is not among the row's tokens.
    """
    override = _override(prim, row, overrides)
    if override is not None:
        return str(override.value), "--set"
    attribute = nearest(prim, row.name)
    if attribute is None:
        return str(row.fallback or ""), "fallback"
    return check_token(row, attribute.Get(), source_name(attribute)), source_name(attribute)


def check_token(row: Property, value: object, source: str) -> str:
    """Return a token if valid for the row; SchemaError gives value, source and choices."""
    if value not in row.tokens:
        raise SchemaError(f"{source} is {value!r}; it must be one of {', '.join(row.tokens)}")
    return str(value)


def source_name(attribute: Usd.Attribute) -> str:
    """An attribute's name in reports: ``</prim>.name``."""
    return f"<{attribute.GetPrim().GetPath()}>.{attribute.GetName()}"


def read_number(attribute: Usd.Attribute, time: float | None) -> float:
    """Read an attribute of any numeric type; SchemaError for a value of another type."""
    code = timecode(time)
    resolved = attribute.GetResolveInfo(code).GetSource()
    if resolved in {Usd.ResolveInfoSourceNone, Usd.ResolveInfoSourceFallback}:  # The attribute has samples only.
        code = Usd.TimeCode.EarliestTime()
    value = attribute.Get(code)
    if value is None:
        raise SchemaError(f"{source_name(attribute)}{at_time(time)} is blocked; author a value there, or none at all")
    if not isinstance(value, bool | int | float):
        kind = attribute.GetTypeName()
        raise SchemaError(f"{source_name(attribute)} is {in_brief(value)} of type {kind}; a single number is needed")
    return float(value)


def check_limits(row: Property, value: float, source: str) -> float:
    """Return a finite value within the row's limits; SchemaError gives value, source and limits."""
    with np.errstate(over="ignore"):
        finite = np.isfinite(np.float32(value))
    if not (finite and is_within(value, row.minimum, row.maximum)):
        low = -math.inf if row.minimum is None else row.minimum
        high = math.inf if row.maximum is None else row.maximum
        allowed = f"[{low:g}, {high:g}]" + (f" {row.unit}" if row.unit else "")
        allowed += "" if row.fallback is not None else ", or left out"
        raise SchemaError(f"{source}: {row.name} is {value:.7g}; it must be finite and in {allowed}")
    if row.type == "int" and value != round(value):
        raise SchemaError(f"{source}: {row.name} is {value:g}; it must be a whole number")
    return value


def is_within(value: float, low: float | None, high: float | None) -> bool:
    """Whether a value is inside limits, compared in float32, the precision of the schema's attributes."""
    with np.errstate(over="ignore"):
        single = np.float32(value)
    return bool(np.float32(-np.inf if low is None else low) <= single <= np.float32(np.inf if high is None else high))


def is_on(prim: Usd.Prim, row: Property, overrides: Sequence[Override] = ()) -> bool:
    """Value of a boolean attribute."""
    return bool(find_value(prim, row, overrides).at(None))
