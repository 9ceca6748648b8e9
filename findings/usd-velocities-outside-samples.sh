#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdGeomPointBased.ComputePointsAtTime)
#
# Expected: before its first and after its last sample an attribute in USD holds its value, so cloth that was cached for
# frames 1 and 2 stands still at frame 100.
#
# Seen: where velocities are authored the first or last sample is moved on along its velocity, however far away the time
# is, and backwards in time too:
#
#   time     1.0: points     0.0, computed     0.0
#   time     2.0: points     1.0, computed     1.0
#   time     3.0: points     1.0, computed     2.0
#   time   100.0: points     1.0, computed    99.0
#   time  -100.0: points     0.0, computed  -101.0
#
# Why it matters: simulation caches end at the shot's last frame, renderers open their shutter past it, and handles are
# often cut off. A coat that both readers agree on at every cached frame leaves its body at the next one.
#
# Workaround: author one more sample just outside each end of the cache, with the same points and zero velocities, or
# clamp the time to the range of the points' samples before asking.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Usd, UsdGeom

stage = Usd.Stage.CreateInMemory()
stage.SetTimeCodesPerSecond(24)
cloth = UsdGeom.Mesh.Define(stage, "/Cloth")
for frame in (1, 2):  # one unit a frame
    cloth.GetPointsAttr().Set([(frame - 1, 0, 0)], frame)
    cloth.GetVelocitiesAttr().Set([(24, 0, 0)], frame)

seen = []
for time in (1.0, 2.0, 3.0, 100.0, -100.0):
    held, moved = cloth.GetPointsAttr().Get(time)[0][0], cloth.ComputePointsAtTime(time, time)[0][0]
    print(f"time {time:7.1f}: points {held:7.1f}, computed {moved:7.1f}")
    seen.append((held, moved))
sys.exit(seen != [(0, 0), (1, 1), (1, 2), (1, 99), (0, -101)])
PY
