#!/usr/bin/env bash
# Library: usd-core 25.5.1 and 25.11 (layer offsets of negative scale)
#
# Expected: a sublayer offset of scale -1 plays a cache backwards, and if a version no longer can, opening fails. Times
# of samples come in rising order, as code that searches them by bisection supposes.
#
# Seen: the same two files mean opposite motions. 25.5.1 plays them backwards and hands the times out in falling order;
# 25.11 (and 26.11) plays them forwards and unshifted, with a warning on stderr as its only sign:
#
#   usd-core 25.5.1  times [10.0, 9.0, 8.0, 5.0], at 5, 8 and 10: [5.0, 2.0, 0.0]
#   usd-core 25.11   times [0.0, 1.0, 2.0, 5.0], at 5, 8 and 10: [5.0, 5.0, 5.0]
#
# Why it matters: reversed clips are in old shots. After an upgrade, cloth that is refined from such a shot follows
# another motion than the plates show; before it, a reader that takes the first and the last sample for the start and
# the end gets them the wrong way round.
#
# Workaround: write the reversed samples into a layer of their own, and sort what GetTimeSamples returns.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
cd "$tmp"
cat >read.py <<'PY'
from pxr import Sdf, Usd, UsdGeom

motion = Usd.Stage.CreateNew("motion.usda")
height = UsdGeom.Xform.Define(motion, "/Cloth").AddTranslateZOp().GetAttr()
for time in (0, 1, 2, 5):
    height.Set(float(time), time)
motion.Save()
shot = Sdf.Layer.CreateNew("shot.usda")
shot.subLayerPaths.append("motion.usda")
shot.subLayerOffsets[0] = Sdf.LayerOffset(10, -1)
stage = Usd.Stage.Open(shot)
height = stage.GetAttributeAtPath("/Cloth.xformOp:translateZ")
print(f"times {height.GetTimeSamples()}, at 5, 8 and 10: {[height.Get(time) for time in (5, 8, 10)]}")
PY
for version in 25.5.1 25.11; do
    python3 -m venv "$tmp/$version"
    "$tmp/$version/bin/pip" install -q "usd-core==$version"
    mkdir "in-$version"
    (cd "in-$version" && "$tmp/$version/bin/python" ../read.py >seen.txt)
    printf 'usd-core %-7s %s\n' "$version" "$(cat "in-$version/seen.txt")"
done
grep -qxF 'times [10.0, 9.0, 8.0, 5.0], at 5, 8 and 10: [5.0, 2.0, 0.0]' in-25.5.1/seen.txt || exit 1
grep -qxF 'times [0.0, 1.0, 2.0, 5.0], at 5, 8 and 10: [5.0, 5.0, 5.0]' in-25.11/seen.txt || exit 1
