#!/usr/bin/env bash
# Tool: Blender 5.0.1 as the Python package bpy (USD import); needs Python 3.11
#
# Expected: an imported blend shape moves the points as UsdSkel does: straight on for weights below 0 and above 1, and
# by way of its inbetweens where it has some. What Blender's shape keys cannot hold is named in a warning.
#
# Seen: the imported shape keys have the range 0 to 1, weights outside it are clamped to it, and inbetweens are left
# out, without a word. Height of a point by weight; one shape lifts it by 1, the other has an inbetween of 2 at 0.5 too:
#
#   weight            -0.50   0.00   0.50   1.00   1.50
#   plain, UsdSkel    -0.50   0.00   0.50   1.00   1.50
#   plain, Blender     0.00   0.00   0.50   1.00   1.00
#   curved, UsdSkel   -2.00   0.00   2.00   1.00   0.00
#   curved, Blender    0.00   0.00   0.50   1.00   1.00
#
# The animation curves hold the weights as they are in the file.
#
# Why it matters: corrective shapes of garments and bodies are driven beyond 1 and below 0 as a matter of course. Cloth
# that is refined in Blender on such a body fits a body that no other application shows.
#
# Workaround: widen slider_min and slider_max of the shape keys after the import (they reach from -10 to 10); for
# inbetweens, bake the points before the import (UsdSkel.BakeSkinning).
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

weights = (-0.5, 0, 0.5, 1, 1.5)
stage = Usd.Stage.CreateNew("in.usda")
root = UsdSkel.Root.Define(stage, "/World")
stage.SetDefaultPrim(root.GetPrim())
stage.SetStartTimeCode(1)
stage.SetEndTimeCode(len(weights))
UsdGeom.SetStageUpAxis(stage, "Z")
UsdGeom.SetStageMetersPerUnit(stage, 1)
bones = UsdSkel.Skeleton.Define(stage, "/World/Bones")
bones.CreateJointsAttr(["hip"])
bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
motion = UsdSkel.Animation.Define(stage, "/World/Bones/Motion")
motion.CreateBlendShapesAttr(["shape"])
for frame, weight in enumerate(weights, 1):
    motion.CreateBlendShapeWeightsAttr().Set([weight], frame)
UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
expected = {}
for name in ("plain", "curved"):
    mesh = UsdGeom.Mesh.Define(stage, f"/World/{name}")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateSubdivisionSchemeAttr("none")
    shape = UsdSkel.BlendShape.Define(stage, f"/World/{name}/shape")
    shape.CreateOffsetsAttr([(0, 0, 1)] * 3)
    if name == "curved":
        halfway = shape.CreateInbetween("halfway")
        halfway.SetOffsets([(0, 0, 2)] * 3)
        halfway.SetWeight(0.5)
    bind = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    bind.CreateBlendShapesAttr(["shape"])
    bind.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
    bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
    query = UsdSkel.BlendShapeQuery(bind)
    tables = query.ComputeBlendShapePointIndices(), query.ComputeSubShapePointOffsets()
    expected[name] = []
    for weight in weights:
        points = mesh.GetPointsAttr().Get()
        assert query.ComputeDeformedPoints(*query.ComputeSubShapeWeights([weight]), *tables, points)
        expected[name].append(points[0][2])
stage.Save()

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath="in.usda")
seen = {name: [] for name in expected}
for frame in range(1, len(weights) + 1):
    bpy.context.scene.frame_set(frame)
    for name in expected:
        shown = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
        seen[name].append(shown.data.vertices[0].co.z)
rows = [[round(height, 4) for height in row] for name in expected for row in (expected[name], seen[name])]
print(f"{'weight':<16}" + "".join(f"{weight:7.2f}" for weight in weights))
for name, row in zip(("plain, UsdSkel", "plain, Blender", "curved, UsdSkel", "curved, Blender"), rows, strict=True):
    print(f"{name:<16}" + "".join(f"{height:7.2f}" for height in row))
blender = [0, 0, 0.5, 1, 1]
sys.exit(rows != [[-0.5, 0, 0.5, 1, 1.5], blender, [-2, 0, 2, 1, 0], blender])
PY
