"""The codeless schemas: a table of all attributes, and the folder of the schema files.

All code reads attributes by the names in this table, and works without registered schemas.
``python -m physgraph_usd.usd.schema_files`` writes ``schemas/physgraph_usd_schemas/`` from the table. pxr is imported
for registration only.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from ..errors import UsageError
from ..solver.fabric import PRESETS, Fabric

GARMENT_API = "PhysGraphGarmentAPI"
COLLIDER_API = "PhysGraphColliderAPI"
MATERIAL_API = "PhysGraphMaterialAPI"
NAMESPACE = "physgraph:"
MATERIAL = "physgraph:material:"
AUTO_LEVEL = -1
"""Level value for automatic choice: as many subdivisions as the fabric's buckling wavelength needs."""

REFINEMENT, FABRIC, REST = "Refinement", "Fabric", "Rest Shape"
CONTACT, PAINTED, COLLISION, AIR = "Contact", "Painted Maps", "Collider", "Air"
"""Display groups."""
SIDES = ("auto", "winding", "start", "front", "back")
"""Rules for the side of a mesh on which cloth belongs.

"auto": outside of closed pieces. For an open mesh: "winding" if some pieces have an inside and most of the cloth is
outside; "front" or "back" for a floor or a wall with the cloth on one side; else the side of the coarse cloth around
each vertex.
"winding": outside of pieces closed or with openings of at most half their own area, by the generalised winding number;
for other pieces the side of the coarse cloth.
"start": the side of the coarse cloth, for every piece, closed or not.
"front", "back": the named side of the authored faces of open pieces; outside of closed pieces.
"""
PER_VERTEX = "Give one value for each vertex, or one for the whole garment."
"""End of the doc of a painted map."""
AXES = ("X", "Y", "Z", "-X", "-Y", "-Z")
"""Directions along the stage's axes."""
RETIRED = {
    "physgraph:contact:layer": "the order of layers is found in the animation, not authored",
    "physgraph:rest:creaseTime": "folds are not remembered",
}
"""Attributes of earlier versions by full name, each with the replacement."""
_JERSEY = PRESETS["jersey"]


@dataclass(frozen=True)
class Property:
    """One property of a schema.

    Attributes:
        schema: API schema of the property.
        name: Full attribute name.
        type: Sdf type name; "rel" is a relationship.
        fallback: Value used when none is given; None for a special meaning, see ``doc``. The schema files have no
            fallbacks: an ancestor, a material or ``--set`` may give the value.
        unit: SI unit, or "".
        minimum: Least allowed value, or None; for a primvar, of each element.
        maximum: Greatest allowed value, or None. Limits of fabrics include a sheet of steel; beyond the limits energies
            overflow. The stiffest preset is some hundred times the softest; paint may go a hundred times farther.
        doc: Meaning, for the schema's documentation.
        label: Display name.
        soft: Usual range for artists, for sliders; None for non-numeric properties. A value outside is accepted with a
            warning.
        uniform: Whether the property cannot be animated.
        interpolation: Interpolation of a primvar, else "".
        tokens: Allowed words of a token.
    """

    schema: str
    name: str
    type: str
    fallback: float | int | bool | str | None
    unit: str
    minimum: float | None
    maximum: float | None
    doc: str
    label: str
    group: str
    soft: tuple[float, float] | None = None
    uniform: bool = False
    interpolation: str = ""
    tokens: tuple[str, ...] = ()

    @property
    def short(self) -> str:
        """Name used in reports: without ``physgraph:`` and ``material:``."""
        return _short(self.name)


def _short(name: str) -> str:
    return name.removeprefix("primvars:").removeprefix(MATERIAL).removeprefix(NAMESPACE)


