"""Meshes, garments and bodies alike, whose arrays are broken."""

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from .damage import INF, NAN, ODD_DOUBLES, numbers, replace
from .mutant import Draft, Kind

OWN = ("plain", "still", "dressed", "bodies", "skinned", "several")
"""Shots whose garments are in the root layer."""


def a_mesh(draft: Draft, stage: Usd.Stage) -> UsdGeom.Mesh:
    """One of the stage's meshes, garments and bodies alike."""
    return UsdGeom.Mesh(draft.pick([prim for prim in stage.Traverse() if UsdGeom.Mesh(prim)]))


def _soup(draft: Draft) -> None:
    """Faces at random: edges with many faces, repeated corners, isolated points, windings that disagree."""
    stage = draft.open()
    mesh = a_mesh(draft, stage)
    count = len(numbers(mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime())))
    counts = draft.rng.integers(draft.pick([0, 3]), draft.pick([4, 5, 9]), size=int(draft.rng.integers(1, 40)))
    indices = draft.rng.integers(max(count, 1), size=int(counts.sum()))
    mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(counts.astype(np.int32)))
    mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(indices.astype(np.int32)))
    draft.save(stage, f"{mesh.GetPath()}: {len(counts)} faces at random")


def _transform(draft: Draft) -> None:
    """A placement that is singular, not finite, huge, projective, or made of operations that are not there."""
    stage = draft.open()
    prim = a_mesh(draft, stage).GetPrim()
    prim = draft.pick([prim, prim.GetParent()])
    times = draft.pick([(), (1.0,), (1.0, 2.0), (1.5,), (50.0,)])
    if draft.chance(0.3):
        order = Vt.TokenArray(draft.pick([["xformOp:nowhere"], ["!resetXformStack!"], ["nonsense", ""], []]))
        replace(stage, prim.GetPath().AppendProperty("xformOpOrder"), "token[]", order)
    else:
        matrix = np.eye(4)
        matrix[tuple(draft.rng.integers(4, size=2))] = draft.pick(ODD_DOUBLES)
        if draft.chance(0.3):
            matrix *= draft.pick([0.0, 1e-200, 1e30, 1e160, NAN, INF])
        replace(stage, prim.GetPath().AppendProperty("xformOp:transform"), "matrix4d", Gf.Matrix4d(matrix), times=times)
        order = Vt.TokenArray(["xformOp:transform"] * draft.pick([1, 1, 1, 2]))
        replace(stage, prim.GetPath().AppendProperty("xformOpOrder"), "token[]", order)
    draft.save(stage, f"{prim.GetPath()}: transform at {times or 'default'}")


def _replaced_prim(draft: Draft) -> None:
    """A mesh, or its parent, that is of another type, inactive, abstract, only an over, or gone."""
    stage = draft.open()
    prim = a_mesh(draft, stage).GetPrim()
    prim = draft.pick([prim, prim, prim.GetParent()])
    how = draft.pick(["type", "inactive", "over", "class", "gone", "invisible", "child", "instanceable", "kind"])
    spec = stage.GetRootLayer().GetPrimAtPath(prim.GetPath())
    if how == "type":
        spec.typeName = draft.pick(["", "Xform", "Points", "BasisCurves", "Sphere", "Nonsense", "PointInstancer"])
    elif how == "inactive":
        prim.SetActive(False)
    elif how in {"over", "class"}:
        spec.specifier = Sdf.SpecifierOver if how == "over" else Sdf.SpecifierClass
    elif how == "gone":
        stage.RemovePrim(prim.GetPath())
    elif how == "invisible":
        UsdGeom.Imageable(prim).MakeInvisible(draft.pick([Usd.TimeCode.Default(), Usd.TimeCode(1.0)]))
    elif how == "instanceable":
        prim.SetInstanceable(True)
    elif how == "kind":
        prim.SetMetadata("kind", draft.pick(["component", "assembly", "nonsense"]))
    else:
        UsdGeom.Mesh.Define(stage, prim.GetPath().AppendChild("inner")).GetPrim().AddAppliedSchema(
            "PhysGraphGarmentAPI"
        )
    draft.save(stage, f"{prim.GetPath()}: {how}")


KINDS = (
    Kind("mesh: random faces", _soup, OWN),
    Kind("mesh: transform", _transform, OWN),
    Kind("mesh: other prim", _replaced_prim, OWN),
)
