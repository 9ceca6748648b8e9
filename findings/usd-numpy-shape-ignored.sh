#!/usr/bin/env bash
# Library: usd-core 26.11 with numpy 2.4.6 (Vt arrays from numpy arrays, as in UsdAttribute.Set)
#
# Expected: a numpy array that is set as points has three columns; one of another shape is refused or, for homogeneous
# coordinates, loses its fourth column.
#
# Seen: the array is read as a plain run of numbers, and its shape does not count. Anything whose number of elements is
# a multiple of three is taken as points, without a warning:
#
#   rows x, y, z, of 4 points   shape (3, 4): 4 points, first two (0, 10, 20) (30, 1, 11)
#   homogeneous, of 6 points    shape (6, 4): 8 points, first two (0, 1, 2) (1, 3, 4)
#
# In the same way (4, 3) texture coordinates set on a texCoord2f[] become six.
#
# Why it matters: solvers keep positions as (3, N) for speed, and matrix products give (N, 4). With a number of vertices
# that divides by three, as every triangle soup has, the write succeeds and the cloth explodes; with (3, N) not even
# the number of points is wrong, so that the topology passes every check.
#
# Workaround: check `array.ndim == 2 and array.shape[1] == 3` before each Set of points.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11 numpy==2.4.6
"$tmp/venv/bin/python" - <<'PY'
import sys

import numpy as np
from pxr import Sdf, Usd, UsdGeom

stage = Usd.Stage.CreateInMemory()
points = UsdGeom.Mesh.Define(stage, "/Cloth").GetPointsAttr()
four = np.array([[0, 1, 2], [10, 11, 12], [20, 21, 22], [30, 31, 32]], dtype=np.float32)
six = np.array([[i, i + 1, i + 2, 1] for i in (0, 3, 6, 9, 12, 15)], dtype=np.float32)

seen = []
for name, array in (("rows x, y, z, of 4 points", np.ascontiguousarray(four.T)), ("homogeneous, of 6 points", six)):
    accepted = points.Set(array)
    got = [tuple(int(x) for x in point) for point in points.Get()]
    print(f"{name:<27} shape {array.shape}: {len(got)} points, first two {got[0]} {got[1]}")
    seen.append((accepted, len(got), got[:2]))
uv = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Cloth")).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray)
seen.append((uv.Set(four), len(uv.Get())))
print("(4, 3) texture coordinates become", seen[-1][1])
wanted = [(True, 4, [(0, 10, 20), (30, 1, 11)]), (True, 8, [(0, 1, 2), (1, 3, 4)]), (True, 6)]
sys.exit(seen != wanted)
PY
