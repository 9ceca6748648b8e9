#!/usr/bin/env bash
# Tool: Blender 5.0.1 as the Python package bpy (USD import and export); needs Python 3.11
#
# Expected: a mesh whose skel:skinningMethod is dualQuaternion is skinned by dual quaternions. Blender has them: they
# are the armature modifier's "Preserve Volume". The importer switches it on, and the exporter writes the method.
#
# Seen: the importer leaves it off, so that the mesh is skinned linearly. With it switched on by hand the exporter
# writes no method, which means classicLinear. No warning in either direction. A ring of radius 1, half of whose weight
# is on a joint that is twisted by 170 degrees:
#
#   Blender, after the import:         radius 0.087
#   Blender, Preserve Volume:          radius 1.000
#   UsdSkel, dualQuaternion:           radius 1.000
#   UsdSkel, exported by Blender then: radius 0.087
#
# Why it matters: the method is chosen for forearms and thighs that twist. They collapse where they twist most, and
# cloth around the limb is solved against a body that the other program does not show.
#
# Workaround: set use_deform_preserve_volume of the armature modifiers after the import and write skel:skinningMethod
# after the export, or exchange baked points.
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
stage.SetDefaultPrim(UsdSkel.Root.Define(stage, "/World").GetPrim())
stage.SetStartTimeCode(1)
stage.SetEndTimeCode(2)
UsdGeom.SetStageUpAxis(stage, "Z")
UsdGeom.SetStageMetersPerUnit(stage, 1)
joints, places = ["arm", "arm/hand"], [Gf.Matrix4d(1), Gf.Matrix4d(1).SetTranslate((1, 0, 0))]
bones = UsdSkel.Skeleton.Define(stage, "/World/Bones")
bones.CreateJointsAttr(joints)
bones.CreateBindTransformsAttr(places)
bones.CreateRestTransformsAttr(places)
motion = UsdSkel.Animation.Define(stage, "/World/Motion")
motion.CreateJointsAttr(joints)
motion.CreateTranslationsAttr([(0, 0, 0), (1, 0, 0)])
motion.CreateScalesAttr([Gf.Vec3h(1, 1, 1)] * 2)
for frame, degrees in ((1, 0), (2, 170)):
    turn = Gf.Rotation((1, 0, 0), degrees).GetQuat()
    motion.CreateRotationsAttr().Set([Gf.Quatf(1), Gf.Quatf(turn)], frame)
UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
ring = UsdGeom.Mesh.Define(stage, "/World/Ring")
ring.CreatePointsAttr([(1, 1, 0), (1, 0, 1), (1, -1, 0), (1, 0, -1)])
ring.CreateFaceVertexCountsAttr([4])
ring.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
ring.CreateSubdivisionSchemeAttr("none")
bind = UsdSkel.BindingAPI.Apply(ring.GetPrim())
bind.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * 4)
bind.CreateJointWeightsPrimvar(False, 2).Set([0.5] * 8)
bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
bind.CreateSkinningMethodAttr("dualQuaternion")
stage.Save()


def by_blender() -> float:
    bpy.context.scene.frame_set(2)
    shown = coat.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.vertices[0].co
    return math.hypot(shown.y, shown.z)


def by_usd(name: str) -> float:
    opened = Usd.Stage.Open(name)
    (mesh,) = (UsdGeom.Mesh(prim) for prim in opened.Traverse() if prim.IsA(UsdGeom.Mesh))
    (root,) = (UsdSkel.Root(prim) for prim in opened.Traverse() if prim.IsA(UsdSkel.Root))
    assert UsdSkel.BakeSkinning(root)
    return math.hypot(*mesh.GetPointsAttr().Get(2)[0][1:])


bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath="in.usda")
(coat,) = (thing for thing in bpy.data.objects if thing.type == "MESH")
seen = [by_blender()]
coat.modifiers[0].use_deform_preserve_volume = True
seen.append(by_blender())
bpy.ops.wm.usd_export(filepath="out.usda", export_animation=True)
seen += [by_usd("in.usda"), by_usd("out.usda")]
names = ["Blender, after the import", "Blender, Preserve Volume", "UsdSkel, dualQuaternion"]
for name, radius in zip([*names, "UsdSkel, exported by Blender then"], seen):
    print(f"{name + ':':34} radius {radius:.3f}")
sys.exit([round(radius, 3) for radius in seen] != [0.087, 1, 1, 0.087])
PY
