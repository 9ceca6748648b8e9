"""The table of attributes written, blocked, lowered or turned off in a refined layer; shown in docs/layers.md."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

from pxr import Sdf, Usd, UsdGeom

from ..stage import Notice
from .stream import LayerStream

ANEW, EMPTIED, BLOCKED, CARRIED = "anew", "emptied", "blocked", "refined"
"""Computed from the fine mesh; an empty array; hidden with its samples; one value for each fine element, from coarse
values."""
LOWERED, OFF = "lowered", "off"
"""A renderer's number of subdivisions, less those of the layer, and off where the scheme is none; and other settings of
its subdivision, off where the scheme is none and kept elsewhere."""
PREFIX = "primvars:"
REST_POINTS = ("physics:restShapePoints", "omniphysics:restShapePoints")
"""Rest shape by AOUSD's proposal, and by NVIDIA's schemas of the same."""


@dataclass(frozen=True)
class Rule:
    """A rule for attributes.

    Attributes:
        names: Patterns of names, as ``fnmatch`` has them.
        action: One of the actions above.
        reason: How or why, in docs/layers.md and in a note of the run.
        noted: Whether a note of the run says it.
        number: Value of a number that is off; with 1, the number counts parts of an edge, and a subdivision halves it.
    """

    names: tuple[str, ...]
    action: str
    reason: str = ""
    noted: bool = False
    number: int = 0


RULES = (
    Rule(("faceVertex*", "points", "extent", "velocities"), ANEW),
    Rule(("subdivisionScheme",), ANEW, "as the cage's, loop for triangles and catmullClark for others, or none"),
    Rule(
        ("crease[ILS]*", "corner[IS]*"),
        ANEW,
        "sharpness less the layer's subdivisions; emptied where the scheme is none",
    ),
    Rule(("normals",), BLOCKED, "the scheme makes them; anew where it is none"),
    Rule(("holeIndices",), EMPTIED, "faces that are holes are left out"),
    Rule(("accelerations", f"{PREFIX}velocities", f"{PREFIX}accelerations", f"{PREFIX}normals"), BLOCKED),
    Rule(
        (f"{PREFIX}tangent", f"{PREFIX}tangent[suv]", f"{PREFIX}bitangent*", f"{PREFIX}binormal*"),
        BLOCKED,
        "renderers make them from normals and UVs",
        noted=True,
    ),
    Rule((f"{PREFIX}skel:joint*", "skel:joints", "skel:blendShapes"), BLOCKED, "skinned already"),
    Rule(
        ("*:*subdiv*iterations*", "*:*subdiv*level*", "*:*max*subd*"),
        LOWERED,
        "less the layer's subdivisions; off where the scheme is none",
        noted=True,
    ),
    Rule(
        ("*moonray:mesh_resolution",),
        LOWERED,
        "halved by each of the layer's subdivisions; off where the scheme is none",
        noted=True,
        number=1,
    ),
    Rule(
        ("*arnold:subdiv_*", "*moonray:is_subd", "*redshift:*rstess_enable", "*:*subdiv*"),
        OFF,
        "where the scheme is none; else kept",
        noted=True,
    ),
    Rule(
        (f"{PREFIX}*", *REST_POINTS),
        CARRIED,
        "words and integers copied, constants kept",
    ),
)
"""Rules in order of precedence; attributes without a rule stay as authored."""


def rule_of(name: str) -> Rule | None:
    """First rule matching an attribute's name; None for attributes kept as authored."""
    fits = (rule for rule in RULES if any(fnmatchcase(name.lower(), pattern.lower()) for pattern in rule.names))
    return next(fits, None)


def action_on(attribute: Usd.Attribute) -> str:
    """Action on an attribute; "" for an attribute that stays as authored."""
    rule = rule_of(attribute.GetName())
    return "" if rule is None or (rule.action in (LOWERED, OFF) and attribute.GetTypeName().isArray) else rule.action


def with_action(prim: Usd.Prim, action: str) -> list[Usd.Attribute]:
    """The authored attributes of a prim with one action."""
    attributes = (attribute for attribute in prim.GetAuthoredAttributes() if attribute.HasAuthoredValue())
    return [attribute for attribute in attributes if action_on(attribute) == action]


def render_values(prim: Usd.Prim, levels: int | None) -> Iterator[tuple[Usd.Attribute, object]]:
    """Attributes and inherited primvars that make renderers subdivide a garment too far, each with the right value.

    Args:
        prim: The coarse mesh.
        levels: Number of subdivisions of the layer; None where the scheme is none, and renderers must not subdivide.
    """
    inherited = [primvar.GetAttr() for primvar in UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance()]
    authored = [*inherited, *with_action(prim, LOWERED), *with_action(prim, OFF)]
    for attribute in {item.GetName(): item for item in authored}.values():
        rule, action = rule_of(attribute.GetName()), action_on(attribute)
        if rule is None or action not in (LOWERED, OFF):
            continue
        default, value = attribute.GetTypeName().defaultValue, attribute.Get(Usd.TimeCode.EarliestTime())
        if levels is None:
            yield attribute, "none" if isinstance(default, str) else type(default)(rule.number)
        elif action == LOWERED and isinstance(value, int | float) and not isinstance(value, bool):
            fewer = value // 2**levels if rule.number else value - levels
            yield attribute, type(value)(max(fewer, rule.number))


def limit_renderers(stream: LayerStream, target: Sdf.Path, prim: Usd.Prim, levels: int | None) -> None:
    """Author the values of `render_values`; a block would let an ancestor's value in."""
    for attribute, value in render_values(prim, levels):
        path = target.AppendProperty(attribute.GetName())
        stream.attribute(path, attribute.GetTypeName(), interpolation=UsdGeom.Tokens.constant)
        stream.set(path, value)


def notes_of(prim: Usd.Prim, levels: int | None) -> list[Notice]:
    """A note for each rule that is noted, with the names of the attributes of a coarse mesh; as `render_values`."""
    attributes = [*(attribute for attribute, _ in render_values(prim, levels)), *with_action(prim, BLOCKED)]
    names_of: dict[Rule, list[str]] = {}
    for name in (attribute.GetName() for attribute in attributes):
        rule = rule_of(name)
        if rule is not None and rule.noted:
            names_of.setdefault(rule, []).append(name)
    path = str(prim.GetPath())
    return [Notice(path, None, f"{', '.join(names)}: {_words(rule)}") for rule, names in names_of.items()]


def _words(rule: Rule) -> str:
    return f"{rule.action}: {rule.reason}" if rule.reason else rule.action


def rules_table() -> str:
    """All rules, as a table in Markdown."""
    rows = ((" ".join(f"`{name}`" for name in rule.names), _words(rule)) for rule in RULES)
    return "| attribute | in the layer |\n|---|---|\n" + "".join(f"| {names} | {action} |\n" for names, action in rows)
