"""Authors a garment's static opinions: fine topology, values used, and blocks of replaced coarse properties."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from ...errors import LayerError
from ...solver.mesh.topology import PolygonMesh
from ...solver.scene import Garment, GarmentFrame
from ..read.bodies import sharpness_of
from ..schema import GARMENT, GARMENT_API, fabric_values
from ..stage import GarmentSource, Notice, value_at
from .attribute_rules import BLOCKED, CARRIED, EMPTIED, PREFIX, REST_POINTS, action_on, limit_renderers, with_action
from .primvars import INFINITE, FineMap, inherits_influences
from .stream import LayerStream

_TYPES = Sdf.ValueTypeNames
_ELSEWHERE = (PREFIX, "skel:", "xformOp", "physgraph:")


def scheme_of(prim: Usd.Prim, fine: PolygonMesh, *, keep: bool) -> str:
    """The subdivision scheme of a fine mesh.

    Loop's scheme is for triangles only, and it is the scheme of triangles: the cage's Catmull-Clark would show the
    pattern of its first subdivision, which cuts triangles into quads.

    Args:
        prim: The coarse mesh as composed.
        fine: The fine mesh.
        keep: Whether the fine mesh is a subdivision surface if the coarse mesh is one; False: never.
    """
    tokens = UsdGeom.Tokens
    scheme = UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get(Usd.TimeCode.EarliestTime())
    if not keep or scheme == tokens.none:
        return tokens.none
    if scheme == tokens.bilinear:
        return tokens.bilinear
    return tokens.loop if (np.asarray(fine.counts) == 3).all() else tokens.catmullClark


def author_topology(
    stream: LayerStream,
    target: Sdf.Path,
    prim: Usd.Prim,
    fine: FineMap,
    *,
    scheme: str,
    sharp: tuple[np.ndarray, np.ndarray],
) -> None:
    """Author counts, indices, scheme, creases and corners, and hide all coarse-topology properties.

    Here and below ``target`` is the prim to author on and ``prim`` the coarse mesh as composed.

    Args:
        scheme: The subdivision scheme, from `scheme_of`.
        sharp: Edges and vertices that stay sharp beside the coarse mesh's own, shapes (K, 2) and (V,), bool.
    """
    for name, values in (("faceVertexCounts", fine.fine.counts), ("faceVertexIndices", fine.fine.indices)):
        path = target.AppendProperty(name)
        stream.attribute(path, _TYPES.IntArray)
        stream.set(path, Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32)))
    path = target.AppendProperty("subdivisionScheme")
    stream.attribute(path, _TYPES.Token, uniform=True)
    stream.set(path, scheme)
    smooth = scheme != UsdGeom.Tokens.none
    _author_sharpness(stream, target, prim, fine, sharp if smooth else None)
    _author_rules(stream, target, prim)
    limit_renderers(stream, target, prim, fine.levels if smooth else None)


def _author_sharpness(
    stream: LayerStream,
    target: Sdf.Path,
    prim: Usd.Prim,
    fine: FineMap,
    sharp: tuple[np.ndarray, np.ndarray] | None,
) -> None:
    """Author creases and corners of the fine mesh where there are any or the coarse mesh's must be hidden.

    ``sharp`` are further sharp edges and vertices; None: the fine mesh is no subdivision surface.
    """
    ends, sharpness, corner = sharpness_of(UsdGeom.Mesh(prim), fine.cage.vertex_count)
    if sharp is None:
        edges, of_edges, corners, of_corners = np.zeros(0, np.int32), np.zeros(0), np.zeros(0, np.int32), np.zeros(0)
    else:
        always, fixed = sharp
        ends, sharpness = np.concatenate([always, ends]), np.concatenate([np.full(len(always), INFINITE), sharpness])
        edges, of_edges = fine.creases(ends, sharpness)
        corners, of_corners = fine.corners(np.where(fixed, INFINITE, corner))
    arrays = {
        "creaseIndices": edges.ravel(),
        "creaseLengths": np.full(len(of_edges), 2, np.int32),
        "creaseSharpnesses": of_edges,
        "cornerIndices": corners,
        "cornerSharpnesses": of_corners,
    }
    for name, values in arrays.items():
        path, kind = target.AppendProperty(name), prim.GetAttribute(name).GetTypeName()
        if len(values) or prim.GetAttribute(name).HasAuthoredValue():
            stream.attribute(path, kind)
            stream.set(path, type(kind.defaultValue)(values.tolist()))


def _author_rules(stream: LayerStream, target: Sdf.Path, prim: Usd.Prim) -> None:
    """Empty and block attributes of a coarse mesh by the table of rules; `carry_primvars` blocks primvars."""
    for attribute in with_action(prim, EMPTIED):
        path, kind = target.AppendProperty(attribute.GetName()), attribute.GetTypeName()
        stream.attribute(path, kind)
        stream.set(path, type(kind.defaultValue)())
    for attribute in with_action(prim, BLOCKED):
        if not attribute.GetName().startswith(PREFIX):
            stream.block(target.AppendProperty(attribute.GetName()), attribute.GetTypeName())
    if prim.GetAttribute("velocities").HasAuthoredValue():
        stream.block(target.AppendProperty("velocities"), _TYPES.Vector3fArray)


def speed_notices(prim: Usd.Prim, *, written: bool) -> list[Notice]:
    """Notices of blocked velocities and accelerations of a coarse mesh, or of velocities recomputed."""
    blocked = "are blocked: they belong to the coarse points"
    message = {
        "velocities": "are written anew, from the refined points" if written else blocked,
        "accelerations": blocked,
    }
    path = str(prim.GetPath())
    return [
        Notice(path, None, f"its {name} {s}")
        for name, s in message.items()
        if prim.GetAttribute(name).HasAuthoredValue()
    ]


def author_rest_points(stream: LayerStream, target: Sdf.Path, prim: Usd.Prim, fine: FineMap) -> list[Notice]:
    """Refine the rest shape of the deformable-body schema; notices of other arrays unfit for the fine mesh."""
    notices = []
    sizes = {fine.count(kind): kind for kind in ("faceVarying", "uniform", "vertex")}
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        elsewhere = name.startswith(_ELSEWHERE) or action_on(attribute) not in ("", CARRIED)
        if elsewhere or not attribute.GetTypeName().isArray:
            continue
        value = value_at(attribute, None)
        if value is None or len(value) < 2:
            continue
        if len(value) not in sizes:
            if np.asarray(value).dtype.kind in "iu":
                message = f"{name} may number points or faces of the coarse mesh and stays as authored"
                notices.append(Notice(str(prim.GetPath()), None, message))
            continue
        if name in REST_POINTS and len(value) == fine.count("vertex"):
            path = target.AppendProperty(name)
            stream.attribute(path, attribute.GetTypeName())
            stream.set(path, Vt.Vec3fArray.FromNumpy(fine.interpolate(np.asarray(value, np.float32))))
        else:
            message = f"{name} has one entry per {sizes[len(value)]} element of the coarse mesh and stays as authored"
            notices.append(Notice(str(prim.GetPath()), None, message))
    return notices


def author_unskinned(stream: LayerStream, target: Sdf.Path, prim: Usd.Prim, *, skinned: bool) -> None:
    """Remove a mesh from skinning; ``skinned``: whether its points are already skinned.

    The mesh keeps SkelBindingAPI for its bind transform; without the schema, USD's validators report that transform.
    """
    for name in ("skel:joints", "skel:blendShapes"):
        if prim.GetAttribute(name).HasAuthoredValue():
            stream.block(target.AppendProperty(name), _TYPES.TokenArray)
    if skinned and inherits_influences(prim):
        # An ancestor's influences reach the mesh with or without the schema; an empty skeleton target stops skinning.
        edit_schemas(stream, target, added=["SkelBindingAPI"])
        spec = stream.prim(target)
        skeleton = spec.relationships.get("skel:skeleton") or Sdf.RelationshipSpec(spec, "skel:skeleton", False)
        skeleton.targetPathList.ClearEditsAndMakeExplicit()


def edit_schemas(
    stream: LayerStream, target: Sdf.Path, *, added: Sequence[str] = (), deleted: Sequence[str] = ()
) -> None:
    """Add to and delete from a prim's applied API schemas, keeping earlier edits in this layer."""
    spec = stream.prim(target)
    edits = spec.GetInfo("apiSchemas") if spec.HasInfo("apiSchemas") else Sdf.TokenListOp()
    edits.prependedItems = [*edits.prependedItems, *(name for name in added if name not in edits.prependedItems)]
    edits.deletedItems = [*edits.deletedItems, *(name for name in deleted if name not in edits.deletedItems)]
    spec.SetInfo("apiSchemas", edits)


