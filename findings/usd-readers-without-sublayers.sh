#!/usr/bin/env bash
# Tools: three 0.187.0 (USDLoader, under node 18 or later) and tinyusdz 0.9.4 (Python)
#
# Expected: a USD file whose content lies in a sublayer shows that content, or fails to open, since a reader without
# composition cannot read it.
#
# Seen: both open it without an error or a warning as a scene in which nothing is:
#
#   tinyusdz, mesh in the file itself:  ['Xform World', 'Mesh Cloth']
#   tinyusdz, mesh in a sublayer:       []
#   three, mesh in the file itself:     1 mesh
#   three, mesh in a sublayer:          0 meshes
#
# Why it matters: refined cloth is best handed on as a small root layer over the untouched shot, and that is the one
# layout of which these viewers show nothing at all. An empty picture looks like a broken export.
#
# Workaround: flatten (`usdcat --flatten`, or Usd.Stage.Flatten) before a file goes to such a reader; the Python package
# lightusd 1.0.0rc4, of the author of tinyusdz, does compose sublayers.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
cd "$tmp"
python3 -m venv venv
venv/bin/pip install -q tinyusdz==0.9.4
echo '{"type": "module"}' >package.json
npm install --silent --no-audit --no-fund three@0.187.0
cat >mesh.usda <<'USD'
#usda 1.0
(
    defaultPrim = "World"
)

def Xform "World"
{
    def Mesh "Cloth"
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    }
}
USD
cat >root.usda <<'USD'
#usda 1.0
(
    defaultPrim = "World"
    subLayers = [
        @./mesh.usda@
    ]
)
USD
cat >read.mjs <<'JS'
import { readFileSync } from 'node:fs';
import { USDLoader } from 'three/examples/jsm/loaders/USDLoader.js';
for (const [where, file] of [['the file itself:    ', 'mesh.usda'], ['a sublayer:         ', 'root.usda']]) {
  let meshes = 0;
  new USDLoader().parse(readFileSync(file, 'utf8')).traverse((node) => { if (node.isMesh) meshes += 1; });
  console.log(`three, mesh in ${where} ${meshes} mesh${meshes === 1 ? '' : 'es'}`);
}
JS
cat >read.py <<'PY'
import tinyusdz

for where, file in (("the file itself: ", "mesh.usda"), ("a sublayer:      ", "root.usda")):
    prims = [f"{prim.type_name} {prim.name}" for prim in tinyusdz.traverse(tinyusdz.load(file))]
    print("tinyusdz, mesh in", where, prims)
PY
{ venv/bin/python read.py && node read.mjs; } 2>&1 | tee seen.txt
diff - seen.txt <<'TXT' || exit 1
tinyusdz, mesh in the file itself:  ['Xform World', 'Mesh Cloth']
tinyusdz, mesh in a sublayer:       []
three, mesh in the file itself:     1 mesh
three, mesh in a sublayer:          0 meshes
TXT
