#!/usr/bin/env bash
# Library: usd-core 26.11 (array edits in time samples)
#
# Expected: an array edit says which elements of a weaker array to write, and as a time sample it does so from its frame
# on. Before the first sample an attribute holds that sample; so the points are everywhere numbers, and a stage reads
# the same after Usd.Stage.Flatten.
#
# Seen: where the weaker layer has a default only, all elements are NaN at every time before the first edit, those that
# no edit writes too. The flattened stage holds the first sample there:
#
#   time   0.0: stage    nan    nan    nan, flattened    0.0    0.1    0.0
#   time   4.9: stage    nan    nan    nan, flattened    0.0    0.1    0.0
#   time   5.0: stage    0.0    0.1    0.0, flattened    0.0    0.1    0.0
#   time  10.0: stage    0.0    0.1    0.0, flattened    0.0    0.1    0.0
#
# Why it matters: array edits are made for fixes to a few points, such as a collar that crosses the neck from frame 5
# on. With such a fix the whole garment has no place in the frames before, nothing is printed, and Get returns an array
# of the right length, which solvers and renderers then work with.
#
# Workaround: write an edit at the first frame of the shot as well, with the value that is there anyway; or flatten.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Sdf, Usd, UsdGeom, Vt

garment = Usd.Stage.CreateNew("garment.usda")
UsdGeom.Points.Define(garment, "/Cloth").CreatePointsAttr([(0, 0, 0), (1, 0, 0), (2, 0, 0)])
garment.Save()

shot = Sdf.Layer.CreateNew("shot.usda")
shot.subLayerPaths.append("garment.usda")
stage = Usd.Stage.Open(shot)
fix = Vt.Vec3fArrayEditBuilder()
fix.Write(Gf.Vec3f(1, 0, 0.1), 1)
stage.GetAttributeAtPath("/Cloth.points").Set(fix.FinalizeAndReset(), 5)

seen = []
for time in (0.0, 4.9, 5.0, 10.0):
    row = []
    for one in (stage, Usd.Stage.Open(stage.Flatten())):
        points = one.GetAttributeAtPath("/Cloth.points").Get(time)
        row.append("".join(f"{point[2]:7.1f}" for point in points))
    print(f"time {time:5.1f}: stage{row[0]}, flattened{row[1]}")
    seen.append(row)
nothing, fixed = "    nan" * 3, "    0.0    0.1    0.0"
sys.exit(seen != [[nothing, fixed], [nothing, fixed], [fixed, fixed], [fixed, fixed]])
PY
