#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdSkel: BakeSkinning, and all queries of UsdSkel.Cache)
#
# Expected: OpenUSD's page on the UsdSkel schemas ("Binding Skeletons") says that skel:animationSource applies where
# skel:skeleton is bound, at the same prim or below. One Skeleton may then be bound twice, with two animations; the page
# shows such a scene and counts two skeleton instances, each with its own animation.
#
# Seen: the animation is looked up at the Skeleton prim and its ancestors alone. Beside the binding it has no effect:
# the garments stay in the rest pose, no warning is given, and BakeSkinning returns True. With animations that move the
# only joint by 10 and by 20:
#
#   one Skeleton bound twice, an animation at each binding: moved by 0 and 0
#   the same, and the first animation at the Skeleton too:  moved by 10 and 10
#
# Why it matters: two actors in one costume, or a garment file that brings its motion and binds to the body's Skeleton,
# are built by this page. The garments stand in the rest pose in the middle of the shot, and cloth is refined there.
#
# Workaround: one Skeleton prim for each animation (an instance will do), and skel:animationSource at the Skeleton or
# above it.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Usd, UsdGeom, UsdSkel


def moved(at_skeleton: bool) -> list[float]:
    stage = Usd.Stage.CreateInMemory()
    root = UsdSkel.Root.Define(stage, "/World")
    bones = UsdSkel.Skeleton.Define(stage, "/World/Bones")
    bones.CreateJointsAttr(["hip"])
    bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    coats = []
    for place, shift in (("/World/A", 10), ("/World/A/C", 20)):
        motion = UsdSkel.Animation.Define(stage, f"/World/Motion{shift}")
        motion.CreateJointsAttr(["hip"])
        motion.CreateTranslationsAttr([(shift, 0, 0)])
        motion.CreateRotationsAttr([Gf.Quatf(1)])
        motion.CreateScalesAttr([Gf.Vec3h(1, 1, 1)])
        binding = UsdSkel.BindingAPI.Apply(UsdGeom.Xform.Define(stage, place).GetPrim())
        binding.CreateSkeletonRel().SetTargets([bones.GetPath()])
        binding.CreateAnimationSourceRel().SetTargets([motion.GetPath()])
        coat = UsdGeom.Mesh.Define(stage, f"{place}/Coat")
        coat.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
        coat.CreateFaceVertexCountsAttr([3])
        coat.CreateFaceVertexIndicesAttr([0, 1, 2])
        skin = UsdSkel.BindingAPI.Apply(coat.GetPrim())
        skin.CreateJointIndicesPrimvar(False, 1).Set([0] * 3)
        skin.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 3)
        coats.append(coat)
    if at_skeleton:
        UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets(["/World/Motion10"])
    assert UsdSkel.BakeSkinning(root)
    return [coat.GetPointsAttr().Get()[0][0] for coat in coats]


seen = moved(at_skeleton=False), moved(at_skeleton=True)
print("one Skeleton bound twice, an animation at each binding: moved by {:.0f} and {:.0f}".format(*seen[0]))
print("the same, and the first animation at the Skeleton too:  moved by {:.0f} and {:.0f}".format(*seen[1]))
sys.exit(seen != ([0, 0], [10, 10]))
PY
