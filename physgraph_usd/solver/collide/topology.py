"""Warp struct of a level's vertices, edges and faces by cluster."""

# Warp's structs are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import warp as wp


@wp.struct
class Topology:
    """Topology by cluster; `corners` are the distinct vertices of a cluster's parts."""

    first_corner: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.int32)
    first_vertex: wp.array(dtype=wp.int32)
    vertices: wp.array(dtype=wp.int32)
    first_edge: wp.array(dtype=wp.int32)
    edges: wp.array(dtype=wp.vec2i)
    edge_number: wp.array(dtype=wp.int32)
    first_face: wp.array(dtype=wp.int32)
    faces: wp.array(dtype=wp.vec3i)
    face_number: wp.array(dtype=wp.int32)
    garment: wp.array(dtype=wp.int32)
    meets: wp.array(dtype=wp.int32)
    garments: wp.int32
    label: wp.array(dtype=wp.int32)
    owner: wp.array(dtype=wp.int32)
    rest: wp.array(dtype=wp.vec3d)
