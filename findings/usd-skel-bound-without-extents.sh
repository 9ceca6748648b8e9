#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdGeom.BBoxCache on a UsdSkel.Root)
#
# Expected: extents that are not authored are computed from the points, and the bound of a character holds what is worn
# on it. UsdGeom.BBoxCache does the first for a mesh under any other prim.
#
# Seen: under a SkelRoot the bound is that of the joints, padded by the authored extents of the skinned meshes. Where
# those have none they are not computed: the bound is the joints alone, and of one joint a single point. A coat from
# (-1, -1, -1) to (1, 1, 1) on one joint, whose pose is 5 to the right:
#
#   under an Xform, no extent:     (-1, -1, -1) to (1, 1, 1)
#   under a SkelRoot, extent:      (4, -1, -1) to (6, 1, 1)
#   under a SkelRoot, no extent:   (5, 0, 0) to (5, 0, 0)
#
# Why it matters: files written by scripts often leave extents out, and everything works until the first skeleton. The
# bound decides what is in the camera's view, which props a simulation looks at, and how far a camera is set back to
# frame it.
#
# Workaround: author extents on skinned meshes (UsdGeom.PointBased.ComputeExtent of the rest points).
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import itertools
import sys

from pxr import Gf, Usd, UsdGeom, UsdSkel

corners = list(itertools.product((-1, 1), repeat=3))
shown = []
for root, extent in (("Xform", False), ("SkelRoot", True), ("SkelRoot", False)):
    stage = Usd.Stage.CreateInMemory()
    top = stage.DefinePrim("/Character", root)
    coat = UsdGeom.Mesh.Define(stage, "/Character/Coat")
    coat.CreatePointsAttr(corners)
    coat.CreateFaceVertexCountsAttr([4] * 6)
    sides = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
    coat.CreateFaceVertexIndicesAttr(sides)
    if extent:
        coat.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
    if root == "SkelRoot":
        bones = UsdSkel.Skeleton.Define(stage, "/Character/Bones")
        bones.CreateJointsAttr(["chest"])
        bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
        bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
        pose = UsdSkel.Animation.Define(stage, "/Character/Bones/Pose")
        pose.CreateJointsAttr(["chest"])
        pose.SetTransforms([Gf.Matrix4d(1).SetTranslate((5, 0, 0))], Usd.TimeCode.Default())
        UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([pose.GetPath()])
        bind = UsdSkel.BindingAPI.Apply(coat.GetPrim())
        bind.CreateJointIndicesPrimvar(False, 1).Set([0] * 8)
        bind.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 8)
        bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
    bound = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(top).ComputeAlignedRange()
    low, high = (tuple(int(number) for number in corner) for corner in (bound.GetMin(), bound.GetMax()))
    name = f"under {'an' if root == 'Xform' else 'a'} {root}, {'extent' if extent else 'no extent'}:"
    print(f"{name:<30} {low} to {high}")
    shown.append((low, high))
sys.exit(shown != [((-1, -1, -1), (1, 1, 1)), ((4, -1, -1), (6, 1, 1)), ((5, 0, 0), (5, 0, 0))])
PY
