#!/usr/bin/env bash
# Library: libigl 2.6.3 (Python, igl.signed_distance)
#
# Expected: the signed distance to a mesh is the distance with a sign; for an open sheet the sign may be doubtful, but
# a point one unit away has a value of 1 or -1.
#
# Seen: by default the distance is multiplied by 1 - 2w, w being the winding number, which is a fraction near an open
# sheet. The value is no distance at all, and both sides of the sheet come out positive:
#
#   one unit above:  distance 1.000, signed 1.590
#   one unit below:  distance 1.000, signed 0.410
#
# Why it matters: garments, and bodies with open necks and wrists, are open. A collision test that compares the value
# with a thickness lets cloth come closer than the thickness on one side and pushes it off too early on the other.
#
# Workaround: take the length from point_mesh_squared_distance (or sign_type UNSIGNED) and the sign from pseudonormals
# (SIGNED_DISTANCE_TYPE_PSEUDONORMAL), which gives 1 and -1 here.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q libigl==2.6.3 numpy==2.4.6 scipy==1.17.1
"$tmp/venv/bin/python" - <<'PY'
import sys

import igl
import numpy as np

n = 5
x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
vertices = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1).astype(float)
first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
faces = np.concatenate(
    [np.stack([first, first + n, first + n + 1], axis=1), np.stack([first, first + n + 1, first + 1], axis=1)]
)
points = np.array([[2.0, 2.0, 1.0], [2.0, 2.0, -1.0]])

distance = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])
signed = igl.signed_distance(points, vertices, faces)[0]
by_normal = igl.signed_distance(points, vertices, faces, igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
for name, length, value in zip(("above", "below"), distance, signed):
    print(f"one unit {name}:  distance {length:.3f}, signed {value:.3f}")
print("by pseudonormals:", by_normal.round(3).tolist())
seen = distance.round(3).tolist(), signed.round(3).tolist(), by_normal.round(3).tolist()
sys.exit(seen != ([1, 1], [1.59, 0.41], [1, -1]))
PY
