#!/usr/bin/env bash
# Tool: three 0.187.0 (USDLoader, under node 18 or later)
#
# Expected: USD says that the front of a mesh whose orientation is leftHanded lies where its points run clockwise. A
# reader for which counterclockwise is front, as three, turns the faces around.
#
# Seen: USDLoader does not read orientation. The faces stay as they are: normals that it makes point to the back, and
# normals that the file has point away from the side that is drawn. A triangle at z = 0 that faces -z by USD, and the
# side from which a ray that looks for fronts hits it:
#
#   leftHanded, no normals: normal z  1, seen from +z
#   leftHanded, normals:    normal z -1, seen from +z
#
# Why it matters: Houdini writes leftHanded meshes. A coat shows its lining instead of its outside, with the file's own
# normals it is lit from the wrong side, and what is inside and outside of a body is exchanged.
#
# Workaround: before loading, reverse the indices of each face (and of face-varying values) and write rightHanded.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
cd "$tmp"
echo '{"type": "module"}' >package.json
npm install --silent --no-audit --no-fund three@0.187.0
cat >read.mjs <<'JS'
import { Raycaster, Vector3 } from 'three';
import { USDLoader } from 'three/examples/jsm/loaders/USDLoader.js';

const normals = `normal3f[] normals = [(0, 0, -1), (0, 0, -1), (0, 0, -1)] (
            interpolation = "vertex"
        )`;
const stage = (more) => `#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "World"
{
    def Mesh "Coat"
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        uniform token orientation = "leftHanded"
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        uniform token subdivisionScheme = "none"
        ${more}
    }
}
`;
for (const [name, more] of [['no normals:', ''], ['normals:   ', normals]]) {
  const scene = new USDLoader().parse(stage(more));
  scene.updateMatrixWorld(true);
  const seen = [1, -1].filter((side) => {
    const ray = new Raycaster(new Vector3(0.2, 0.2, side), new Vector3(0, 0, -side));
    return ray.intersectObject(scene, true).length > 0;
  });
  scene.traverse((node) => {
    if (!node.isMesh) return;
    const z = String(node.geometry.attributes.normal.getZ(0)).padStart(2);
    console.log(`leftHanded, ${name} normal z ${z}, seen from ${seen.map((side) => (side > 0 ? '+z' : '-z'))}`);
  });
}
JS
node read.mjs | tee seen.txt
diff - seen.txt <<'TXT'
leftHanded, no normals: normal z  1, seen from +z
leftHanded, normals:    normal z -1, seen from +z
TXT
