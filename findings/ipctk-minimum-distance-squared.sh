#!/usr/bin/env bash
# Library: ipctk 1.6.1 (NormalCollisions.compute_minimum_distance)
#
# Expected: the documentation promises "the minimum distance between any non-adjacent elements", and build() of the same
# class takes its threshold dhat as a distance. Two sheets 0.1 apart have a minimum distance of 0.1.
#
# Seen: the value is the square of the distance. The documentation of point_point_distance and its sisters says so of
# them; that of compute_minimum_distance does not (open since 2023 as issue 40 of ipc-toolkit). With dhat over the gap:
#
#   gap  0.1, dhat  0.2: minimum distance 0.01
#   gap  1.0, dhat  2.0: minimum distance 1.0
#   gap 10.0, dhat 20.0: minimum distance 100.0
#
# Why it matters: the value is what shows that cloth keeps its thickness. In meters a gap of a millimeter reads as a
# micrometer; in centimeters near cloth reads as far apart. At a gap of one unit, which a first test often uses, the
# two are equal.
#
# Workaround: take the square root.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q ipctk==1.6.1 numpy==2.4.6 scipy==1.17.1
"$tmp/venv/bin/python" - <<'PY'
import sys

import ipctk
import numpy as np

n = 4
x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
sheet = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1).astype(float)
first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
faces = np.concatenate(
    [np.stack([first, first + n, first + n + 1], axis=1), np.stack([first, first + n + 1, first + 1], axis=1)]
)
faces = np.concatenate([faces, faces + n * n])
edges = ipctk.edges(faces)

seen = []
for gap in (0.1, 1.0, 10.0):
    vertices = np.concatenate([100 * sheet, 100 * sheet + [0, 0, gap]])
    mesh = ipctk.CollisionMesh(vertices, edges, faces)
    collisions = ipctk.NormalCollisions()
    collisions.build(mesh, vertices, 2 * gap)
    assert len(collisions) > 0
    distance = round(collisions.compute_minimum_distance(mesh, vertices), 6)
    print(f"gap {gap:4.1f}, dhat {2 * gap:4.1f}: minimum distance {distance}")
    seen.append(distance)
documented = ipctk.NormalCollisions.compute_minimum_distance.__doc__
sys.exit(seen != [0.01, 1, 100] or "squared" in documented)
PY
