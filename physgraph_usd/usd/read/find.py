"""Finds garments and colliders of a stage by applied schema, path, name, glob or collection, and pairs for contact."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Iterator, Sequence

from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from ...errors import AbsentError, GarmentError, SchemaError, StageError
from ..lookup import Override, find_token, find_value, is_on, with_ancestors
from ..schema import COLLIDER, COLLIDER_API, GARMENT, GARMENT_API
from ..stage import TRAVERSAL, Notice, Units, list_meshes

GRAVITY_OPTION = "--gravity"
"""Source of gravity set by the option."""
_COLLECTION = ".collection:"
_LOD_ROOT = "LODRootAPI"
"""Schema of a prim whose children are levels of detail, since USD 26.8."""
_COLLIDERS_RELATIONSHIP = "physgraph:colliders"
_SHOWN = 20
MARKS = (GARMENT_API, COLLIDER_API, "PhysicsCollisionAPI")
"""Schemas that, on a prim or an ancestor, decide about contact with cloth."""
EXCLUDE = "physgraph:contact:exclude"
Kinds = tuple[type, ...]
"""Classes of UsdGeom."""
BODIES: Kinds = (UsdGeom.Gprim, UsdGeom.PointInstancer)
"""Prims that can be colliders."""


def has_schema(prim: Usd.Prim, name: str) -> bool:
    """Whether an API schema is applied, registered or not."""
    return name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


def find_garments(stage: Usd.Stage, wanted: Sequence[str] = ()) -> list[Usd.Prim]:
    """Find the meshes to refine, in stage order, including meshes inside instances.

    Args:
        wanted: Prim paths (a transform stands for the meshes drawn below), prim names, globs over paths, or collections
            (``/Prim.collection:name``); empty: every mesh with PhysGraphGarmentAPI.

    Raises:
        AbsentError: When an item is not found; the message lists the stage's meshes.
        StageError: When nothing is named and nothing found.
    """
    if wanted:
        chosen = {path for item in wanted for path in find_paths(stage, item, (UsdGeom.Mesh,))}
        return [prim for prim in traverse(stage) if prim.GetPath() in chosen]
    garments = [prim for prim in traverse(stage) if has_schema(prim, GARMENT_API) and not _hidden_level(prim)]
    if not garments:
        raise StageError(
            f"no prim has {GARMENT_API} and no garment was named; --garment PATH names one, and inspect proposes some; "
            + _mesh_list(stage)
        )
    for prim in garments:
        if not UsdGeom.Mesh(prim):
            kind = prim.GetTypeName() or "prim without a type"
            remedy = "apply the schema to the meshes themselves"
            raise GarmentError(str(prim.GetPath()), f"has {GARMENT_API} but is a {kind}, not a Mesh", remedy=remedy)
    return garments


def find_colliders(
    stage: Usd.Stage,
    garments: Sequence[Usd.Prim],
    wanted: Sequence[str] = (),
    *,
    without: Sequence[Sdf.Path] = (),
    overrides: Sequence[Override] = (),
) -> list[Usd.Prim]:
    """Find the gprims and point instancers garments may collide with, in stage order.

    Invisible prims are included because they may be visible at different times; inactive and disabled prims are not.

    Args:
        garments: The garments; never colliders.
        wanted: As for ``find_garments``; empty: the targets of the garments' ``physgraph:colliders``, and for garments
            without targets every prim with PhysGraphColliderAPI or UsdPhysics' CollisionAPI.
        without: Prims that are never colliders, beside the garments.

    Raises:
        AbsentError: When a named collider does not exist.
    """
    felt = (
        [_colliders_named(stage, wanted, overrides)]
        if wanted
        else felt_by(stage, garments, overrides=overrides).values()
    )
    chosen = {path for paths in felt for path in paths} - {*without, *(prim.GetPath() for prim in garments)}
    return [prim for prim in traverse(stage) if prim.GetPath() in chosen]


def felt_by(
    stage: Usd.Stage,
    garments: Sequence[Usd.Prim],
    wanted: Sequence[str] = (),
    *,
    overrides: Sequence[Override] = (),
) -> dict[Sdf.Path, frozenset[Sdf.Path]]:
    """Paths of the bodies felt by each garment, by its path; arguments as for ``find_colliders``.

    Raises:
        AbsentError: When a collider in ``wanted`` does not exist.
        StageError: When a target of the garment's ``physgraph:colliders`` does not exist.
    """
    paths_of: dict[tuple[str, ...], frozenset[Sdf.Path]] = {}  # Many garments name the same colliders, or none.
    felt: dict[Sdf.Path, frozenset[Sdf.Path]] = {}
    for garment in garments:
        named = tuple(wanted or map(str, targets_of(garment, _COLLIDERS_RELATIONSHIP)))
        if named not in paths_of:
            try:
                paths_of[named] = _colliders_named(stage, named, overrides)
            except AbsentError as error:
                if wanted:
                    raise
                raise StageError(f"<{garment.GetPath()}>.{_COLLIDERS_RELATIONSHIP}: {error}") from error
        felt[garment.GetPath()] = paths_of[named]
    return felt


def _colliders_named(stage: Usd.Stage, named: Sequence[str], overrides: Sequence[Override]) -> frozenset[Sdf.Path]:
    """Named gprims, or else all colliders of the stage, without disabled gprims."""
    enabled = COLLIDER["collider:enabled"]
    marked = _named_or_marked(stage, named)
    return frozenset(path for path in marked if is_on(stage.GetPrimAtPath(path), enabled, overrides))


def _named_or_marked(stage: Usd.Stage, named: Sequence[str]) -> list[Sdf.Path]:
    """Named gprims, or else all colliders of the stage."""
    if named:
        return list(dict.fromkeys(path for item in named for path in find_paths(stage, item, BODIES)))
    marked = (prim for prim in traverse(stage) if _collides(prim) and not _hidden_level(prim))
    return [body.GetPath() for prim in marked for body in _drawn(_below(prim, BODIES))]


def purpose_notices(prims: Iterable[Usd.Prim], named: Sequence[str]) -> list[Notice]:
    """Notices of garments and colliders invisible in final renders, unless marked or named themselves."""
    notices = []
    for prim in prims:
        by_itself = {str(prim.GetPath()), prim.GetName()} & {*named}
        marked = any(has_schema(prim, mark) for mark in MARKS)
        if (reason := why_not_drawn(prim)) and not (by_itself or marked):
            message = f"no final render shows it, {reason}; it is taken, for what was named holds nothing else"
            notices.append(Notice(str(prim.GetPath()), None, message))
    return notices


def disabled_colliders(
    stage: Usd.Stage, garments: Sequence[Usd.Prim], wanted: Sequence[str], *, overrides: Sequence[Override]
) -> dict[Usd.Prim, Notice]:
    """Gprims named or marked as colliders but disabled, each with a notice of the disabling attribute.

    Arguments are those of `find_colliders`.
    """
    row, disabled = COLLIDER["collider:enabled"], {}
    for path in _named_or_marked(stage, [*wanted] or colliders_of(garments)):
        prim = stage.GetPrimAtPath(path)
        enabled = find_value(prim, row, overrides)
        if not enabled.at(None):
            disabled[prim] = Notice(str(path), None, f"no collider, for {row.name} is off, by {enabled.source}")
    return disabled


def colliders_of(garments: Sequence[Usd.Prim]) -> list[str]:
    """Target paths of the garments' ``physgraph:colliders``."""
    return [str(path) for prim in garments for path in targets_of(prim, _COLLIDERS_RELATIONSHIP)]


