#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdSkel.BakeSkinning)
#
# Expected: baking a skinned garment over frames 1 to 3 writes a sample wherever the skinned points move. They move with
# the joints, and with the Xform above the skeleton, which the garment does not stand under.
#
# Seen: the Xform above the skeleton is followed only where the joints' animation has time samples. With a pose that
# stands still, one value is written and the garment stays behind; no error, and the call returns True:
#
#   pose with keys, Xform with keys:    samples [1.0, 2.0, 3.0], z at frames 1, 2, 3: [0, 1, 2]
#   pose without keys, Xform with keys: samples [], z at frames 1, 2, 3: [0, 0, 0]
#   pose without keys, Xform by spline: samples [], z at frames 1, 2, 3: [0, 0, 0]
#
# Why it matters: a mannequin in a fixed pose on a turntable, or a rider in a saddle, is dressed this way. The bake is
# the usual step before a cloth tool that knows nothing of UsdSkel, and that tool gets cloth that does not move.
#
# Workaround: write the pose's rotations (any joint attribute) as equal samples at every frame before baking.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Ts, Usd, UsdGeom, UsdSkel


def baked(pose_keys: bool, spline: bool):
    stage = Usd.Stage.CreateInMemory()
    root = UsdSkel.Root.Define(stage, "/R")
    above = UsdGeom.Xform.Define(stage, "/R/Turntable")
    bones = UsdSkel.Skeleton.Define(stage, "/R/Turntable/Bones")
    pose = UsdSkel.Animation.Define(stage, "/R/Pose")
    bones.CreateJointsAttr(["hip"])
    pose.CreateJointsAttr(["hip"])
    bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    for time in (1, 2, 3) if pose_keys else (Usd.TimeCode.Default(),):
        pose.CreateTranslationsAttr().Set([Gf.Vec3f(0)], time)
        pose.CreateRotationsAttr().Set([Gf.Quatf(1)], time)
        pose.CreateScalesAttr().Set([Gf.Vec3h(1, 1, 1)], time)
    height = above.AddTranslateZOp().GetAttr()
    curve = Ts.Spline()
    for time in (1, 2, 3):
        knot = Ts.Knot()
        knot.SetTime(time)
        knot.SetValue(time - 1.0)
        knot.SetNextInterpolation(Ts.InterpLinear)
        curve.SetKnot(knot)
        if not spline:
            height.Set(time - 1.0, time)
    if spline:
        height.SetSpline(curve)
    coat = UsdGeom.Mesh.Define(stage, "/R/Coat")
    coat.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    coat.CreateFaceVertexCountsAttr([3])
    coat.CreateFaceVertexIndicesAttr([0, 1, 2])
    bind = UsdSkel.BindingAPI.Apply(coat.GetPrim())
    bind.CreateJointIndicesPrimvar(False, 1).Set([0] * 3)
    bind.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 3)
    bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
    UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([pose.GetPath()])
    assert UsdSkel.BakeSkinning(root, Gf.Interval(1, 3))
    points = coat.GetPointsAttr()
    return points.GetTimeSamples(), [round(points.Get(time)[0][2]) for time in (1, 2, 3)]


seen = []
for name, case in (
    ("pose with keys, Xform with keys:   ", (True, False)),
    ("pose without keys, Xform with keys:", (False, False)),
    ("pose without keys, Xform by spline:", (False, True)),
):
    times, heights = baked(*case)
    print(name, f"samples {times}, z at frames 1, 2, 3: {heights}")
    seen.append((times, heights))
sys.exit(seen != [([1.0, 2.0, 3.0], [0, 1, 2]), ([], [0, 0, 0]), ([], [0, 0, 0])])
PY