_PULL, _BEND = ("N/m", (1e-3, 1e9), (1.0, 1e4)), ("N m", (0.0, 1e5), (1e-7, 1e-2))
_FABRIC_ROWS = (
    (
        "stretchStiffness", "Stretch Stiffness", _JERSEY.stretch, *_PULL,
        "Resistance to stretching in the plane, E h: Young's modulus times thickness. Along the warp only, if the weft "
        "has its own value.",
    ),
    (
        "weftStretchStiffness", "Weft Stretch Stiffness", None, *_PULL,
        "Stretch stiffness along the weft. Without a value, the same as along the warp.",
    ),
    (
        "shearStiffness", "Shear Stiffness", None, "N/m", (0.0, 1e9), (0.1, 1e4),
        "Resistance to shear in the plane, G h: shear modulus times thickness. Without a value, 0.375 times the "
        "stretch stiffness.",
    ),
    (
        "bendStiffness", "Bending Stiffness", _JERSEY.bend, *_BEND,
        "Resistance to bending, E h^3 / 12 (1 - nu^2). Higher values make broader folds. Along the warp only, if "
        "the weft has its own value.",
    ),
    (
        "weftBendStiffness", "Weft Bending Stiffness", None, *_BEND,
        "Bending stiffness along the weft. Without a value, the same as along the warp. The solver uses at least a "
        "quarter and at most four times the value along the warp.",
    ),
    ("density", "Density", _JERSEY.density, "kg/m^2", (1e-4, 1e5), (0.01, 2.0), "Mass of the cloth per area."),
    ("thickness", "Thickness", _JERSEY.thickness, "m", (1e-6, 1.0), (1e-4, 1e-2), "Thickness of the cloth."),
)  # fmt: skip
"""Fabric values in documentation order: name, label, fallback, unit, limits, soft limits, doc."""


def _material(schema: str, fallbacks: bool) -> tuple[Property, ...]:
    """Rows of the fabric values; values missing in a material are looked up elsewhere for the garment."""
    limit = Property(
        schema, MATERIAL + "stretchLimit", "float", None, "%", 0.0, 1000.0,
        "Strain along warp or weft above which the cloth is twenty times as stiff. Without a value, there is no limit.",
        "Stretch Limit", FABRIC, (1.0, 50.0),
    )  # fmt: skip
    rows = (
        Property(
            schema,
            MATERIAL + name,
            "float",
            fallback if fallbacks else None,
            unit,
            *ends,
            doc,
            label,
            FABRIC,
            soft,
        )
        for name, label, fallback, unit, ends, soft, doc in _FABRIC_ROWS
    )
    return (*rows, limit)


def _ease(direction: str) -> Property:
    """Row of the length of cloth along warp or weft in excess of the rest shape."""
    doc = f"Extra cloth length along the {direction}, in percent of the rest shape. More length makes more folds."
    return Property(
        GARMENT_API, f"physgraph:rest:{direction}Ease", "float", 0.0, "%", -50.0, 100.0, doc,
        f"{direction.title()} Ease", REST, (0.0, 10.0),
    )  # fmt: skip


def _scale(name: str, label: str, fallback: float, *, most: float, soft: float, doc: str) -> Property:
    """Row of a painted map; artists choose values from 0 to ``soft``."""
    full = f"primvars:{NAMESPACE}{name}"
    return Property(
        GARMENT_API, full, "float[]", fallback, "", 0.0, most, doc, label, PAINTED, (0.0, soft), interpolation="vertex"
    )


