#!/usr/bin/env bash
# Library: trimesh 5.2.0 (smoothing.filter_laplacian)
#
# Expected: Laplacian smoothing moves each vertex towards its neighbours, so the result stays within the sheet's bounds.
# Moving the sheet before or after makes no difference. The filter also rescales by default, to restore the volume;
# about the centre of mass, as its documentation says, that keeps the place too.
#
# Seen: for an open sheet both the volume and the centre of mass depend on where the origin is, and so the rescaling
# throws the sheet away, the farther the farther it is from the origin. A wavy sheet, 1 by 1, after 10 iterations:
#
#   sheet at height   0: mean height goes from    0.00 to     -0.02
#   sheet at height 100: mean height goes from  100.00 to -52159.87
#   the same with volume_constraint=False:       100.00 to    100.02
#
# A flat sheet becomes NaN, with a warning of a division by zero.
#
# Why it matters: garments are open, and smoothing them a little to remove noise is a common last step. What is lost
# is the place: the size hardly changes, so that a view that frames the object looks right.
#
# Workaround: volume_constraint=False, or filter_taubin, which keeps the place.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q trimesh==5.2.0 scipy==1.17.1 numpy==2.4.6
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

import numpy as np
import trimesh

side = np.linspace(0, 1, 5)
sheet = np.array([(x, y, 0.3 * np.sin(5 * x) * y) for y in side for x in side])
sheet[:, 2] -= sheet[:, 2].mean()
corners = [5 * row + column for row in range(4) for column in range(4)]
faces = [face for c in corners for face in ((c, c + 1, c + 6), (c, c + 6, c + 5))]


def smooth(points, **options):
    mesh = trimesh.Trimesh(points, faces, process=False)
    trimesh.smoothing.filter_laplacian(mesh, iterations=10, **options)
    return mesh.vertices


results = []
for height in (0, 100):
    result = smooth(sheet + (0, 0, height))
    print(f"sheet at height {height:3d}: mean height goes from {height:7.2f} to {result[:, 2].mean():9.2f}")
    results.append(result)
free = smooth(sheet + (0, 0, 100), volume_constraint=False)
print(f"the same with volume_constraint=False:       100.00 to {free[:, 2].mean():9.2f}")
with np.errstate(all="ignore"):
    flat = smooth(sheet * (1, 1, 0))
thrown = abs(results[1][:, 2].mean() - 100) > 1000
same_size = np.allclose(np.ptp(results[0], axis=0), np.ptp(results[1], axis=0), rtol=1e-3)
stays = abs(free[:, 2].mean() - 100) < 0.1
sys.exit(not (thrown and same_size and stays and np.isnan(flat).all()))
PY