def is_drawn(prim: Usd.Prim) -> bool:
    """Whether a final render shows a prim by its purpose, default or render, and by its level of detail."""
    return not why_not_drawn(prim)


def why_not_drawn(prim: Usd.Prim) -> str:
    """The kind of a prim that no final render shows, such as "a proxy"; "" for a prim shown."""
    purpose = UsdGeom.Imageable(prim).ComputePurpose()
    return _hidden_level(prim) if purpose in {UsdGeom.Tokens.default_, UsdGeom.Tokens.render} else f"a {purpose}"


def _hidden_level(prim: Usd.Prim) -> str:
    """A level of detail that is not shown and holds a prim, in words; "" without any."""
    for level in with_ancestors(prim):
        root = level.GetParent()
        if root and has_schema(root, _LOD_ROOT) and level != shown_level(root):
            return f"a level of detail of <{root.GetPath()}> that is not shown"
    return ""


def shown_level(root: Usd.Prim) -> Usd.Prim | None:
    """The child of a prim with levels of detail (UsdLod) that is shown: of its default index, or of an override's."""
    index = root.GetAttribute("lod:default:index").Get()
    for prim in with_ancestors(root):
        mode = prim.GetAttribute("lod:override:mode").Get() or "inherited"
        if mode == "indexedLOD":
            index = prim.GetAttribute("lod:override:index").Get()
        if mode != "inherited":
            break
    children = root.GetFilteredChildren(TRAVERSAL)  # Among them may be heuristics, which choose a level by distance.
    levels = [prim for prim in children if UsdGeom.Imageable(prim) or not prim.GetTypeName()]
    number = round(index) if isinstance(index, int | float) and math.isfinite(index) else 0
    return levels[number] if 0 <= number < len(levels) else None


