#!/usr/bin/env bash
# Tool: Blender 5.0.1 as the Python package bpy (USD import); needs Python 3.11
#
# Expected: the documentation of UsdSkel says that a skinned mesh's own transform has no effect. Its points are put into
# the space of the skeleton by skel:geomBindTransform, which is the identity where it is not set. So Blender shows a
# mesh without it where UsdSkel does.
#
# Seen: where it is not set, Blender takes the mesh's own transform for it. A coat with a point at x = 1 and a
# translation by 5, on a joint that stays in its rest pose:
#
#   UsdSkel, geomBindTransform not set:      x = 1
#   UsdSkel, geomBindTransform the identity: x = 1
#   Blender, geomBindTransform not set:      x = 6
#   Blender, geomBindTransform the identity: x = 1
#
# Why it matters: garments whose points are in the space of the skeleton need no geomBindTransform, and someone who
# places them gives them a transform. Body and coat stand together in one program and apart in the other.
#
# Workaround: write skel:geomBindTransform on every skinned mesh, the identity too.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3.11 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q bpy==5.0.1
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
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
for name in ("Unset", "Identity"):
    mesh = UsdGeom.Mesh.Define(stage, f"/World/{name}")
    mesh.CreatePointsAttr([(1, 0, 0), (1, 1, 0), (1, 0, 1)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.AddTranslateOp().Set((5, 0, 0))
    bind = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    bind.CreateJointIndicesPrimvar(False, 1).Set([0] * 3)
    bind.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 3)
    bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
    if name == "Identity":
        bind.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
stage.Save()

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath="in.usda")
assert UsdSkel.BakeSkinning(root)
seen = {"UsdSkel": [], "Blender": []}
for name in ("Unset", "Identity"):
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}"))
    world = UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim())
    seen["UsdSkel"].append(round(world.Transform(mesh.GetPointsAttr().Get()[0])[0], 3))
    shown = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
    seen["Blender"].append(round((shown.matrix_world @ shown.data.vertices[0].co).x, 3))
for program, places in seen.items():
    for state, x in zip(("not set:", "the identity:"), places):
        print(f"{program}, geomBindTransform {state:13} x = {x:.0f}")
sys.exit(seen != {"UsdSkel": [1, 1], "Blender": [6, 1]})
PY
