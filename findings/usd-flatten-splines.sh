#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdUtils.FlattenLayerStack and splines)
#
# Expected: flattening a layer stack gives one layer that resolves to the same values, sublayer offsets applied. USD
# does apply them to splines: the stage reads a retimed spline at the right times, and Usd.Stage.Flatten keeps that.
#
# Seen: UsdUtils.FlattenLayerStack maps time samples and leaves splines as they stood in the sublayer. For a value that
# goes from 0 to 10 over frames 0 to 10, in a sublayer that is shifted by 100 frames, at frame 105:
#
#   keyed by            stage   Stage.Flatten   FlattenLayerStack
#   time samples          5.0             5.0                 5.0
#   spline                5.0             5.0                10.0
#
# Why it matters: FlattenLayerStack is the gentle flatten that keeps references, and what publishing tools call before
# they hand a shot on. With it a prop or a mannequin that is moved by splines is at another place than the cloth cache
# that was made on it, with no warning, while everything keyed by samples fits.
#
# Workaround: flatten by Usd.Stage.Flatten, or sample the splines of retimed sublayers before flattening.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Sdf, Ts, Usd, UsdGeom, UsdUtils

motion = Usd.Stage.CreateNew("motion.usda")
curve = Ts.Spline()
samples = UsdGeom.Xform.Define(motion, "/Samples").AddTranslateXOp().GetAttr()
for time in (0, 10):
    knot = Ts.Knot()
    knot.SetTime(time)
    knot.SetValue(float(time))
    knot.SetNextInterpolation(Ts.InterpLinear)
    curve.SetKnot(knot)
    samples.Set(float(time), time)
UsdGeom.Xform.Define(motion, "/Spline").AddTranslateXOp().GetAttr().SetSpline(curve)
motion.Save()

shot = Sdf.Layer.CreateNew("shot.usda")
shot.subLayerPaths.append("motion.usda")
shot.subLayerOffsets[0] = Sdf.LayerOffset(100)
stage = Usd.Stage.Open(shot)
stages = [stage, Usd.Stage.Open(stage.Flatten()), Usd.Stage.Open(UsdUtils.FlattenLayerStack(stage))]

print("keyed by            stage   Stage.Flatten   FlattenLayerStack")
seen = []
for name, path in (("time samples", "/Samples"), ("spline", "/Spline")):
    values = [one.GetAttributeAtPath(path + ".xformOp:translateX").Get(105) for one in stages]
    print(f"{name:<12}{values[0]:>13}{values[1]:>16}{values[2]:>20}")
    seen.append(values)
sys.exit(seen != [[5, 5, 5], [5, 5, 10]])
PY