def instance_roots(prim: Usd.Prim) -> tuple[Sdf.Path, ...]:
    """Instances containing a prim, outermost first; an override of the prim requires the instances to be editable."""
    return tuple(ancestor.GetPath() for ancestor in reversed([*with_ancestors(prim)]) if ancestor.IsInstance())


def traverse(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """All active, loaded, defined prims, including prims inside instances."""
    return iter(Usd.PrimRange.Stage(stage, TRAVERSAL))


def targets_of(prim: Usd.Prim, name: str) -> list[Sdf.Path]:
    """Targets of a relationship; collections are named by their property paths."""
    relationship = prim.GetRelationship(name)
    return relationship.GetForwardedTargets() if relationship else []


def with_gravity(units: Units, garments: Sequence[Usd.Prim], axis_option: str | None) -> Units:
    """Units with gravity along the requested axis, or along the axis authored on garments; unchanged without either.

    Args:
        units: The stage's units.
        axis_option: One of `AXES`, or None.

    Raises:
        SchemaError: An attribute is no axis, or two garments have different axes.
    """
    if axis_option is not None:
        return units.pulled(axis_option, GRAVITY_OPTION)
    axes = [(axis, source) for axis, source in (find_token(prim, GARMENT["gravity"]) for prim in garments) if axis]
    if len({axis for axis, _ in axes}) > 1:
        listed = ", ".join(f"{source} is {axis}" for axis, source in dict.fromkeys(axes))
        raise SchemaError(f"{listed}: a shot has one gravity")
    return units.pulled(*axes[0]) if axes else units


def _collides(prim: Usd.Prim) -> bool:
    """Whether a prim is a collider by our schema, or else by UsdPhysics."""
    if has_schema(prim, COLLIDER_API):
        return True
    collision = UsdPhysics.CollisionAPI(prim)
    return bool(collision) and bool(UsdGeom.Imageable(prim)) and collision.GetCollisionEnabledAttr().Get() is not False


def find_paths(stage: Usd.Stage, item: str, kinds: Kinds, *, drawn: bool = True) -> list[Sdf.Path]:
    """Paths of the prims of some UsdGeom classes named by an item, as in `find_garments`.

    Args:
        kinds: The classes; with point instancers among them, prims below instancers are named by their own path only.
        drawn: Whether proxies and guides are skipped unless named by path or name, or unless nothing else is named.

    Raises:
        AbsentError: No prim is found.
    """
    pick = _drawn if drawn else list
    if _COLLECTION in item:  # Members only, not prims below: excluded prims stay out.
        members = pick([prim for prim in _collection(stage, item) if _is_a(prim, kinds)])
    elif any(letter in item for letter in "*?["):
        matching = (prim for prim in traverse(stage) if fnmatch.fnmatchcase(str(prim.GetPath()), item))
        members = pick([prim for root in matching for prim in _below(root, kinds)])
    else:
        named = [_at_path(stage, item)] if item.startswith("/") else _named(stage, item)
        members = [prim for root in named for prim in pick(_below(root, kinds))]
    if not members:
        raise AbsentError(f"{item!r} names no {' or '.join(kind.__name__ for kind in kinds)}; {_mesh_list(stage)}")
    return [prim.GetPath() for prim in members]


def _named(stage: Usd.Stage, name: str) -> list[Usd.Prim]:
    same_name = [prim for prim in traverse(stage) if prim.GetName() == name]
    return [prim for prim in same_name if not _hidden_level(prim)] or same_name


def _below(root: Usd.Prim, kinds: Kinds) -> list[Usd.Prim]:
    """The prim itself if of the kinds, else all prims of the kinds below."""
    if _is_a(root, kinds):
        return [root]
    inside, prims = [], iter(Usd.PrimRange(root, TRAVERSAL))
    for prim in prims:
        if _is_a(prim, kinds):
            inside.append(prim)
            if UsdGeom.PointInstancer(prim):
                prims.PruneChildren()
    return inside


def _is_a(prim: Usd.Prim, kinds: Kinds) -> bool:
    return any(kind(prim) for kind in kinds)


def _drawn(prims: list[Usd.Prim]) -> list[Usd.Prim]:
    """The prims shown by a final render, or all prims if none is shown."""
    return [prim for prim in prims if is_drawn(prim)] or prims


def _at_path(stage: Usd.Stage, item: str) -> Usd.Prim:
    """The prim at a path; AbsentError for a missing, inactive, undefined or abstract prim."""
    if not Sdf.Path.IsValidPathString(item):
        raise AbsentError(f"{item!r} is no prim path")
    prim = stage.GetPrimAtPath(item)
    if not prim:
        raise AbsentError(f"no prim at <{item}>; {_mesh_list(stage)}")
    states = {
        "inactive": not prim.IsActive(),
        "abstract": prim.IsAbstract(),
        "inside a prototype": prim.IsInPrototype(),
        "only an over, defined nowhere,": not prim.IsDefined(),
    }
    conditions = [name for name, holds in states.items() if holds]
    if conditions:
        raise AbsentError(f"<{item}> is {conditions[0]} and does not exist for refining; {_mesh_list(stage)}")
    return prim


def _collection(stage: Usd.Stage, item: str) -> list[Usd.Prim]:
    """The prims of a collection; AbsentError lists the prim's collections."""
    path, name = item.split(_COLLECTION, 1)
    prim = _at_path(stage, path)
    collection = Usd.CollectionAPI.Get(prim, name)
    names = [collection.GetName() for collection in Usd.CollectionAPI.GetAllCollections(prim)]
    if name not in names:
        raise AbsentError(f"<{path}> has no collection {name!r}; collections: {', '.join(names) or 'none'}")
    included = collection.ComputeIncludedObjects(collection.ComputeMembershipQuery(), stage, TRAVERSAL)
    return sorted((member for member in included if isinstance(member, Usd.Prim)), key=lambda member: member.GetPath())


def _mesh_list(stage: Usd.Stage) -> str:
    meshes = list_meshes(stage)
    unlisted = f" and {len(meshes) - _SHOWN} more" if len(meshes) > _SHOWN else ""
    return f"meshes: {', '.join(meshes[:_SHOWN]) or 'none'}{unlisted}"


def read_apart(
    stage: Usd.Stage, garments: Sequence[Usd.Prim]
) -> tuple[dict[Sdf.Path, dict[Sdf.Path, str]], list[Notice]]:
    """Gprims never touched by each garment, by ``physgraph:contact:exclude``: a hand in a pocket, a belt in a loop.

    Two garments are apart when either excludes the other; a garment is never apart from itself, see selfCollision.

    Returns:
        The gprims of each garment by its path, each with the excluding target; and a notice for each missing target.
    """
    excluded, notices = dict[Sdf.Path, dict[Sdf.Path, str]](), []
    for prim in garments:
        excluded[prim.GetPath()], new_notices = _excluded_by(stage, prim)
        notices += new_notices
    for garment, targets in excluded.items():
        targets.pop(garment, None)
        for path in [path for path in targets if path in excluded]:
            excluded[path].setdefault(garment, targets[path])
    return excluded, notices


def _excluded_by(stage: Usd.Stage, prim: Usd.Prim) -> tuple[dict[Sdf.Path, str], list[Notice]]:
    """Gprims at and below the targets of a garment, each with the target."""
    excluded: dict[Sdf.Path, str] = {}
    notices = []
    message = f"<{prim.GetPath()}>.{EXCLUDE}"
    for target in targets_of(prim, EXCLUDE):
        try:
            paths = find_paths(stage, str(target), BODIES, drawn=False)
        except StageError as error:
            notices.append(Notice(str(prim.GetPath()), None, f"{EXCLUDE} excludes nothing by <{target}>: {error}"))
            continue
        for path in paths:
            excluded.setdefault(path, message if path == target else f"{message} = <{target}>")
    return excluded, notices
