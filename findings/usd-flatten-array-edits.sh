#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdUtils.FlattenLayerStack and array edits)
#
# Expected: flattening a layer stack gives one layer that resolves to the same values. An array edit over an array in a
# weaker sublayer becomes the edited array, as Usd.Stage.Flatten has it.
#
# Seen: FlattenLayerStack keeps the edit and drops the array that it edits. The edit has nothing to write to, and the
# points come out empty; there is no warning, and faces keep their indices into them. The array may be a default or time
# samples in the weaker layer:
#
#   points in the weaker layer    stage   Stage.Flatten   FlattenLayerStack
#   default                           3               3                   0
#   time samples                      3               3                   0
#
# Why it matters: FlattenLayerStack is what publishing tools call before they hand a shot on, since it keeps references.
# One corrected vertex on top of a garment, for which array edits are made, and the garment is gone from what they
# publish. The layers that it stood in have been merged away by then.
#
# Workaround: before flattening, set the resolved array over each edit (attribute.Set(attribute.Get(time), time) in the
# stronger layer), or flatten by Usd.Stage.Flatten.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt

print("points in the weaker layer    stage   Stage.Flatten   FlattenLayerStack")
seen = []
for name, time in (("default", Usd.TimeCode.Default()), ("time samples", 1)):
    garment = Usd.Stage.CreateNew(f"garment{len(seen)}.usda")
    UsdGeom.Points.Define(garment, "/Cloth").GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (2, 0, 0)], time)
    garment.Save()
    shot = Sdf.Layer.CreateNew(f"shot{len(seen)}.usda")
    shot.subLayerPaths.append(f"garment{len(seen)}.usda")
    stage = Usd.Stage.Open(shot)
    fix = Vt.Vec3fArrayEditBuilder()
    fix.Write(Gf.Vec3f(1, 0, 0.1), 1)
    stage.GetAttributeAtPath("/Cloth.points").Set(fix.FinalizeAndReset(), time)
    stages = [stage, Usd.Stage.Open(stage.Flatten()), Usd.Stage.Open(UsdUtils.FlattenLayerStack(stage))]
    sizes = [len(one.GetAttributeAtPath("/Cloth.points").Get(time)) for one in stages]
    print(f"{name:<26}{sizes[0]:>9}{sizes[1]:>16}{sizes[2]:>20}")
    seen.append(sizes)
sys.exit(seen != [[3, 3, 0], [3, 3, 0]])
PY
