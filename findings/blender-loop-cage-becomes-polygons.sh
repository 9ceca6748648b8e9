#!/usr/bin/env bash
# Tool: Blender 5.0.1 as the Python package bpy (USD import and export); needs Python 3.11
#
# Expected: with import_subdivision a cage that USD draws as a subdivision surface is one in Blender too, or the importer
# says that it can't be.
#
# Seen: a triangle cage of the scheme loop comes in as plain polygons, without a modifier and without a word, and a USD
# export writes it with the scheme none: the round trip turns a smooth garment into a faceted one. A sheet of
# catmullClark with interpolateBoundary = none, whose outer ring of faces USD does not draw, comes in with that ring
# drawn and is exported as edgeOnly. Modifiers after import, and the tokens after export:
#
#   loop                    no modifier        -> none
#   catmullClark            SUBSURF, 2 levels  -> catmullClark, edgeAndCorner
#   catmullClark, boundary  SUBSURF, 2 levels  -> catmullClark, edgeOnly
#
# Why it matters: triangulated garments (as of pattern tools) are loop cages; passed through Blender once, renderers draw
# their triangles, and nobody is told.
#
# Workaround: add a Subdivision modifier by hand (Blender's is Catmull-Clark on triangles too), and write the scheme into
# the exported file afterwards.
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

SIDE = 4


def write(name: str, scheme: str, boundary: str) -> None:
    stage = Usd.Stage.CreateNew(f"{name}.usda")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    mesh = UsdGeom.Mesh.Define(stage, "/Sheet")
    faces = []
    for row in range(SIDE - 1):
        for column in range(SIDE - 1):
            first = row * SIDE + column
            quad = [first, first + 1, first + SIDE + 1, first + SIDE]
            faces += [quad[:3], [quad[0], quad[2], quad[3]]] if scheme == "loop" else [quad]
    mesh.CreatePointsAttr([(column, row, 0) for row in range(SIDE) for column in range(SIDE)])
    mesh.CreateFaceVertexCountsAttr([len(face) for face in faces])
    mesh.CreateFaceVertexIndicesAttr([corner for face in faces for corner in face])
    mesh.CreateSubdivisionSchemeAttr(scheme)
    mesh.CreateInterpolateBoundaryAttr(boundary)
    stage.SetDefaultPrim(mesh.GetPrim())
    stage.Save()


seen = []
for name, scheme, boundary in (
    ("loop", "loop", "edgeAndCorner"),
    ("catmullClark", "catmullClark", "edgeAndCorner"),
    ("catmullClark, boundary", "catmullClark", "none"),
):
    source, exported = f"in{len(seen)}", f"out{len(seen)}.usda"
    write(source, scheme, boundary)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=f"{source}.usda", import_subdivision=True)
    (sheet,) = (one for one in bpy.data.objects if one.type == "MESH")
    modifiers = ", ".join(f"{one.type}, {one.render_levels} levels" for one in sheet.modifiers) or "no modifier"
    bpy.ops.wm.usd_export(filepath=exported, export_subdivision="BEST_MATCH")
    stage = Usd.Stage.Open(exported)
    mesh = next(UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    tokens = [mesh.GetSubdivisionSchemeAttr().Get()]
    tokens += [mesh.GetInterpolateBoundaryAttr().Get()] if tokens != ["none"] else []
    print(f"{name:<23} {modifiers:<18} -> {', '.join(tokens)}")
    seen.append((modifiers, *tokens))
smooth = "SUBSURF, 2 levels"
wanted = [("no modifier", "none"), (smooth, "catmullClark", "edgeAndCorner"), (smooth, "catmullClark", "edgeOnly")]
sys.exit(seen != wanted)
PY
