#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdSkel.BakeSkinning)
#
# Expected: BakeSkinning writes the skinned points over an interval of time, as a reference that others can be tested
# against. A stage baked over frames 1 to 9 then looks the same as the skinned one on each of these frames.
#
# Seen: points are written only at the times at which the animation has keys. Between two keys a joint turns on an arc,
# and the baked points go along the chord. A sleeve of length 1 on a joint that turns by 170 degrees in eight frames:
#
#   frame 1: skinned length 1.000, baked length 1.000
#   frame 3: skinned length 1.000, baked length 0.506
#   frame 5: skinned length 1.000, baked length 0.087
#   frame 9: skinned length 1.000, baked length 1.000
#
# Why it matters: hand-made animation and compressed motion have few keys. A body that was baked as the collider of a
# simulation shrinks between them, and the cloth on it is pushed, torn or left in the air.
#
# Workaround: before the bake get the rotations at every frame (and substep), and then set them there; BakeSkinning
# writes a sample of points for each, and the lengths above are all 1.000.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt

FRAMES = (1, 3, 5, 9)
stage = Usd.Stage.CreateInMemory()
root = UsdSkel.Root.Define(stage, "/R")
bones = UsdSkel.Skeleton.Define(stage, "/R/Bones")
pose = UsdSkel.Animation.Define(stage, "/R/Pose")
bones.CreateJointsAttr(["arm"])
pose.CreateJointsAttr(["arm"])
bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
pose.CreateTranslationsAttr([(0, 0, 0)])
pose.CreateScalesAttr([Gf.Vec3h(1, 1, 1)])
for time, degrees in ((1, 0), (9, 170)):
    turn = Gf.Rotation((0, 1, 0), degrees).GetQuat()
    pose.CreateRotationsAttr().Set([Gf.Quatf(turn)], time)
UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([pose.GetPath()])
sleeve = UsdGeom.Mesh.Define(stage, "/R/Sleeve")
sleeve.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 0.1, 0)])
sleeve.CreateFaceVertexCountsAttr([3])
sleeve.CreateFaceVertexIndicesAttr([0, 1, 2])
sleeve.CreateSubdivisionSchemeAttr("none")
bind = UsdSkel.BindingAPI.Apply(sleeve.GetPrim())
bind.CreateJointIndicesPrimvar(False, 1).Set([0] * 3)
bind.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 3)
bind.CreateSkeletonRel().SetTargets([bones.GetPath()])

cache = UsdSkel.Cache()
cache.Populate(root, Usd.PrimDefaultPredicate)
skinned = []
for frame in FRAMES:
    points = Vt.Vec3fArray(sleeve.GetPointsAttr().Get())
    transforms = cache.GetSkelQuery(bones).ComputeSkinningTransforms(frame)
    assert cache.GetSkinningQuery(sleeve.GetPrim()).ComputeSkinnedPoints(transforms, points, frame)
    skinned.append(round((points[1] - points[0]).GetLength(), 3))
assert UsdSkel.BakeSkinning(root, Gf.Interval(1, 9))
baked = []
for frame in FRAMES:
    points = sleeve.GetPointsAttr().Get(frame)
    baked.append(round((points[1] - points[0]).GetLength(), 3))
for frame, before, after in zip(FRAMES, skinned, baked):
    print(f"frame {frame}: skinned length {before:.3f}, baked length {after:.3f}")
seen = sleeve.GetPointsAttr().GetTimeSamples(), skinned, baked
sys.exit(seen != ([1, 9], [1, 1, 1, 1], [1, 0.506, 0.087, 1]))
PY
