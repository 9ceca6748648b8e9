"""Writes a plain record of a shot as a USD stage; used for the samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from ..provenance import export_layer
from ..schema import fabric_values
from ..stage import timecode
from .atomic import prepare_target
from .plain import Look, PlainMesh, PlainStage, Skeleton


def write_stage(record: PlainStage, path: Path, *, overwrite: bool = False) -> Path:
    """Write a shot to a new layer, in the format of the path's suffix, and return the path.

    Raises:
        UsageError: The file exists and may not be replaced.
        LayerError: The file cannot be written.
    """
    prepare_target(path, overwrite=overwrite)
    layer = Sdf.Layer.CreateAnonymous(path.suffix)
    stage = Usd.Stage.Open(layer)
    stage.SetMetadata("documentation", record.doc)
    UsdGeom.SetStageMetersPerUnit(stage, record.metres_per_unit)
    UsdGeom.SetStageUpAxis(stage, record.up_axis)
    stage.SetTimeCodesPerSecond(record.rate)
    stage.SetFramesPerSecond(record.rate)
    stage.SetStartTimeCode(float(record.times[0]))
    stage.SetEndTimeCode(float(record.times[-1]))
    kind = UsdSkel.Root if record.skeleton else UsdGeom.Xform
    root = kind.Define(stage, Sdf.Path("/" + record.name)).GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    if record.skeleton:
        _write_skeleton(stage, record, record.skeleton)
    for mesh in record.meshes:
        _write_mesh(stage, record, mesh)
    _write_bound(root, record)
    return export_layer(layer, path)


def _write_mesh(stage: Usd.Stage, record: PlainStage, mesh: PlainMesh) -> None:
    prim_path = stage.GetDefaultPrim().GetPath().AppendChild(mesh.name)
    usd = UsdGeom.Mesh.Define(stage, prim_path)
    usd.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(mesh.counts.astype(np.int32)))
    usd.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.indices.astype(np.int32)))
    usd.CreateSubdivisionSchemeAttr(mesh.scheme)
    usd.CreateOrientationAttr("leftHanded" if mesh.left_handed else "rightHanded")
    usd.CreateDoubleSidedAttr(mesh.role == "garment")
    points, extent = usd.CreatePointsAttr(), usd.CreateExtentAttr()
    samples = {} if mesh.samples is None else dict(zip(record.times.tolist(), mesh.samples, strict=True))
    for time, values in {None: mesh.points, **samples}.items():
        vectors = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))
        points.Set(vectors, timecode(time))
        extent.Set(UsdGeom.PointBased.ComputeExtent(vectors), timecode(time))
    if mesh.transforms is not None:
        op = usd.AddTransformOp()
        for time, matrix in zip(record.times, mesh.transforms, strict=True):
            op.Set(Gf.Matrix4d(matrix.T.tolist()), float(time))
    _write_primvars(usd, mesh)
    _write_looks(stage, usd, mesh)
    if mesh.role == "garment":
        _write_garment(usd.GetPrim(), mesh)
    elif mesh.role == "collider":
        usd.GetPrim().AddAppliedSchema("PhysGraphColliderAPI")


def _write_primvars(usd: UsdGeom.Mesh, mesh: PlainMesh) -> None:
    usd.CreateDisplayColorPrimvar("constant").Set([Gf.Vec3f(*mesh.look.color)])
    primvars = UsdGeom.PrimvarsAPI(usd)
    if mesh.uv is not None:
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uv.values, dtype=np.float32)))
        st.SetIndices(Vt.IntArray.FromNumpy(mesh.uv.indices.astype(np.int32)))
    if mesh.pin is not None:
        pin = primvars.CreatePrimvar("physgraph:pin", Sdf.ValueTypeNames.FloatArray, "vertex")
        pin.Set(Vt.FloatArray.FromNumpy(mesh.pin.astype(np.float32)))
    if mesh.skin is not None:
        binding = UsdSkel.BindingAPI.Apply(usd.GetPrim())
        size = mesh.skin.joints.shape[1]
        joints = Vt.IntArray.FromNumpy(mesh.skin.joints.astype(np.int32).ravel())
        weights = Vt.FloatArray.FromNumpy(mesh.skin.weights.astype(np.float32).ravel())
        binding.CreateJointIndicesPrimvar(False, size).Set(joints)
        binding.CreateJointWeightsPrimvar(False, size).Set(weights)
        binding.CreateSkeletonRel().SetTargets([usd.GetPath().GetParentPath().AppendChild("Skeleton")])
        binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))


def _write_looks(stage: Usd.Stage, usd: UsdGeom.Mesh, mesh: PlainMesh) -> None:
    """Bind the mesh's material, or a partition of face subsets for several materials."""
    if not mesh.subsets:
        UsdShade.MaterialBindingAPI.Apply(usd.GetPrim()).Bind(_material(stage, mesh.look))
        return
    claimed = np.concatenate([faces for _, faces in mesh.subsets])
    rest = np.setdiff1d(np.arange(len(mesh.counts)), claimed)
    binding = UsdShade.MaterialBindingAPI.Apply(usd.GetPrim())
    for look, faces in ((mesh.look, rest), *mesh.subsets):
        indices = Vt.IntArray.FromNumpy(np.sort(faces).astype(np.int32))
        subset = binding.CreateMaterialBindSubset(look.name, indices, UsdGeom.Tokens.face)
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(_material(stage, look))
    binding.SetMaterialBindSubsetsFamilyType(UsdGeom.Tokens.partition)


