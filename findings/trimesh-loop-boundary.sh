#!/usr/bin/env bash
# Library: trimesh 5.2.0 (remesh.subdivide_loop)
#
# Expected: Loop subdivision of a flat rectangular sheet stays within the sheet, and moving the sheet before or after
# makes no difference, since the weights of every vertex sum to one. A vertex of the border is 1/8, 3/4, 1/8 of itself
# and its two neighbours along the border.
#
# Seen: near corners that one edge cuts off, the vertex on the border also counts its neighbour across the sheet, so
# that its weights sum to 9/8. It flies out of the sheet, the farther the farther the sheet is from the origin:
#
#   sheet of 4 x 4 at 0:     new vertices span 0.000 to 4.375
#   the same sheet at 100:   new vertices span 100.000 to 116.875
#
# Why it matters: every grid cloth whose quads are cut into triangles along one diagonal has two such corners, and so
# does each sewing pattern with a corner that is one triangle. Bodies without borders never show it.
#
# Workaround: libigl's igl.loop and gpytoolbox's subdivide keep the rule; or give corners two triangles beforehand.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q trimesh==5.2.0 numpy==2.4.6 scipy==1.17.1
"$tmp/venv/bin/python" - <<'PY'
import sys

import numpy as np
import trimesh

n = 5
x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
vertices = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1).astype(float)
first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
faces = np.concatenate(
    [np.stack([first, first + n, first + n + 1], axis=1), np.stack([first, first + n + 1, first + 1], axis=1)]
)

spans = []
for offset in (0, 100):
    fine, _ = trimesh.remesh.subdivide_loop(vertices + [offset, offset, 0], faces, 1)
    spans.append((round(fine[:, :2].min(), 3), round(fine[:, :2].max(), 3)))
print("sheet of 4 x 4 at 0:     new vertices span {:.3f} to {:.3f}".format(*spans[0]))
print("the same sheet at 100:   new vertices span {:.3f} to {:.3f}".format(*spans[1]))
sys.exit(spans != [(0, 4.375), (100, 116.875)])
PY