PROPERTIES: tuple[Property, ...] = (
    Property(
        GARMENT_API, "physgraph:enabled", "bool", True, "", None, None, "Whether to refine this garment.",
        "Refine", REFINEMENT, uniform=True,
    ),
    Property(
        GARMENT_API, "physgraph:refine:level", "int", 2, "", -1, 5,
        "Number of subdivisions. Each makes four faces of one. -1 chooses as many as the fabric's wrinkles need.",
        "Subdivisions", REFINEMENT, (-1, 4), uniform=True,
    ),
    Property(
        GARMENT_API, "physgraph:refine:detail", "float", 1.0, "", 0.0, 2.0,
        "Strength of the added detail: 0 shows the subdivided coarse cloth, 1 the solved cloth.",
        "Detail", REFINEMENT, (0.0, 2.0),
    ),
    Property(
        GARMENT_API, "physgraph:refine:raiseBending", "bool", True, "", None, None,
        "Whether to raise the bending stiffness on a mesh with edges too long for the fabric's folds.",
        "Raise Bending", REFINEMENT, uniform=True,
    ),
    Property(
        GARMENT_API, "physgraph:gravity", "token", None, "", None, None,
        "Axis of the stage along which gravity pulls. All garments must have the same axis.",
        "Gravity", REFINEMENT, uniform=True, tokens=AXES,
    ),
    *_material(GARMENT_API, fallbacks=True),
    Property(
        GARMENT_API, "physgraph:guide:stiffness", "float", 2000.0, "N/m^3", 0.0, 1e12,
        "Stiffness of the tie between the local average of the fine cloth and the coarse animation.",
        "Guide Stiffness", REFINEMENT, (10.0, 1e6),
    ),
    Property(
        GARMENT_API, "physgraph:maxDistance", "float", None, "m", 0.0, 1000.0,
        "Largest distance of the refined cloth from the subdivided animation, in any direction. Held in every frame. "
        "Without a value, there is no limit.",
        "Max Distance", REFINEMENT, (0.0, 0.1),
    ),
    Property(
        GARMENT_API, "physgraph:backstop", "float", None, "m", 0.0, 1000.0,
        "Largest distance of the refined cloth from the subdivided animation inwards, against its normals. Held in "
        "every frame. Without a value, there is no limit.",
        "Backstop", REFINEMENT, (0.0, 0.1),
    ),
    Property(
        GARMENT_API, "physgraph:inertia", "float", 1.0, "", 0.0, 1.0,
        "Share of the animation's acceleration beyond gravity that the cloth feels. 0 leaves it out.",
        "Inertia", REFINEMENT, (0.0, 1.0),
    ),
    Property(
        GARMENT_API, "physgraph:pressure", "float", 0.0, "Pa", -1e4, 1e4,
        "Pressure of the air inside the garment over the pressure outside. It acts along the surface's normals.",
        "Pressure", AIR, (-20.0, 20.0),
    ),
    Property(
        GARMENT_API, "physgraph:wind:speed", "float", 0.0, "m/s", 0.0, 100.0,
        "Mean speed of the wind. 0 is calm air.", "Wind Speed", AIR, (0.0, 15.0),
    ),
    Property(
        GARMENT_API, "physgraph:wind:heading", "float", 0.0, "degrees", -360.0, 360.0,
        "Direction in which the wind blows, turned about the up axis. 0 is along the stage's +X, or +Y where X is up.",
        "Wind Heading", AIR, (-180.0, 180.0),
    ),
    Property(
        GARMENT_API, "physgraph:wind:turbulence", "float", 0.0, "", 0.0, 2.0,
        "Strength of the gusts over the mean speed of the wind.", "Wind Turbulence", AIR, (0.0, 1.0),
    ),
    _ease("warp"),
    _ease("weft"),
    Property(
        GARMENT_API, "physgraph:contact:offset", "float", 0.002, "m", 0.0, 10.0,
        "Distance that the cloth keeps from colliders.", "Contact Offset", CONTACT, (1e-4, 3e-2),
    ),
    Property(
        GARMENT_API, "physgraph:contact:selfCollision", "bool", True, "", None, None,
        "Whether the garment collides with itself.", "Self-Collision", CONTACT, uniform=True,
    ),
    Property(
        GARMENT_API, "physgraph:colliders", "rel", None, "", None, None,
        "Colliders of this garment. If empty, every collider on the stage.", "Colliders", CONTACT,
    ),
    Property(
        GARMENT_API, "physgraph:contact:exclude", "rel", None, "", None, None,
        "Colliders and garments that this garment does not collide with: the prims, their ancestors, or collections.",
        "Excluded Prims", CONTACT,
    ),
    Property(
        GARMENT_API, "physgraph:bind:targets", "rel", None, "", None, None,
        "Meshes, curves, points and instancers that follow the refined cloth, such as render meshes and buttons.",
        "Bound Prims", REFINEMENT,
    ),
    Property(
        GARMENT_API, "physgraph:shell:thickness", "float", 0.0, "m", 0.0, 1.0,
        "Thickness of the closed shell that is written instead of the refined sheet. 0 writes the sheet.",
        "Shell Thickness", REFINEMENT, (0.0, 0.01), uniform=True,
    ),
    Property(
        GARMENT_API, "physgraph:seam:tolerance", "float", 0.0, "m", 0.0, 1.0,
        "Largest distance between open borders that are sewn together. 0 sews only borders at the same place.",
        "Seam Tolerance", REST, (0.0, 5e-3), uniform=True,
    ),
    _scale(
        "stretchScale", "Stretch Stiffness Scale", 1.0, most=1e4, soft=10.0,
        doc="Painted multiplier of the stretch stiffness. " + PER_VERTEX,
    ),
    _scale(
        "bendScale", "Bending Stiffness Scale", 1.0, most=1e4, soft=10.0,
        doc="Painted multiplier of the bending stiffness. " + PER_VERTEX,
    ),
    _scale(
        "detailScale", "Detail Scale", 1.0, most=10.0, soft=2.0,
        doc="Painted multiplier of the added detail. " + PER_VERTEX,
    ),
    _scale(
        "guideScale", "Guide Stiffness Scale", 1.0, most=1e4, soft=10.0,
        doc="Painted multiplier of the guide stiffness. " + PER_VERTEX,
    ),
    _scale(
        "maxDistanceScale", "Max Distance Scale", 1.0, most=1.0, soft=1.0,
        doc="Painted multiplier of the max distance. 0 keeps the cloth on the subdivided animation. " + PER_VERTEX,
    ),
    _scale(
        "backstopScale", "Backstop Scale", 1.0, most=1.0, soft=1.0,
        doc="Painted multiplier of the backstop. " + PER_VERTEX,
    ),
    _scale(
        "easeScale", "Ease Scale", 1.0, most=100.0, soft=10.0,
        doc="Painted multiplier of the ease. " + PER_VERTEX,
    ),
    Property(
        GARMENT_API, "primvars:physgraph:gather", "float[]", 0.0, "%", -50.0, 400.0,
        "Painted extra cloth length along the weft, in percent of the rest shape, as at a gathered seam. " + PER_VERTEX,
        "Gather", PAINTED, (0.0, 100.0), interpolation="vertex",
    ),
    Property(
        GARMENT_API, "primvars:physgraph:grain", "float[]", 0.0, "degrees", -360.0, 360.0,
        "Painted direction of the warp: angle, counter-clockwise on the face, from the v axis of the texture "
        "coordinates. If the texture coordinates are not a sewing pattern, the angle is from straight down. "
        + PER_VERTEX,
        "Grain", PAINTED, (-90.0, 90.0), interpolation="vertex",
    ),
    _scale(
        "pin", "Pin", 0.0, most=1.0, soft=1.0,
        doc="1 at vertices that follow the coarse cloth exactly, 0 at free vertices, between 0 and 1 for soft pins. "
        + PER_VERTEX,
    ),
    Property(
        COLLIDER_API, "physgraph:collider:enabled", "bool", True, "", None, None,
        "Whether garments collide with this prim. Without a value, they do while the prim is visible.",
        "Collide", COLLISION, uniform=True,
    ),
    Property(
        COLLIDER_API, "physgraph:collider:offset", "float", 0.0, "m", 0.0, 10.0,
        "Distance from this collider in addition to the garment's contact offset.",
        "Collider Offset", COLLISION, (0.0, 3e-2),
    ),
    Property(
        COLLIDER_API, "physgraph:collider:side", "token", "auto", "", None, None,
        "Side of the surface on which cloth belongs. auto: outside of closed parts; for open parts, chosen by their "
        "shape and by the coarse cloth. winding: outside by the winding number. start: the side of the coarse cloth. "
        "front, back: this side of the faces of open parts.",
        "Side", COLLISION, uniform=True, tokens=SIDES,
    ),
    *_material(MATERIAL_API, fallbacks=False),
)  # fmt: skip
"""All properties of the three schemas, in documentation order."""

