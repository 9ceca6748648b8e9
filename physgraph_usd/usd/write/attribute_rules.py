"""One table of the attributes that a refined layer writes, blocks or turns off; docs/layers.md is made from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

from pxr import Sdf, Usd, UsdGeom

from ..stage import Notice
from .stream import LayerStream

ANEW, EMPTIED, BLOCKED, OFF, CARRIED = "anew", "emptied", "blocked", "off", "refined"
"""Computed from the fine mesh; an empty array; hidden with its samples; a value that does nothing; one value for each
fine element, from the coarse values."""
PREFIX = "primvars:"


@dataclass(frozen=True)
class Rule:
    """A rule for attributes.

    Attributes:
        names: Patterns of names, as ``fnmatch`` has them.
        action: One of the actions above.
        reason: How or why, in docs/layers.md and in a note of the run.
        noted: Whether a note of the run says it.
        number: Value of a number that is off.
    """

    names: tuple[str, ...]
    action: str
    reason: str = ""
    noted: bool = False
    number: int = 0


RULES = (
    Rule(("faceVertex*", "points", "normals", "extent", "velocities"), ANEW),
    Rule(("subdivisionScheme",), ANEW, "none"),
    Rule(("holeIndices", "crease[ILS]*", "corner[IS]*"), EMPTIED),
    Rule(("accelerations", f"{PREFIX}velocities", f"{PREFIX}accelerations", f"{PREFIX}normals"), BLOCKED),
    Rule(
        (f"{PREFIX}tangent", f"{PREFIX}tangent[suv]", f"{PREFIX}bitangent*", f"{PREFIX}binormal*"),
        BLOCKED,
        "renderers make them from normals and UVs",
        noted=True,
    ),
    Rule((f"{PREFIX}skel:joint*", "skel:joints", "skel:blendShapes"), BLOCKED, "skinned already"),
    Rule(
        ("*arnold:subdiv_*", "*moonray:is_subd", "*redshift:*rstess_enable", "*:*subdiv*"),
        OFF,
        "subdivided already",
        noted=True,
    ),
    Rule(("*moonray:mesh_resolution",), OFF, "subdivided already", noted=True, number=1),
    Rule((f"{PREFIX}*", "physics:restShapePoints"), CARRIED, "words and integers copied, constants kept"),
)
"""Rules in order of precedence; attributes without a rule stay as authored."""


def rule_of(name: str) -> Rule | None:
    """First rule that matches an attribute's name; None for attributes that stay as authored."""
    fits = (rule for rule in RULES if any(fnmatchcase(name.lower(), pattern.lower()) for pattern in rule.names))
    return next(fits, None)


def action_on(attribute: Usd.Attribute) -> str:
    """Action on an attribute; "" for an attribute that stays as authored."""
    rule = rule_of(attribute.GetName())
    return "" if rule is None or (rule.action == OFF and attribute.GetTypeName().isArray) else rule.action


def with_action(prim: Usd.Prim, action: str) -> list[Usd.Attribute]:
    """The authored attributes of a prim with one action."""
    own = (attribute for attribute in prim.GetAuthoredAttributes() if attribute.HasAuthoredValue())
    return [each for each in own if action_on(each) == action]


def values_off(prim: Usd.Prim) -> Iterator[tuple[Usd.Attribute, object]]:
    """Attributes and inherited primvars of a garment that must be off, each with the value that turns it off."""
    inherited = [each.GetAttr() for each in UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance()]
    for attribute in {each.GetName(): each for each in [*inherited, *with_action(prim, OFF)]}.values():
        rule = rule_of(attribute.GetName())
        if rule is not None and action_on(attribute) == OFF:
            default = attribute.GetTypeName().defaultValue
            yield attribute, "none" if isinstance(default, str) else type(default)(rule.number)


def turn_off(stream: LayerStream, target: Sdf.Path, prim: Usd.Prim) -> None:
    """Author values that keep renderers from subdividing the fine mesh; a block would let an ancestor's value in."""
    for attribute, value in values_off(prim):
        path = target.AppendProperty(attribute.GetName())
        stream.attribute(path, attribute.GetTypeName(), interpolation=UsdGeom.Tokens.constant)
        stream.set(path, value)


def notes_of(prim: Usd.Prim) -> list[Notice]:
    """A note for each rule that is noted, with the names of the attributes of a coarse mesh."""
    attributes = [*(attribute for attribute, _ in values_off(prim)), *with_action(prim, BLOCKED)]
    found: dict[Rule, list[str]] = {}
    for name in (attribute.GetName() for attribute in attributes):
        rule = rule_of(name)
        if rule is not None and rule.noted:
            found.setdefault(rule, []).append(name)
    path = str(prim.GetPath())
    return [Notice(path, None, f"{', '.join(names)}: {_words(rule)}") for rule, names in found.items()]


def _words(rule: Rule) -> str:
    return f"{rule.action}: {rule.reason}" if rule.reason else rule.action


def rules_table() -> str:
    """All rules, as a table in Markdown."""
    rows = ((" ".join(f"`{name}`" for name in rule.names), _words(rule)) for rule in RULES)
    return "| attribute | in the layer |\n|---|---|\n" + "".join(f"| {names} | {what} |\n" for names, what in rows)
