#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdSkel.SkeletonQuery.ComputeSkinningTransforms)
#
# Expected: a skeleton without bindTransforms has no skinning transforms: in C++ the call returns false. From Python it
# gives nothing, or raises, and garments stay as authored, as UsdSkel.BakeSkinning leaves them.
#
# Seen: from Python the call gives an array of the right length with the joints' poses in it, that is the part of the
# product that was done before the failure. ComputeSkinnedPoints takes it and returns True. A garment around a hip one
# unit above the ground is moved up by one more unit; a line on the diagnostics is all there is:
#
#   bind pose given: HasBindPose True, transforms 1, heights skinned [1, 1, 1], by BakeSkinning [1, 1, 1]
#   bind pose left out: HasBindPose False, transforms 1, heights skinned [2, 2, 2], by BakeSkinning [1, 1, 1]
#
# Why it matters: exporters leave bindTransforms out for rigs whose bind pose they take to be the rest pose. A tool that
# skins by these queries puts the cloth elsewhere than one that bakes.
#
# Workaround: ask SkeletonQuery.HasBindPose first.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cat >"$tmp/pose.py" <<'PY'
import sys

from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt


def heights(points) -> list[int]:
    return [round(point[1]) for point in points]


def skinned(bound: bool):
    stage = Usd.Stage.CreateInMemory()
    root = UsdSkel.Root.Define(stage, "/character")
    skeleton = UsdSkel.Skeleton.Define(stage, "/character/skeleton")
    hip = Gf.Matrix4d().SetTranslate((0, 1, 0))
    skeleton.CreateJointsAttr(["hip"])
    skeleton.CreateRestTransformsAttr([hip])
    if bound:
        skeleton.CreateBindTransformsAttr([hip])
    mesh = UsdGeom.Mesh.Define(stage, "/character/belt")
    mesh.CreatePointsAttr([(0, 1, 0), (1, 1, 0), (0, 1, 1)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(True, 1).Set([0])
    binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    pose, influences = cache.GetSkelQuery(skeleton), cache.GetSkinningQuery(mesh.GetPrim())
    transforms, points = pose.ComputeSkinningTransforms(1), Vt.Vec3fArray(mesh.GetPointsAttr().Get())
    taken = influences.ComputeSkinnedPoints(transforms, points, 1)
    assert taken and UsdSkel.BakeSkinning(root, Gf.Interval.GetFullInterval())
    return pose.HasBindPose(), len(transforms), heights(points), heights(mesh.GetPointsAttr().Get(1))


seen = [skinned(True), skinned(False)]
for name, (bind, count, queried, baked) in zip(("given:", "left out:"), seen):
    print(f"bind pose {name} HasBindPose {bind}, transforms {count}, heights skinned {queried}, by BakeSkinning {baked}")
sys.exit(seen != [(True, 1, [1, 1, 1], [1, 1, 1]), (False, 1, [2, 2, 2], [1, 1, 1])])
PY
"$tmp/venv/bin/python" "$tmp/pose.py"
