#!/usr/bin/env bash
# Libraries: libigl 2.6.3 (igl.exact_geodesic) and potpourri3d 1.4.0 (MeshHeatMethodDistanceSolver)
#
# Expected: the distance along a surface to a piece that does not hang together with the source is infinite, or NaN. The
# fast marching solver of potpourri3d gives inf there.
#
# Seen: exact_geodesic of libigl gives 0, as if all of the other piece were the source. The heat method gives each
# vertex there one finite distance, well within those of the source's own piece. For two square sheets of side 1, from
# a corner of one:
#
#   libigl, exact                own piece 0.000 to 1.414, other piece 0.000 to 0.000
#   potpourri3d, heat method     own piece 0.000 to 1.428, other piece 0.769 to 0.769
#   potpourri3d, fast marching   own piece 0.000 to 1.414, other piece inf to inf
#
# Why it matters: a garment comes as one mesh of several pieces, such as buttons, pockets and lining. Whatever is taken
# from the distance, be it a falloff from pins or weights from the nearest seam, reaches pieces that nothing joins to
# it, and no test for inf or NaN finds them.
#
# Workaround: find the connected components first, and set the distance to pieces without a source to inf.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q libigl==2.6.3 potpourri3d==1.4.0 numpy==2.4.6 scipy==1.17.1
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

import igl
import numpy as np
import potpourri3d

side = np.linspace(0, 1, 11)
sheet = np.array([(x, y, 0) for y in side for x in side])
corners = [11 * row + column for row in range(10) for column in range(10)]
faces = np.array([face for c in corners for face in ((c, c + 1, c + 12), (c, c + 12, c + 11))])
both, both_faces = np.concatenate([sheet, sheet + (0, 0, 1)]), np.concatenate([faces, faces + len(sheet)])

none, targets = np.array([], int), np.arange(len(both))
exact = igl.exact_geodesic(both, both_faces, np.array([0]), none, targets, none)
heat = potpourri3d.MeshHeatMethodDistanceSolver(both, both_faces).compute_distance(0)
march = potpourri3d.MeshFastMarchingDistanceSolver(both, both_faces).compute_distance([[(0, [])]])
names = ("libigl, exact", "potpourri3d, heat method", "potpourri3d, fast marching")
for name, distance in zip(names, (exact, heat, march), strict=True):
    own, other = (f"{part.min():.3f} to {part.max():.3f}" for part in np.split(distance, 2))
    print(f"{name:<28} own piece {own}, other piece {other}")
own, other = np.split(heat, 2)
within = 0 < other.min() and other.max() < own.max() and np.ptp(other) < 1e-6
sys.exit(not (within and not exact[len(sheet) :].any() and np.isinf(march[len(sheet) :]).all()))
PY
