#!/usr/bin/env bash
# Library: libigl 2.6.3 (Python, igl.hausdorff)
#
# Expected: igl.hausdorff returns the Hausdorff distance of two meshes. Its documentation gives the formula, a maximum
# over all points of both surfaces, so 0 means that the two surfaces are the same.
#
# Seen: only the vertices of each mesh are compared with the surface of the other. A quad that is not flat, cut along
# one diagonal and along the other, gives two surfaces of the same four vertices, and the distance 0. The Python
# documentation does not mention it.
#
#   igl.hausdorff:                                0.000
#   the middle of one surface to the other:       0.577
#   igl.hausdorff with both upsampled four times: 0.577
#
# Why it matters: two tools that cut quads into triangles differently, and refinement that moves the surface within its
# faces, are what this distance is used to find. A retriangulated cage, or a coat whose coarse faces cut through a
# body between its vertices, passes as equal.
#
# Workaround: upsample both meshes (igl.upsample) until the value settles; each vertex of the finer mesh is a sample.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q libigl==2.6.3 numpy==2.4.6 scipy==1.17.1
"$tmp/venv/bin/python" - <<'PY'
import sys

import igl
import numpy as np

vertices = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 0], [0, 1, 1]], dtype=float)
one, other = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1, 3], [1, 2, 3]])
middle = vertices[[0, 2]].mean(axis=0, keepdims=True)  # on the diagonal of the first surface

plain = igl.hausdorff(vertices, one, vertices, other)
true = np.sqrt(igl.point_mesh_squared_distance(middle, vertices, other)[0])[0]
fine = igl.hausdorff(*igl.upsample(vertices, one, 4), *igl.upsample(vertices, other, 4))
print(f"igl.hausdorff:                                {plain:.3f}")
print(f"the middle of one surface to the other:       {true:.3f}")
print(f"igl.hausdorff with both upsampled four times: {fine:.3f}")
sys.exit([round(value, 3) for value in (plain, true, fine)] != [0, 0.577, 0.577])
PY
