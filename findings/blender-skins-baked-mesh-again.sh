#!/usr/bin/env bash
# Tool: Blender 5.0.1 as the Python package bpy (USD import); needs Python 3.11
#
# Expected: UsdSkel.BakeSkinning writes a garment's skinned points and makes its SkelRoot an Xform. UsdSkel's page on
# its schemas says that bindings without a SkelRoot above them have no meaning and should be ignored. An importer then
# shows the baked points as they are.
#
# Seen: Blender reads the bindings, which the bake leaves on the mesh, and skins the skinned points once more. A point
# at 0 degrees on a joint that turns by 90:
#
#   Blender, before the bake: type SkelRoot, 90 degrees
#   USD, after the bake:      type Xform, 90 degrees
#   Blender, after the bake:  type Xform, 180 degrees
#
# Why it matters: baking is how a skinned garment is made safe for tools that do not skin. Blender turns every limb
# twice, and the first frame, where the pose is often the rest pose, looks right.
#
# Workaround: import with import_skeletons off, or after the bake remove SkelBindingAPI and the properties skel:* and
# primvars:skel:* from the meshes.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3.11 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q bpy==5.0.1
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import math
import sys

import bpy

bpy.utils.expose_bundled_modules()
from pxr import Gf, Usd, UsdGeom, UsdSkel

stage = Usd.Stage.CreateNew("in.usda")
root = UsdSkel.Root.Define(stage, "/World")
stage.SetDefaultPrim(root.GetPrim())
UsdGeom.SetStageUpAxis(stage, "Z")
UsdGeom.SetStageMetersPerUnit(stage, 1)
bones = UsdSkel.Skeleton.Define(stage, "/World/Bones")
bones.CreateJointsAttr(["hip"])
bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
motion = UsdSkel.Animation.Define(stage, "/World/Motion")
motion.CreateJointsAttr(["hip"])
motion.CreateTranslationsAttr([(0, 0, 0)])
motion.CreateScalesAttr([Gf.Vec3h(1, 1, 1)])
for frame, degrees in ((1, 0), (2, 90)):
    motion.CreateRotationsAttr().Set([Gf.Quatf(Gf.Rotation((0, 0, 1), degrees).GetQuat())], frame)
UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
mesh = UsdGeom.Mesh.Define(stage, "/World/Coat")
mesh.CreatePointsAttr([(1, 0, 0), (0, 0, 1), (0, 0, 0)])
mesh.CreateFaceVertexCountsAttr([3])
mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
mesh.CreateSubdivisionSchemeAttr("none")
bind = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
bind.CreateJointIndicesPrimvar(False, 1).Set([0] * 3)
bind.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 3)
bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
stage.Save()
seen = []


def note(name: str, point) -> None:
    kind, degrees = str(root.GetPrim().GetTypeName()), abs(round(math.degrees(math.atan2(point[1], point[0]))))
    print(f"{name:25} type {kind}, {degrees} degrees")
    seen.append((kind, degrees))


def by_blender():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath="in.usda")
    (coat,) = (thing for thing in bpy.data.objects if thing.type == "MESH")
    bpy.context.scene.frame_set(2)
    shown = coat.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return shown.matrix_world @ shown.data.vertices[0].co


note("Blender, before the bake:", by_blender())
assert UsdSkel.BakeSkinning(root)
note("USD, after the bake:", mesh.GetPointsAttr().Get(2)[0])
note("Blender, after the bake:", by_blender())
sys.exit(seen != [("SkelRoot", 90), ("Xform", 90), ("Xform", 180)])
PY
