#!/usr/bin/env bash
# Library: usd-core 26.11 (value clips and timeCodesPerSecond)
#
# Expected: a cache of 48 time codes per second in a stage of 24 plays in real time however it is brought in, since USD
# maps the rate of sublayers, references and payloads to that of the stage by itself.
#
# Seen: a value clip's rate is not looked at. The same file, at stage frames 0, 12 and 24 (one second):
#
#   as reference:  [0.0, 24.0, 48.0]
#   as clip:       [0.0, 12.0, 24.0]
#
# Why it matters: cloth is cached at twice the shot's rate for motion blur, and clips are how long caches are attached.
# Changing a garment from a reference to clips, which is meant to be no more than a saving in memory, makes it move at
# half speed, and beside a body that came by reference it crosses it.
#
# Workaround: write the ratio of the rates into the clips' `times`, here (0, 0), (24, 48) for (0, 0), (48, 48), or cache
# in the time codes of the stage.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Usd, UsdGeom

cache = Usd.Stage.CreateNew("cache.usda")
cache.SetTimeCodesPerSecond(48)
points = UsdGeom.Mesh.Define(cache, "/Cloth").GetPointsAttr()
for time in range(49):
    points.Set([(time, 0, 0)], time)
cache.Save()


def positions(bring_in) -> list[float]:
    stage = Usd.Stage.CreateNew(f"{bring_in.__name__}.usda")
    stage.SetTimeCodesPerSecond(24)
    cloth = UsdGeom.Mesh.Define(stage, "/Cloth")
    bring_in(cloth.GetPrim())
    return [cloth.GetPointsAttr().Get(time)[0][0] for time in (0, 12, 24)]


def reference(prim: Usd.Prim) -> None:
    prim.GetReferences().AddReference("cache.usda", "/Cloth")


def clip(prim: Usd.Prim) -> None:
    clips = Usd.ClipsAPI(prim)
    clips.SetClipAssetPaths(["cache.usda"])
    clips.SetClipPrimPath("/Cloth")
    clips.SetClipActive([(0, 0)])
    clips.SetClipTimes([(0, 0), (48, 48)])


seen = [positions(reference), positions(clip)]
print("as reference: ", seen[0])
print("as clip:      ", seen[1])
sys.exit(seen != [[0, 24, 48], [0, 12, 24]])
PY
