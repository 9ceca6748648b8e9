"""Reads the instances of point instancers: the shapes drawn, and their placements in the world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from .lookup import with_ancestors
from .stage import quiet, timecode

_ATTRIBUTES = ("protoIndices", "ids", "invisibleIds", "positions", "orientations", "orientationsf", "scales")
_RATES = ("velocities", "accelerations", "angularVelocities")
_PROTOTYPES = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)
"""Prims drawn below a prototype, which may be an over or a class."""


def instancer_above(prim: Usd.Prim, beside: Usd.Prim | None = None) -> Usd.Prim | None:
    """Outermost point instancer above a prim, which is drawn there at the instances only; None without.

    Args:
        beside: A garment; instancers above the garment too do not count.
    """
    shared = {ancestor.GetPath() for ancestor in with_ancestors(beside)} if beside else set()
    above = [ancestor for ancestor in with_ancestors(prim.GetParent()) if UsdGeom.PointInstancer(ancestor)]
    return next((instancer for instancer in reversed(above) if instancer.GetPath() not in shared), None)


def mover(stage: Usd.Stage, body: Sdf.Path, garment: Sdf.Path) -> Usd.Prim:
    """The prim moving a body beside a garment: the instancer of the body, or the body."""
    prim = stage.GetPrimAtPath(body)
    return instancer_above(prim, stage.GetPrimAtPath(garment)) or prim


def prototypes_of(instancer: Usd.Prim) -> list[Usd.Prim]:
    """The prototypes by number; an invalid prim for a missing prototype."""
    targets = UsdGeom.PointInstancer(instancer).GetPrototypesRel().GetForwardedTargets()
    return [instancer.GetStage().GetPrimAtPath(path) for path in targets]


def instanced_gprims(instancer: Usd.Prim) -> list[Usd.Prim]:
    """Gprims below the prototypes of an instancer and of nested instancers."""
    return [prim for prim in drawn_with(instancer) if not UsdGeom.PointInstancer(prim)]


def drawn_with(prim: Usd.Prim) -> list[Usd.Prim]:
    """A prim and, of an instancer, all gprims and nested instancers below its prototypes."""
    prototypes, open_prims = dict[Sdf.Path, Usd.Prim](), [prim]
    while open_prims:
        current = open_prims.pop()
        if current.GetPath() not in prototypes:  # Else drawn twice, or a prototype that contains its instancer.
            prototypes[current.GetPath()] = current
            roots = prototypes_of(current) if UsdGeom.PointInstancer(current) else []
            open_prims += [shape for root in reversed(roots) for shape in reversed([*_shapes(root)])]
    return [*prototypes.values()]


def _shapes(root: Usd.Prim) -> Iterator[Usd.Prim]:
    """Gprims and point instancers at and below a prototype."""
    if not root:
        return
    prims = iter(Usd.PrimRange(root, _PROTOTYPES))
    for prim in prims:
        if UsdGeom.PointInstancer(prim):
            prims.PruneChildren()
            yield prim
        elif UsdGeom.Gprim(prim):
            yield prim


def placements(instancer: Usd.Prim, time: float | None) -> dict[Sdf.Path, np.ndarray] | None:
    """Matrices for column vectors from a gprim's local space to the world, in stage units, for each visible instance.

    Masked instances, and gprims invisible below their prototype, are left out.

    Returns:
        By path of the gprim, shape (N, 4, 4), float64; None if arrays of the instancer do not fit together.
    """
    world = np.array(UsdGeom.XformCache(timecode(time)).GetLocalToWorldTransform(instancer))
    matrices_of: dict[Sdf.Path, list[np.ndarray]] = {}
    with quiet(), np.errstate(all="ignore"):
        fits = _place(instancer, world[None], time, matrices_of, ())
    if not fits:
        return None
    return {path: np.concatenate(matrices).swapaxes(1, 2) for path, matrices in matrices_of.items()}


def _place(
    instancer: Usd.Prim,
    bases: np.ndarray,
    time: float | None,
    matrices_of: dict[Sdf.Path, list[np.ndarray]],
    above: tuple[Sdf.Path, ...],
) -> bool:
    """Add the matrices, for row vectors, of an instancer placed by some matrices; False if its arrays do not fit."""
    shape, code, instancer_matrices = (
        UsdGeom.PointInstancer(instancer),
        code_of(instancer, time),
        own_transforms(instancer, time),
    )
    if instancer_matrices is None or instancer.GetPath() in above:
        return instancer_matrices is not None
    kinds, mask = np.asarray(_kinds(instancer, code), np.int64), shape.ComputeMaskAtTime(code)
    visible = np.asarray(mask, bool) if len(mask) == len(kinds) else np.ones(len(kinds), bool)
    cache, fits = UsdGeom.XformCache(code), True
    for number, root in enumerate(prototypes_of(instancer)):
        mine = instancer_matrices[visible & (kinds == number)]
        if not len(mine) or not root:
            continue
        placed = (mine[None] @ bases[:, None]).reshape(-1, 4, 4)
        for prim in _shapes(root):
            if _is_hidden(prim, root, code):
                continue
            matrices = np.array(cache.ComputeRelativeTransform(prim, root)[0])[None] @ placed
            if UsdGeom.PointInstancer(prim):
                fits &= _place(prim, matrices, time, matrices_of, (*above, instancer.GetPath()))
            else:
                matrices_of.setdefault(prim.GetPath(), []).append(matrices)
    return fits


def own_transforms(instancer: Usd.Prim, time: float | None) -> np.ndarray | None:
    """Matrices, for row vectors, from each prototype's local space to the instancer's, shape (N, 4, 4), float64.

    Masked instances are included. None if the arrays do not fit together.
    """
    shape, code = UsdGeom.PointInstancer(instancer), code_of(instancer, time)
    count = len(_kinds(instancer, code))
    with_prototype, all_instances = UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
    transforms = shape.ComputeInstanceTransformsAtTime(code, code, with_prototype, all_instances) if count else ()
    return np.array(transforms, np.float64).reshape(-1, 4, 4) if len(transforms) == count else None


def _kinds(instancer: Usd.Prim, code: Usd.TimeCode) -> Sequence[int]:
    """Number of each instance's prototype; none for a value of another type."""
    value = UsdGeom.PointInstancer(instancer).GetProtoIndicesAttr().Get(code)
    return [*value] if isinstance(value, Vt.IntArray) else []


