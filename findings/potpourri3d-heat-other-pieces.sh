#!/usr/bin/env bash
# Library: potpourri3d 1.4.0 (MeshHeatMethodDistanceSolver)
#
# Expected: the distance along a surface to a piece that does not hang together with the source is infinite, or NaN. The
# library's fast marching solver gives inf there.
#
# Seen: the heat method gives every vertex of the other piece one finite distance, which lies well within those of the
# source's own piece and depends on how large the pieces are. Two square sheets of side 1, distances from a corner:
#
#   heat method, own piece:      0.000 to 1.428
#   heat method, other piece:    0.769 to 0.769
#   fast marching, own piece:    0.000 to 1.414
#   fast marching, other piece:  inf to inf
#
# Why it matters: a garment comes as one mesh of several pieces, such as buttons, pockets and lining. Whatever is taken
# from the distance, be it a falloff from pins or weights from the nearest seam, reaches pieces that nothing joins to
# it, and no test for inf or NaN finds them.
#
# Workaround: find the connected components first, and solve for each or set the others to inf.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q potpourri3d==1.4.0 numpy==2.4.6 scipy==1.17.1
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

import numpy as np
import potpourri3d

side = np.linspace(0, 1, 11)
sheet = np.array([(x, y, 0) for y in side for x in side])
corners = [11 * row + column for row in range(10) for column in range(10)]
faces = np.array([face for c in corners for face in ((c, c + 1, c + 12), (c, c + 12, c + 11))])
both, both_faces = np.concatenate([sheet, sheet + (0, 0, 1)]), np.concatenate([faces, faces + len(sheet)])

heat = potpourri3d.MeshHeatMethodDistanceSolver(both, both_faces).compute_distance(0)
march = potpourri3d.MeshFastMarchingDistanceSolver(both, both_faces).compute_distance([[(0, [])]])
parts = []
for name, distance in (("heat method", heat), ("fast marching", march)):
    for piece, part in (("own piece:  ", distance[: len(sheet)]), ("other piece:", distance[len(sheet) :])):
        print(f"{name + ', ' + piece:<28} {part.min():.3f} to {part.max():.3f}")
        parts.append(part)
within = 0 < parts[1].min() and parts[1].max() < parts[0].max()
sys.exit(not (within and np.ptp(parts[1]) < 1e-6 and np.isinf(parts[3]).all() and np.isfinite(parts[2]).all()))
PY
