#!/usr/bin/env bash
# Library: usd-core 26.11 (array edits in time samples)
#
# Expected: an array edit at frame 5 writes the elements that it names, over the value that the weaker layer has at
# frame 5. Elements that no edit names go on as the weaker layer has them.
#
# Seen: where the weaker layer has no sample at that very frame, the edit is laid over its last sample before, and not
# over the value between its samples. The edit thereby writes all elements: points that it does not name stand still
# until frame 5 and then hurry. Heights of points 0 and 2, which rise by 10 in 10 frames while point 1 is edited:
#
#   frame               0.0    2.5    5.0    7.5   10.0
#   without the edit    0.0    2.5    5.0    7.5   10.0
#   with it             0.0    0.0    0.0    5.0   10.0
#
# An edit in the default, which holds for all times, does follow the motion.
#
# Why it matters: array edits are for fixes to a few points over a cache that others made. Simulated cloth has samples
# at its own steps, and an edit between them stops the rest of the garment while the body moves on below it.
#
# Workaround: write edits at times that the weaker layer has samples at, or a default edit where the fix is the same
# throughout.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Sdf, Usd, UsdGeom, Vt

cache = Usd.Stage.CreateNew("cache.usda")
points = UsdGeom.Points.Define(cache, "/Cloth").GetPointsAttr()
for time in (0, 10):
    points.Set([(x, 0, time) for x in range(3)], time)
cache.Save()

shot = Sdf.Layer.CreateNew("shot.usda")
shot.subLayerPaths.append("cache.usda")
stage = Usd.Stage.Open(shot)
points = stage.GetAttributeAtPath("/Cloth.points")
frames = (0, 2.5, 5, 7.5, 10)


def show(name):
    values = [points.Get(frame) for frame in frames]
    heights = [value[0][2] for value in values]
    assert heights == [value[2][2] for value in values]
    print(f"{name:<16}" + "".join(f"{height:7.1f}" for height in heights))
    return heights


print(f"{'frame':<16}" + "".join(f"{frame:7.1f}" for frame in frames))
before = show("without the edit")
fix = Vt.Vec3fArrayEditBuilder()
fix.Write(Gf.Vec3f(1, 0, 20), 1)
points.Set(fix.FinalizeAndReset(), 5)
after = show("with it")
assert points.Get(5)[1] == (1, 0, 20)
points.ClearAtTime(5)
fix.Write(Gf.Vec3f(1, 0, 20), 1)
points.Set(fix.FinalizeAndReset())
default = [points.Get(frame)[0][2] for frame in frames]
sys.exit([before, after, default] != [[0, 2.5, 5, 7.5, 10], [0, 0, 0, 5, 10], [0, 2.5, 5, 7.5, 10]])
PY
