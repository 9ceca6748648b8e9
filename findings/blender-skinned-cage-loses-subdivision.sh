#!/usr/bin/env bash
# Tool: Blender 5.0.1 as the Python package bpy (USD import and export); needs Python 3.11
#
# Expected: two catmullClark cages go through Blender's USD import and export, both as the defaults write them, and come
# back as catmullClark cages. UsdSkel moves the points of a skinned cage, and its surface is subdivided after that.
#
# Seen: the importer puts the skinned cage's Subdivision modifier before its Armature modifier, so that Blender skins the
# subdivided mesh; and the exporter, which counts subdivision only where it is last, writes the cage as a polygon mesh:
#
#   Plain:   modifiers ['SUBSURF'], exported as catmullClark with 9 points
#   Skinned: modifiers ['SUBSURF', 'ARMATURE'], exported as none with 9 points
#
# Why it matters: a skinned garment that only passes through Blender comes back with a faceted surface, and a tool that
# refines only subdivided cages passes it by. What Blender shows itself differs from the USD surface at joints.
#
# Workaround: move the Armature modifier above the Subdivision modifier after the import; or set subdivisionScheme again
# in a stronger layer.
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
bones = UsdSkel.Skeleton.Define(stage, "/World/Bones")
bones.CreateJointsAttr(["hip"])
bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
for name in ("Plain", "Skinned"):
    cage = UsdGeom.Mesh.Define(stage, f"/World/{name}")
    cage.CreatePointsAttr([(x, y, 0) for y in range(3) for x in range(3)])
    cage.CreateFaceVertexCountsAttr([4] * 4)
    cage.CreateFaceVertexIndicesAttr([0, 1, 4, 3, 1, 2, 5, 4, 3, 4, 7, 6, 4, 5, 8, 7])
    cage.CreateSubdivisionSchemeAttr("catmullClark")
bind = UsdSkel.BindingAPI.Apply(cage.GetPrim())
bind.CreateJointIndicesPrimvar(False, 1).Set([0] * 9)
bind.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 9)
bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
stage.Save()

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath="in.usda", import_subdivision=True)
modifiers = {name: [m.type for m in bpy.data.objects[name].modifiers] for name in ("Plain", "Skinned")}
bpy.ops.wm.usd_export(filepath="out.usda", export_armatures=True)
out = Usd.Stage.Open("out.usda")
seen = {}
for prim in out.Traverse():
    if prim.IsA(UsdGeom.Mesh):
        mesh = UsdGeom.Mesh(prim)
        name = prim.GetName()
        seen[name] = (modifiers[name], mesh.GetSubdivisionSchemeAttr().Get(), len(mesh.GetPointsAttr().Get()))
for name in ("Plain", "Skinned"):
    print(f"{name + ':':<8} modifiers {seen[name][0]}, exported as {seen[name][1]} with {seen[name][2]} points")
wanted = {"Plain": (["SUBSURF"], "catmullClark", 9), "Skinned": (["SUBSURF", "ARMATURE"], "none", 9)}
sys.exit(seen != wanted)
PY
