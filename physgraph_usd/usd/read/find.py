"""Finding the garments and colliders of a stage: by applied schema, path, name, glob or collection."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Iterator, Sequence

from pxr import Sdf, Usd, UsdGeom

from ...errors import AbsentError, GarmentError, StageError
from ..lookup import COLLIDER_ENABLED, is_on
from ..schema import COLLIDER_API, GARMENT_API
from ..stage import TRAVERSAL, Notice, list_meshes
from .materials import is_collision_prim

_COLLECTION = ".collection:"
_COLLIDERS_RELATIONSHIP = "physgraph:colliders"
_SHOWN = 20
EXCLUDE = "physgraph:contact:exclude"


def has_schema(prim: Usd.Prim, name: str) -> bool:
    """Whether an API schema is applied, also when it is not registered."""
    return name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


def find_garments(stage: Usd.Stage, wanted: Sequence[str] = ()) -> list[Usd.Prim]:
    """Find the meshes to refine.

    Args:
        stage: The stage.
        wanted: Prim paths (a transform stands for the meshes below it), prim names, globs over paths, or collections
            (``/Prim.collection:name``); empty: every mesh with PhysGraphGarmentAPI.

    Returns:
        Mesh prims in stage order, those inside instances included.

    Raises:
        AbsentError: When an item is not found; the message lists the meshes that there are.
        StageError: When nothing is named and nothing found.
    """
    if wanted:
        chosen = {path for item in wanted for path in find_paths(stage, item, UsdGeom.Mesh)}
        return [prim for prim in traverse(stage) if prim.GetPath() in chosen]
    found = [prim for prim in traverse(stage) if has_schema(prim, GARMENT_API)]
    if not found:
        raise StageError(
            f"no prim has {GARMENT_API} and no garment was named; --garment PATH names one; {_meshes_said(stage)}"
        )
    for prim in found:
        if not UsdGeom.Mesh(prim):
            kind = prim.GetTypeName() or "prim without a type"
            remedy = "apply the schema to the meshes themselves"
            raise GarmentError(str(prim.GetPath()), f"has {GARMENT_API} but is a {kind}, not a Mesh", remedy=remedy)
    return found


def find_colliders(stage: Usd.Stage, garments: Sequence[Usd.Prim], wanted: Sequence[str] = ()) -> list[Usd.Prim]:
    """Find the prims that garments may collide with.

    Invisible prims and those of purpose guide or proxy count; inactive ones do not exist.

    Args:
        stage: The stage.
        garments: The garments; they are no colliders.
        wanted: As for ``find_garments``; empty: what the garments' ``physgraph:colliders`` name, and for garments
            without targets every prim with PhysGraphColliderAPI or UsdPhysics' CollisionAPI.

    Returns:
        Gprims in stage order.

    Raises:
        AbsentError: When a named one is not there.
    """
    chosen = {path for item in wanted for path in find_paths(stage, item, UsdGeom.Gprim)}
    chosen = chosen.union(*(() if wanted else felt_by(stage, garments)))
    own = {prim.GetPath() for prim in garments}
    return [prim for prim in traverse(stage) if prim.GetPath() in chosen - own]


def felt_by(stage: Usd.Stage, garments: Sequence[Usd.Prim], wanted: Sequence[str] = ()) -> list[frozenset[Sdf.Path]]:
    """For each garment, paths of the gprims that it may collide with; arguments as for ``find_colliders``.

    Raises:
        AbsentError: When a named one is not there.
        StageError: When one that the garment's ``physgraph:colliders`` name is not.
    """
    found: dict[tuple[str, ...], frozenset[Sdf.Path]] = {}  # Many garments name the same, mostly nothing.
    each = []
    for garment in garments:
        named = tuple(wanted or map(str, targets_of(garment, _COLLIDERS_RELATIONSHIP)))
        if named not in found:
            try:
                found[named] = _colliders_named(stage, named)
            except AbsentError as error:
                if wanted:
                    raise
                raise StageError(f"<{garment.GetPath()}>.{_COLLIDERS_RELATIONSHIP}: {error}") from error
        each.append(found[named])
    return each


def _colliders_named(stage: Usd.Stage, named: Sequence[str]) -> frozenset[Sdf.Path]:
    """Gprims that are named, or where none is those of every collider of the stage."""
    if named:
        return frozenset(path for item in named for path in find_paths(stage, item, UsdGeom.Gprim))
    return frozenset(path for prim in traverse(stage) if _collides(prim) for path in _gprims_below(prim, UsdGeom.Gprim))


def instance_roots(prim: Usd.Prim) -> tuple[Sdf.Path, ...]:
    """Instances that hold a prim, outermost first: what must become editable before the prim can be overridden."""
    found = []
    while prim and not prim.IsPseudoRoot():
        if prim.IsInstance():
            found.append(prim.GetPath())
        prim = prim.GetParent()
    return tuple(reversed(found))


def traverse(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """All active, loaded, defined prims, those inside instances included."""
    return iter(Usd.PrimRange.Stage(stage, TRAVERSAL))


def targets_of(prim: Usd.Prim, name: str) -> list[Sdf.Path]:
    """What a relationship of a prim names; collections are named by their property paths."""
    relationship = prim.GetRelationship(name)
    return relationship.GetForwardedTargets() if relationship else []


def _collides(prim: Usd.Prim) -> bool:
    if has_schema(prim, COLLIDER_API):
        return is_on(prim, COLLIDER_ENABLED)
    return is_collision_prim(prim)


def find_paths(stage: Usd.Stage, item: str, kind: type) -> list[Sdf.Path]:
    """Paths of the prims of a kind that an item names.

    Args:
        stage: The stage.
        item: A prim path (standing for what is below it), a prim name, a glob over paths or a collection.
        kind: A class of UsdGeom.

    Raises:
        AbsentError: When there is none.
    """
    roots: Iterable[Usd.Prim]
    if _COLLECTION in item:  # its members are told one by one, so that what it excludes stays out
        roots = [prim for prim in _collection(stage, item) if kind(prim)]
    elif any(letter in item for letter in "*?["):
        roots = [prim for prim in traverse(stage) if fnmatch.fnmatchcase(str(prim.GetPath()), item)]
    elif item.startswith("/"):
        roots = [_at_path(stage, item)]
    else:
        roots = [prim for prim in traverse(stage) if prim.GetName() == item]
    found = [path for root in roots for path in _gprims_below(root, kind)]
    if not found:
        raise AbsentError(f"{item!r} names no {kind.__name__}; {_meshes_said(stage)}")
    return found


def _gprims_below(root: Usd.Prim, kind: type) -> list[Sdf.Path]:
    """The prim itself when it is of the kind, else those of the kind below it."""
    if kind(root):
        return [root.GetPath()]
    return [prim.GetPath() for prim in Usd.PrimRange(root, TRAVERSAL) if kind(prim)]


def _at_path(stage: Usd.Stage, item: str) -> Usd.Prim:
    """The prim at a path.

    Raises:
        AbsentError: When there is none that can be used; says whether it is inactive, undefined or abstract.
    """
    if not Sdf.Path.IsValidPathString(item):
        raise AbsentError(f"{item!r} is no prim path")
    prim = stage.GetPrimAtPath(item)
    if not prim:
        raise AbsentError(f"no prim at <{item}>; {_meshes_said(stage)}")
    states = {
        "inactive": not prim.IsActive(),
        "abstract": prim.IsAbstract(),
        "inside a prototype": prim.IsInPrototype(),
        "only an over, defined nowhere,": not prim.IsDefined(),
    }
    found = [name for name, holds in states.items() if holds]
    if found:
        raise AbsentError(f"<{item}> is {found[0]} and does not exist for refining; {_meshes_said(stage)}")
    return prim


def _collection(stage: Usd.Stage, item: str) -> list[Usd.Prim]:
    """The prims of a collection.

    Raises:
        AbsentError: When there is no such collection; lists those of the prim.
    """
    path, name = item.split(_COLLECTION, 1)
    prim = _at_path(stage, path)
    collection = Usd.CollectionAPI.Get(prim, name)
    known = [each.GetName() for each in Usd.CollectionAPI.GetAllCollections(prim)]
    if name not in known:
        raise AbsentError(f"<{path}> has no collection {name!r}; collections: {', '.join(known) or 'none'}")
    included = collection.ComputeIncludedObjects(collection.ComputeMembershipQuery(), stage, TRAVERSAL)
    return sorted((each for each in included if isinstance(each, Usd.Prim)), key=lambda each: each.GetPath())


def _meshes_said(stage: Usd.Stage) -> str:
    meshes = list_meshes(stage)
    more = f" and {len(meshes) - _SHOWN} more" if len(meshes) > _SHOWN else ""
    return f"meshes: {', '.join(meshes[:_SHOWN]) or 'none'}{more}"


def read_apart(stage: Usd.Stage, garments: Sequence[Usd.Prim]) -> tuple[list[dict[Sdf.Path, str]], list[Notice]]:
    """Read what garments are kept apart from.

    Two garments are apart when either says so. A garment is never apart from itself: that is selfCollision's.

    Args:
        stage: The stage.
        garments: The garments.

    Returns:
        For each garment, the gprims that it does not touch, each with what says so; and a notice for each target that
        is not there.
    """
    found, notices = [], []
    for prim in garments:
        own, odd = _named(stage, prim)
        found.append(own)
        notices += odd
    numbers = {prim.GetPath(): index for index, prim in enumerate(garments)}
    for (place, _), own in zip(numbers.items(), found, strict=True):
        own.pop(place, None)
        for path in [path for path in own if path in numbers]:
            found[numbers[path]].setdefault(place, own[path])
    return found, notices


def _named(stage: Usd.Stage, prim: Usd.Prim) -> tuple[dict[Sdf.Path, str], list[Notice]]:
    """Gprims at and below the targets of one garment, and by which target."""
    found: dict[Sdf.Path, str] = {}
    notices = []
    message = f"<{prim.GetPath()}>.{EXCLUDE}"
    for target in targets_of(prim, EXCLUDE):
        try:
            paths = find_paths(stage, str(target), UsdGeom.Gprim)
        except StageError as error:
            notices.append(Notice(str(prim.GetPath()), None, f"{EXCLUDE} excludes nothing by <{target}>: {error}"))
            continue
        for path in paths:
            found.setdefault(path, message if path == target else f"{message} = <{target}>")
    return found, notices