def code_of(instancer: Usd.Prim, time: float | None) -> Usd.TimeCode:
    """USD's time code for a number; for None the default, or the first sample of positions without a default."""
    default = UsdGeom.PointInstancer(instancer).GetPositionsAttr().Get() is not None
    return timecode(time) if time is not None or default else Usd.TimeCode.EarliestTime()


def instance_reach(instancer: Usd.Prim) -> float:
    """Greatest distance along an axis of the instances' bounds beyond the positions' [units of the instancer]."""
    code, stage = code_of(instancer, None), instancer.GetStage()
    value = UsdGeom.PointInstancer(instancer).GetPositionsAttr().Get(code)
    positions = np.array(value if isinstance(value, Vt.Vec3fArray) else [], float).reshape(-1, 3)
    world = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(instancer)).T
    inverse = np.linalg.pinv(np.where(np.isfinite(world), world, 0.0))
    corners = [positions]
    for path, matrices in (placements(instancer, None) or {}).items():
        shape = UsdGeom.Boundable(stage.GetPrimAtPath(path))
        ends = np.array(UsdGeom.Boundable.ComputeExtentFromPlugins(shape, code) or [], float).reshape(-1, 3)
        if len(ends) == 2:
            eight = np.array([[*point, 1.0] for point in product(*ends.T)])
            corners.append(np.einsum("nxy,cy->ncx", inverse @ matrices, eight)[:, :, :3].reshape(-1, 3))
    every = np.concatenate(corners)
    if not len(positions) or not np.isfinite(every).all():
        return 0.0
    return float(
        max((positions.min(axis=0) - every.min(axis=0)).max(), (every.max(axis=0) - positions.max(axis=0)).max())
    )


def _is_hidden(prim: Usd.Prim, root: Usd.Prim, code: Usd.TimeCode) -> bool:
    """Whether a prim or an ancestor up to its prototype's root is invisible."""
    for ancestor in with_ancestors(prim):
        shape = UsdGeom.Imageable(ancestor)
        if shape and shape.GetVisibilityAttr().Get(code) == UsdGeom.Tokens.invisible:
            return True
        if ancestor == root:
            break
    return False