GARMENT: dict[str, Property] = {row.short: row for row in PROPERTIES if row.schema == GARMENT_API}
"""Rows of the garment schema by short name."""
COLLIDER: dict[str, Property] = {row.short: row for row in PROPERTIES if row.schema == COLLIDER_API}
"""Rows of the collider schema by short name."""


def fabric_values(fabric: Fabric) -> dict[str, float]:
    """Values of a fabric by the schema's short names, without unset values."""
    return {name: value for name, value in every_fabric_value(fabric).items() if value is not None}


def every_fabric_value(fabric: Fabric) -> dict[str, float | None]:
    """Values of a fabric by the schema's short names, None for unset values."""
    return {
        "stretchStiffness": fabric.stretch,
        "weftStretchStiffness": fabric.weft_stretch,
        "shearStiffness": fabric.shear,
        "bendStiffness": fabric.bend,
        "weftBendStiffness": fabric.weft_bend,
        "density": fabric.density,
        "thickness": fabric.thickness,
        "stretchLimit": None if fabric.stretch_limit is None else 100.0 * fabric.stretch_limit,
        "rest:warpEase": 100.0 * fabric.warp_ease or None,
        "rest:weftEase": 100.0 * fabric.weft_ease or None,
    }


def find_property(text: str) -> Property:
    """Find a garment's or collider's property by full name, without ``physgraph:`` and ``material:``, or by last word.

    Raises:
        UsageError: When the name is unknown, retired or ambiguous; the message lists the names.
    """
    rows = GARMENT | COLLIDER
    for row in rows.values():
        if text in {row.name, row.name.removeprefix(NAMESPACE), row.short}:
            return row
    # "stiffness" is the last word of the guide's only, but a fabric has three stiffnesses.
    meant = [row for row in rows.values() if row.short.lower().endswith(text.lower())]
    if len(meant) == 1 and meant[0].name.rsplit(":", 1)[-1] == text:
        return meant[0]
    if len(meant) > 1:
        raise UsageError(f"attribute {text!r} may mean {', '.join(row.short for row in meant)}; write one of them out")
    for name, instead in RETIRED.items():
        if text in {name, name.removeprefix(NAMESPACE), name.rpartition(":")[2]}:
            raise UsageError(f"{name} is no attribute any more: {instead}; leave it out")
    near = nearest_property(text, rows.values())
    hint = f"did you mean {near.short}? " if near else ""
    raise UsageError(f"unknown attribute {text!r}; {hint}known attributes: {', '.join(sorted(rows))}")


def nearest_property(text: str, rows: Iterable[Property]) -> Property | None:
    """The property with the short name spelt most like a text; None without a similar name."""
    by_name = {row.short: row for row in rows}
    return next((by_name[name] for name in get_close_matches(_short(text), by_name, n=1)), None)


def schema_path() -> Path:
    """Folder of plugInfo.json, for PXR_PLUGINPATH_NAME: in the installed package or next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "schemas"
    return inside if (inside / "plugInfo.json").exists() else package.parent / "schemas" / "physgraph_usd_schemas"


def register() -> None:
    """Register the schemas with USD; no effect if already known, or once any typed prim definition was read."""
    from pxr import Plug  # noqa: PLC0415  the table must be readable where pxr is missing

    registry = Plug.Registry()
    if not registry.GetPluginWithName("physgraph"):
        registry.RegisterPlugins(str(schema_path()))