def open_instances(stream: LayerStream, path: Sdf.Path, roots: Sequence[Sdf.Path]) -> list[Notice]:
    """Make the instances containing a prim editable, with one notice each."""
    notices = []
    for root in roots:
        if stream.prim(root).GetInfo("instanceable") is not False or not stream.prim(root).HasInfo("instanceable"):
            stream.prim(root).SetInfo("instanceable", False)
            notices.append(Notice(str(root), None, f"no longer instanceable, so that <{path}> can be refined"))
    return notices


def make_sibling(stream: LayerStream, prim: Usd.Prim) -> Sdf.Path:
    """Define the refined sibling of a mesh, ``<name>_refined``, make the mesh its proxy, and return the sibling's path.

    The sibling references the mesh and inherits all unrefined properties (bindings, transforms, visibility).

    Raises:
        LayerError: A prim of the sibling's name exists.
    """
    coarse = prim.GetPath()
    path = coarse.ReplaceName(f"{coarse.name}_refined")
    if prim.GetStage().GetPrimAtPath(path):
        raise LayerError(f"<{path}> is already on the stage; refine the shot without it, or use mode 'over'")
    spec = stream.prim(path)
    spec.specifier, spec.typeName = Sdf.SpecifierDef, "Mesh"
    spec.referenceList.Prepend(Sdf.Reference(primPath=coarse))
    for prim_path, purpose in ((coarse, "proxy"), (path, "render")):
        stream.attribute(prim_path.AppendProperty("purpose"), _TYPES.Token, uniform=True)
        stream.set(prim_path.AppendProperty("purpose"), purpose)
    relationship = Sdf.RelationshipSpec(spec, "proxyPrim", False)
    relationship.targetPathList.explicitItems = [coarse]
    edit_schemas(stream, path, deleted=[GARMENT_API])
    for child in prim.GetFilteredChildren(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        if UsdGeom.Xformable(child) or UsdSkel.BlendShape(child):
            # Only subsets and looks belong to both meshes; a nested mesh would be drawn twice.
            stream.prim(path.AppendChild(child.GetName())).SetInfo("active", False)
    _copy_collection_binding(stream, path, prim)
    return path


def _copy_collection_binding(stream: LayerStream, target: Sdf.Path, prim: Usd.Prim) -> None:
    """Bind directly a material bound to the mesh by a collection, which does not hold the sibling."""
    for purpose in (UsdShade.Tokens.allPurpose, UsdShade.Tokens.preview, UsdShade.Tokens.full):
        material, relationship = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
        if not material or "material:binding:collection" not in relationship.GetName():
            continue
        name = "material:binding" if not purpose else f"material:binding:{purpose}"
        edit_schemas(stream, target, added=["MaterialBindingAPI"])
        binding = Sdf.RelationshipSpec(stream.prim(target), name, False)
        binding.targetPathList.explicitItems = [material.GetPath()]


def author_used_values(stream: LayerStream, source: GarmentSource, garment: Garment, values: GarmentFrame) -> None:
    """Author the level, fabric, guide and detail of the first time code, except animated values.

    An artist can change a value and refine again.
    """
    edit_schemas(stream, source.path, added=[GARMENT_API])
    level = source.path.AppendProperty("physgraph:refine:level")
    stream.attribute(level, Sdf.ValueTypeNames.Int, uniform=True)
    stream.set(level, garment.level)
    used = fabric_values(values.fabric) | {"guide:stiffness": values.guide, "refine:detail": values.detail}
    for short, value in used.items():
        if short not in source.animated:
            path = source.path.AppendProperty(GARMENT[short].name)
            stream.attribute(path, Sdf.ValueTypeNames.Float)
            stream.set(path, float(value))
