#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdUtils.SparseAttrValueWriter)
#
# Expected: the sparse writer leaves out samples that add nothing, values being the same within a small relative
# difference. For float that is about one part in a million, and for half some last digit, 0.001 at 1.
#
# Seen: halves count as the same within 0.01, whatever their size: ten steps of a half at 1, and hundreds near 0. Values
# that grow evenly over frames 0 to 10:
#
#   half  from 0 to 0.009: samples [0.0], at frame 10: 0.0000
#   half  from 1 to 1.009: samples [0.0], at frame 10: 1.0000
#   float from 0 to 0.009: all 11 samples, at frame 10: 0.0090
#
# half3[], which is the type of scales in UsdSkel animations, goes the same way.
#
# Why it matters: exporters write animation through this class. A chest that breathes by 0.9 percent stands still after
# the export, and the shirt that was simulated over the moving chest crosses it or stands off; small values, such as
# masks and thicknesses in metres that are kept as half, are gone altogether.
#
# Workaround: write half attributes by Set.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Sdf, Usd, UsdUtils

stage = Usd.Stage.CreateInMemory()
prim = stage.DefinePrim("/Prim")


def write(kind, first, last):
    attribute = prim.CreateAttribute(f"a{len(prim.GetAttributes())}", Sdf.ValueTypeNames.Find(kind))
    writer = UsdUtils.SparseAttrValueWriter(attribute)
    for frame in range(11):
        value = first + (last - first) * frame / 10
        writer.SetTimeSample([Gf.Vec3h(value)] if kind == "half3[]" else value, frame)
    return attribute.GetTimeSamples(), attribute.Get(10)


seen = []
for kind, first, last in (("half", 0, 0.009), ("half", 1, 1.009), ("float", 0, 0.009)):
    times, value = write(kind, first, last)
    listed = "all 11 samples" if len(times) == 11 else f"samples {times}"
    print(f"{kind:<5} from {first} to {last}: {listed}, at frame 10: {value:.4f}")
    seen.append((len(times), round(value, 4)))
times, value = write("half3[]", 1, 1.009)
seen.append((len(times), tuple(value[0])))
sys.exit(seen != [(1, 0), (1, 1), (11, 0.009), (1, (1, 1, 1))])
PY
