"""Finding the garments and colliders of a stage."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence

from pxr import Usd, UsdGeom

from ..errors import StageError
from .stage import TRAVERSAL, list_meshes

GARMENT_API = "PhysGraphGarmentAPI"
COLLIDER_API = "PhysGraphColliderAPI"


def has_schema(prim: Usd.Prim, name: str) -> bool:
    """Whether an API schema is applied, also when it is not registered."""
    return name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


def find_garments(stage: Usd.Stage, wanted: Sequence[str]) -> list[Usd.Prim]:
    """Prims to refine, in stage order.

    Raises:
        StageError: When nothing is found; lists the meshes that there are.
    """
    meshes = [prim for prim in Usd.PrimRange.Stage(stage, TRAVERSAL) if prim.IsA(UsdGeom.Mesh)]
    if not wanted:
        found = [prim for prim in meshes if has_schema(prim, GARMENT_API)]
    else:
        found = [prim for prim in meshes if any(fnmatch.fnmatchcase(str(prim.GetPath()), item) for item in wanted)]
    if not found:
        raise StageError(f"no garment found; meshes: {', '.join(list_meshes(stage)) or 'none'}")
    return found
