#!/usr/bin/env bash
# Library: libigl 2.6.3 (igl.remove_duplicate_vertices)
#
# Expected: vertices are merged "up to a uniqueness tolerance (epsilon)" that is "used coordinate-wise": two whose
# coordinates differ by less than epsilon become one, and two that differ by more stay.
#
# Seen: coordinates are rounded to multiples of epsilon, and vertices with the same rounded ones are merged. Whether two
# are depends on where they lie, and one pair may stay apart at a fiftieth of epsilon while another is merged at four
# fifths. With epsilon = 0.001:
#
#   at 0.00049 and 0.00051, 0.00002 apart: 2 vertices left
#   at 0.00060 and 0.00140, 0.00080 apart: 1 vertex left
#   at 0.25000 and 0.25090, 0.00090 apart: 2 vertices left
#
# Why it matters: panels are sewn together by merging the vertices of their borders. Of a long seam some pairs always
# fall on two sides of a rounding limit, however large epsilon is: the seam has slits, which first show when the
# cloth is subdivided or simulated.
#
# Workaround: find pairs by distance (scipy.spatial.cKDTree.query_pairs) and merge what hangs together.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q libigl==2.6.3 numpy==2.4.6
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

import igl
import numpy as np

seen = []
for first, second in ((0.00049, 0.00051), (0.0006, 0.0014), (0.25, 0.2509)):
    left = len(igl.remove_duplicate_vertices(np.array([(first, 0, 0), (second, 0, 0)]), 0.001)[0])
    vertices = f"{left} {'vertex' if left == 1 else 'vertices'}"
    print(f"at {first:.5f} and {second:.5f}, {second - first:.5f} apart: {vertices} left")
    seen.append(left)
sys.exit(seen != [2, 1, 2])
PY
