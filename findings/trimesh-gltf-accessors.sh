#!/usr/bin/env bash
# Library: trimesh 5.2.0 (reading glTF 2.0)
#
# Expected: an accessor of glTF may be sparse, that is replace some elements of a stored array or of zeros, and may be
# `normalized`, whose integers stand for fractions. Both are in the core of glTF 2.0, and integer positions come with
# KHR_mesh_quantization among extensionsRequired. A reader follows them, or says that it does not read the file.
#
# Seen: trimesh reads the array below and the plain integers, with no warning. The corner of a square that should be at
# (1, 1, 0), and is stored as (0, 0, 0) with a replacement, or alone by the replacement, or in 16 bits:
#
#   plain floats:              [1.0, 1.0, 0.0]
#   sparse over an array:      [0.0, 0.0, 0.0]
#   sparse over zeros:         [0.0, 0.0, 0.0]
#   normalized 16 bits:        [32767.0, 32767.0, 0.0]
#
# Why it matters: quantized positions are what tools that shrink garments for the web write, and a sparse accessor may
# hold what a drape changes in a sheet. The mesh opens with the right faces, some vertices in another place or all of it
# 32767 times too large, which looks like a mistake in units.
#
# Workaround: look at the file's JSON before: refuse accessors with `sparse` or with positions that are not floats, or
# decode them oneself (pygltflib gives the accessors and their bytes).
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q trimesh==5.2.0 numpy==2.4.6
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import base64
import json
import sys

import numpy as np
import trimesh

square = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], "<f4")
folded = square.copy()
folded[3] = 0


def corner(name, position, arrays, **more):
    views, data = [], b""
    for array in (np.array([0, 1, 2, 2, 1, 3], "<u2"), *arrays):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        if array.ndim == 2 and array.itemsize == 2:
            views[-1]["byteStride"] = 8
        data += array.tobytes() + bytes(-array.nbytes % 4)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    file = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "buffers": [{"byteLength": len(data), "uri": uri}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "count": 6, "type": "SCALAR"},
            {"componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]} | position,
        ],
    } | more
    with open(name + ".gltf", "w") as out:
        json.dump(file, out)
    vertices = trimesh.load_scene(name + ".gltf", process=False).to_mesh().vertices
    assert vertices.shape == (4, 3)
    return vertices[3].tolist()


def replaced(view):
    indices = {"bufferView": view, "byteOffset": 0, "componentType": 5123}
    return {"count": 1, "indices": indices, "values": {"bufferView": view + 1, "byteOffset": 0}}


which = [np.array([3], "<u2"), square[3:]]
short = np.zeros((4, 4), "<i2")
short[:, :3] = square * 32767
whole = {"bufferView": 1, "componentType": 5122, "normalized": True, "max": [32767, 32767, 0]}
extension = ["KHR_mesh_quantization"]
seen = [
    corner("plain", {"bufferView": 1}, [square]),
    corner("sparse", {"bufferView": 1, "sparse": replaced(2)}, [folded, *which]),
    corner("zeros", {"sparse": replaced(1)}, which),
    corner("short", whole, [short], extensionsUsed=extension, extensionsRequired=extension),
]
names = ("plain floats:", "sparse over an array:", "sparse over zeros:", "normalized 16 bits:")
for name, vertex in zip(names, seen, strict=True):
    print(f"{name:<26} {vertex}")
sys.exit(seen != [[1, 1, 0], [0, 0, 0], [0, 0, 0], [32767, 32767, 0]])
PY
