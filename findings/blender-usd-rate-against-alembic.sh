#!/usr/bin/env bash
# Tool: Blender 5.0.1 as the Python package bpy (USD and Alembic import); needs Python 3.11
#
# Expected: one second of cloth, written from Blender at 48 frames per second to USD and to Alembic, lasts one second
# when either file is imported into a scene of 24 frames per second. The USD file says timeCodesPerSecond = 48.
#
# Seen: Alembic keeps seconds. The USD importer takes time codes for frames and changes neither them nor the scene's
# rate, so that the same motion lasts two seconds; a USD export from there says timeCodesPerSecond = 24. The height
# of a sheet that rises by 48 in that second:
#
#   Alembic: scene of 24 frames per second, at frames 0, 12, 24, 48: [0.0, 24.0, 48.0, 48.0]
#   USD:     scene of 24 frames per second, at frames 0, 12, 24, 48: [0.0, 12.0, 24.0, 48.0]
#   exported again as USD: timeCodesPerSecond 24, samples up to 48
#
# Why it matters: a body that comes as Alembic and its garment as USD part from each other at the second frame, and after
# the round trip every speed that a solver derives from the stage is halved.
#
# Workaround: set the scene's rate to the stage's timeCodesPerSecond before importing.
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
from pxr import Usd, UsdGeom


def new_scene(rate: int):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = rate
    return bpy.context.scene


scene = new_scene(48)
scene.frame_start, scene.frame_end = 0, 48
stage = Usd.Stage.CreateNew("made.usda")
stage.SetTimeCodesPerSecond(48)
stage.SetStartTimeCode(0)
stage.SetEndTimeCode(48)
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
UsdGeom.SetStageMetersPerUnit(stage, 1)
sheet = UsdGeom.Mesh.Define(stage, "/Sheet")
sheet.CreateFaceVertexCountsAttr([4])
sheet.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
for frame in range(49):
    sheet.GetPointsAttr().Set([(0, 0, frame), (1, 0, frame), (1, 1, frame), (0, 1, frame)], frame)
stage.Save()
bpy.ops.wm.usd_import(filepath="made.usda", import_subdivision=False)
bpy.ops.wm.alembic_export(filepath="cloth.abc", start=0, end=48)
bpy.ops.wm.usd_export(filepath="cloth.usda", export_animation=True)

seen = []
for name, load in (("Alembic:", bpy.ops.wm.alembic_import), ("USD:", bpy.ops.wm.usd_import)):
    scene = new_scene(24)
    load(filepath="cloth.abc" if name == "Alembic:" else "cloth.usda")
    sheet = next(one for one in bpy.data.objects if one.type == "MESH")
    heights = []
    for frame in (0, 12, 24, 48):
        scene.frame_set(frame)
        solid = sheet.evaluated_get(bpy.context.evaluated_depsgraph_get())
        heights.append(round(solid.data.vertices[0].co.z, 2))
    print(f"{name:<8} scene of {scene.render.fps} frames per second, at frames 0, 12, 24, 48: {heights}")
    seen.append((scene.render.fps, heights))
bpy.ops.wm.usd_export(filepath="again.usda", export_animation=True)
again = Usd.Stage.Open("again.usda")
seen.append((again.GetTimeCodesPerSecond(), again.GetEndTimeCode()))
print("exported again as USD: timeCodesPerSecond {:.0f}, samples up to {:.0f}".format(*seen[-1]))
rate = Usd.Stage.Open("cloth.usda").GetTimeCodesPerSecond()
sys.exit(seen != [(24, [0, 24, 48, 48]), (24, [0, 12, 24, 48]), (24, 48)] or rate != 48)
PY
