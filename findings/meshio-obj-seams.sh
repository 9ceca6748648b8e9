#!/usr/bin/env bash
# Library: meshio 5.3.5 (reading Wavefront OBJ)
#
# Expected: OBJ gives each corner of a face its own index of a texture coordinate. A reader keeps those indices, or
# splits vertices along seams, or leaves texture coordinates out.
#
# Seen: meshio drops the indices and takes the list of texture coordinates as one per vertex. A mesh with a seam does
# not open, and one that happens to have as many coordinates as vertices opens with coordinates at wrong vertices:
#
#   seam (4 vertices, 6 texture coordinates):  ValueError: len(points) = 4, but len(point_data["obj:vt"]) = 6
#   no seam, listed in another order:          vertex 0 has [0.0, 1.0], the file says [0.0, 0.0]
#
# Why it matters: every garment that was made from pattern pieces has seams, and pattern coordinates are what warp and
# weft directions are taken from. The second case is silent: the fabric's grain runs across where it should run along.
#
# Workaround: read OBJ by libigl (igl.readOBJ returns the corners' indices FTC), or write one vertex per corner.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q meshio==5.3.5 numpy==2.4.6
cd "$tmp"
cat >seam.obj <<'OBJ'
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 5 0
vt 6 1
vt 5 1
f 1/1 2/2 3/3
f 1/4 3/5 4/6
OBJ
cat >order.obj <<'OBJ'
v 0 0 0
v 1 0 0
v 0 1 0
vt 0 1
vt 0 0
vt 1 0
f 1/2 2/3 3/1
OBJ
venv/bin/python - <<'PY'
import sys

import meshio

try:
    meshio.read("seam.obj")
    seam = "opens"
except ValueError as error:
    seam = f"ValueError: {error}"
order = meshio.read("order.obj").point_data["obj:vt"][0].tolist()
print("seam (4 vertices, 6 texture coordinates): ", seam)
print(f"no seam, listed in another order:          vertex 0 has {order}, the file says [0.0, 0.0]")
sys.exit(seam != 'ValueError: len(points) = 4, but len(point_data["obj:vt"]) = 6' or order != [0.0, 1.0])
PY