def _material(stage: Usd.Stage, look: Look) -> UsdShade.Material:
    """Return the material of a look, authored once under ``Looks``."""
    scope = UsdGeom.Scope.Define(stage, stage.GetDefaultPrim().GetPath().AppendChild("Looks"))
    path = scope.GetPath().AppendChild(look.name)
    existing = UsdShade.Material.Get(stage, path)
    if existing:
        return existing
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*look.color))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(look.roughness)
    output = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    return material


def _write_garment(prim: Usd.Prim, mesh: PlainMesh) -> None:
    prim.AddAppliedSchema("PhysGraphGarmentAPI")
    level = "physgraph:refine:level", Sdf.ValueTypeNames.Int, False, Sdf.VariabilityUniform
    prim.CreateAttribute(*level).Set(mesh.level)
    for name, value in ({} if mesh.fabric is None else fabric_values(mesh.fabric)).items():
        prim.CreateAttribute(f"physgraph:material:{name}", Sdf.ValueTypeNames.Float, False).Set(value)


def _write_bound(root: Usd.Prim, record: PlainStage) -> None:
    paths = [root.GetPath().AppendChild(mesh.name) for mesh in record.meshes if mesh.role == "trim"]
    garment = next((mesh.name for mesh in record.meshes if mesh.role == "garment"), None)
    if paths and garment is not None:
        root.GetChild(garment).CreateRelationship("physgraph:bind:targets", False).SetTargets(paths)


def _write_skeleton(stage: Usd.Stage, record: PlainStage, skeleton: Skeleton) -> None:
    root = stage.GetDefaultPrim().GetPath()
    usd = UsdSkel.Skeleton.Define(stage, root.AppendChild("Skeleton"))
    usd.CreateJointsAttr(list(skeleton.joints))
    bind = [Gf.Matrix4d(matrix.T.tolist()) for matrix in skeleton.bind]
    usd.CreateBindTransformsAttr(Vt.Matrix4dArray(bind))
    parents = UsdSkel.Topology(list(skeleton.joints)).GetParentIndices()
    rest = [bind[i] if p < 0 else bind[i] * bind[p].GetInverse() for i, p in enumerate(parents)]
    usd.CreateRestTransformsAttr(Vt.Matrix4dArray(rest))
    anim = UsdSkel.Animation.Define(stage, root.AppendChild("Animation"))
    anim.CreateJointsAttr(list(skeleton.joints))
    anim.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * len(skeleton.joints)))
    rotations, translations = anim.CreateRotationsAttr(), anim.CreateTranslationsAttr()
    for i, time in enumerate(record.times):
        quats = [Gf.Quatf(float(q[0]), *(float(v) for v in q[1:])) for q in skeleton.rotations[i]]
        rotations.Set(Vt.QuatfArray(quats), float(time))
        offsets = np.ascontiguousarray(skeleton.translations[i], dtype=np.float32)
        translations.Set(Vt.Vec3fArray.FromNumpy(offsets), float(time))
    UsdSkel.BindingAPI.Apply(usd.GetPrim()).CreateAnimationSourceRel().SetTargets([anim.GetPath()])
