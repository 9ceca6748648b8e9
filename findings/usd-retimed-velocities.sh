#!/usr/bin/env bash
# Library: usd-core 26.11 (layer offsets and UsdGeomPointBased.ComputePointsAtTime)
#
# Expected: a cloth cache with velocities that is played at half speed by a sublayer offset of scale 2 moves evenly,
# since USD maps the times of all its samples, and a renderer that asks for motion blur gets the same path.
#
# Seen: the offset changes the times of the points but leaves the numbers in `velocities` as they are, which are
# distances per second of the file that holds them. Between two samples the points go twice as far as they should and
# jump back at the next sample:
#
#   points interpolated:    0.00 0.25 0.50 0.75 1.00 1.25
#   with the velocities:    0.00 0.50 1.00 1.50 1.00 1.50
#
# Another timeCodesPerSecond in the sublayer does no harm, since that keeps seconds as they are.
#
# Why it matters: retiming a garment by an offset is common in layout. The poster frame looks right, while motion blur
# and every reader that follows velocities, as a solver does for a moving collider, shows cloth that saws to and fro.
#
# Workaround: divide the velocities by the scale in a stronger layer (accelerations by its square), or block them there
# so that readers interpolate the points.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Sdf, Usd, UsdGeom

cache = Usd.Stage.CreateNew("cache.usda")
cache.SetTimeCodesPerSecond(24)
cloth = UsdGeom.Mesh.Define(cache, "/Cloth")
for frame in range(4):  # one unit a frame, thus 24 units a second
    cloth.GetPointsAttr().Set([(frame, 0, 0)], frame)
    cloth.GetVelocitiesAttr().Set([(24, 0, 0)], frame)
cache.Save()

shot = Sdf.Layer.CreateNew("shot.usda")
shot.timeCodesPerSecond = 24
shot.subLayerPaths.append("cache.usda")
shot.subLayerOffsets[0] = Sdf.LayerOffset(0, 2)  # half speed
stage = Usd.Stage.Open(shot)
cloth = UsdGeom.Mesh(stage.GetPrimAtPath("/Cloth"))

times = [0, 0.5, 1, 1.5, 2, 2.5]
plain = [round(cloth.GetPointsAttr().Get(time)[0][0], 3) for time in times]
moved = [round(cloth.ComputePointsAtTime(time, time)[0][0], 3) for time in times]
print("points interpolated:   ", *(f"{x:.2f}" for x in plain))
print("with the velocities:   ", *(f"{x:.2f}" for x in moved))
sys.exit(plain != [0, 0.25, 0.5, 0.75, 1, 1.25] or moved != [0, 0.5, 1, 1.5, 1, 1.5])
PY
