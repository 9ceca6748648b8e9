#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdGeom.BBoxCache and velocities)
#
# Expected: the bound of a moving prim at a time holds its points at that time. For point instancers it does: it is
# computed from the positions moved along their velocities. Meshes have the same attributes, and the same rule for
# points between samples (UsdGeom.PointBased.ComputePointsAtTime).
#
# Seen: for meshes the bound leaves velocities out and interpolates the points. A button, as a mesh and as an instance,
# which is tossed up from height 0 at frame 0 and has its next sample at frame 10, at 0 again; its height, and where the
# bound begins and ends:
#
#   frame  5.0: instance at 5.0, bound 5.0 to 5.0; mesh at 5.0, bound 0.0 to 0.0
#   frame  9.0: instance at 9.0, bound 9.0 to 9.0; mesh at 9.0, bound 0.0 to 0.0
#   frame 10.0: instance at 0.0, bound 0.0 to 0.0; mesh at 0.0, bound 0.0 to 0.0
#
# Why it matters: cloth caches of few samples lean on velocities, and bounds choose what is tested for contact, what
# a camera sees and which tiles a renderer keeps. Between samples the cloth is at places that its bound does not hold.
#
# Workaround: compute bounds of such prims from the points (UsdGeom.PointBased.ComputeExtent of ComputePointsAtTime).
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Usd, UsdGeom

stage = Usd.Stage.CreateInMemory()
stage.SetTimeCodesPerSecond(24)
corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
mesh = UsdGeom.Mesh.Define(stage, "/Mesh")
instancer = UsdGeom.PointInstancer.Define(stage, "/Instances")
button = UsdGeom.Mesh.Define(stage, "/Instances/Button")
for prim in (mesh, button):
    prim.CreateFaceVertexCountsAttr([3])
    prim.CreateFaceVertexIndicesAttr([0, 1, 2])
button.CreatePointsAttr(corners)
instancer.CreatePrototypesRel().SetTargets([button.GetPath()])
instancer.CreateProtoIndicesAttr([0])
for frame, speed in ((0, 24), (10, -24)):
    mesh.GetPointsAttr().Set(corners, frame)
    mesh.GetVelocitiesAttr().Set([(0, 0, speed)] * 3, frame)
    instancer.GetPositionsAttr().Set([(0, 0, 0)], frame)
    instancer.GetVelocitiesAttr().Set([(0, 0, speed)], frame)

seen = []
for frame in (5.0, 9.0, 10.0):
    cache = UsdGeom.BBoxCache(frame, ["default"])
    heights = (
        instancer.ComputeInstanceTransformsAtTime(frame, frame)[0].ExtractTranslation()[2],
        mesh.ComputePointsAtTime(frame, frame)[0][2],
    )
    row = []
    for schema, height in zip((instancer, mesh), heights, strict=True):
        bound = cache.ComputeWorldBound(schema.GetPrim()).ComputeAlignedRange()
        row += [round(number, 4) for number in (height, bound.GetMin()[2], bound.GetMax()[2])]
    said = "instance at {:.1f}, bound {:.1f} to {:.1f}; mesh at {:.1f}, bound {:.1f} to {:.1f}".format(*row)
    print(f"frame {frame:4.1f}: {said}")
    seen.append(row)
sys.exit(seen != [[5, 5, 5, 5, 0, 0], [9, 9, 9, 9, 0, 0], [0, 0, 0, 0, 0, 0]])
PY
