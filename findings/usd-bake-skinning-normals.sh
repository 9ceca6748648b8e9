#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdSkel.BakeSkinning)
#
# Expected: BakeSkinning turns a skinned garment's normals along with its points. USD names two places for normals, the
# attribute `normals` and the primvar `primvars:normals`, and says that the primvar wins where both are there.
#
# Seen: only `normals` is baked. Normals in `primvars:normals` keep the rest pose, and they are the ones that win. With
# the only joint turned by 90 degrees about y:
#
#   point (1, 0, 0) goes to (0.0, 0.0, -1.0)
#   normals          (0, 0, 1) -> (1.0, 0.0, 0.0)
#   primvars:normals (0, 0, 1) -> (0.0, 0.0, 1.0)
#
# Why it matters: exporters that write indexed or face-varying normals use the primvar. After the bake the cloth moves,
# and it is shaded, or thickened along its normals by the next tool, as if it still hung in the rest pose.
#
# Workaround: move the normals to the attribute `normals` (flattened) and remove the primvar before baking, or drop
# both, since normals of a subdivided mesh come from its surface.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel

stage = Usd.Stage.CreateInMemory()
root = UsdSkel.Root.Define(stage, "/R")
bones = UsdSkel.Skeleton.Define(stage, "/R/Bones")
pose = UsdSkel.Animation.Define(stage, "/R/Pose")
bones.CreateJointsAttr(["hip"])
pose.CreateJointsAttr(["hip"])
bones.CreateBindTransformsAttr([Gf.Matrix4d(1)])
bones.CreateRestTransformsAttr([Gf.Matrix4d(1)])
for time in (1, 2):
    turn = Gf.Rotation((0, 1, 0), 90 * (time - 1)).GetQuat()
    pose.CreateTranslationsAttr().Set([Gf.Vec3f(0)], time)
    pose.CreateRotationsAttr().Set([Gf.Quatf(turn)], time)
    pose.CreateScalesAttr().Set([Gf.Vec3h(1, 1, 1)], time)
UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([pose.GetPath()])


def coat(name: str) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, f"/R/{name}")
    mesh.CreatePointsAttr([(1, 0, 0), (0, 1, 0), (0, 0, 0)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateSubdivisionSchemeAttr("none")
    bind = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    bind.CreateJointIndicesPrimvar(False, 1).Set([0] * 3)
    bind.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 3)
    bind.CreateSkeletonRel().SetTargets([bones.GetPath()])
    return mesh


attribute, primvar = coat("Attribute"), coat("Primvar")
attribute.CreateNormalsAttr([(0, 0, 1)] * 3)
attribute.SetNormalsInterpolation("vertex")
normals = UsdGeom.PrimvarsAPI(primvar).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "vertex")
normals.Set([(0, 0, 1)] * 3)
assert UsdSkel.BakeSkinning(root, Gf.Interval(1, 2))


def rounded(vector) -> tuple:
    return tuple(round(x, 3) + 0.0 for x in vector)


seen = [rounded(values.Get(2)[0]) for values in (primvar.GetPointsAttr(), attribute.GetNormalsAttr(), normals)]
print("point (1, 0, 0) goes to", seen[0])
print("normals          (0, 0, 1) ->", seen[1])
print("primvars:normals (0, 0, 1) ->", seen[2])
sys.exit(seen != [(0, 0, -1), (1, 0, 0), (0, 0, 1)])
PY
