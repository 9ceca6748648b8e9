"""Small meshes and hypothesis strategies that the mesh tests share."""

import numpy as np
from hypothesis import strategies as st

from physgraph_usd.solver.mesh.topology import PolygonMesh


def mesh_of(faces: list[list[int]], vertex_count: int | None = None) -> PolygonMesh:
    indices = [vertex for face in faces for vertex in face]
    count = max(indices, default=-1) + 1 if vertex_count is None else vertex_count
    return PolygonMesh(np.array([len(face) for face in faces], np.int32), np.array(indices, np.int32), count)


def faces_of(mesh: PolygonMesh) -> list[list[int]]:
    return [mesh.indices[a:b].tolist() for a, b in zip(mesh.starts[:-1], mesh.starts[1:], strict=True)]


def grid(columns: int, rows: int, cells: str = "quads") -> tuple[PolygonMesh, np.ndarray]:
    """A counter-clockwise grid in the xy plane, of "quads", "triangles" or "mixed": triangles left, quads right."""
    faces: list[list[int]] = []
    for y in range(rows):
        for x in range(columns):
            a = y * (columns + 1) + x
            b, c, d = a + 1, a + columns + 2, a + columns + 1
            whole = cells == "quads" or (cells == "mixed" and 2 * x >= columns)
            faces += [[a, b, c, d]] if whole else [[a, b, c], [a, c, d]]
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    return mesh_of(faces), np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)


def quads_of(across: int, rows: int, *, closed: bool = False, turned: bool = False) -> np.ndarray:
    """Quads between rows of vertices that are numbered row by row, shape (F, 4).

    A quad begins at a vertex, goes on to the next of its row and then to the row after; ``turned`` to the row first.
    ``closed`` rows end at their first vertex.
    """
    ids = np.arange(across * rows).reshape(rows, across)
    last = slice(None if closed else -1)
    following = np.roll(ids, -1, axis=1)[:, last]
    quads = np.stack([ids[:-1, last], following[:-1], following[1:], ids[1:, last]], axis=-1).reshape(-1, 4)
    return quads[:, [0, 3, 2, 1]] if turned else quads


def cube() -> tuple[PolygonMesh, np.ndarray]:
    """The cube of corners +-1, wound outwards."""
    points = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    return mesh_of(faces), points


def tetrahedron() -> tuple[PolygonMesh, np.ndarray]:
    """A tetrahedron wound outwards."""
    points = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    return mesh_of([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]), points


def prism(sides: int) -> tuple[PolygonMesh, np.ndarray]:
    """Two polygons joined by quads; closed, with valence 3 everywhere."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    top = list(range(sides, 2 * sides))
    walls = [[i, (i + 1) % sides, sides + (i + 1) % sides, sides + i] for i in range(sides)]
    return mesh_of([list(range(sides))[::-1], top, *walls]), np.concatenate([ring, ring + np.array([0, 0, 1.5])])


@st.composite
def any_mesh(draw: st.DrawFn, *, repeats: bool = False, duplicates: bool = True) -> PolygonMesh:
    """Faces of 3 to 6 corners thrown together: non-manifold, with isolated vertices, duplicate faces, odd winding.

    With ``repeats`` a face may also repeat vertices or have fewer than three corners; without ``duplicates`` no two
    faces have the same vertices.
    """
    vertex_count = draw(st.integers(6, 10))
    vertex = st.integers(0, vertex_count - 1)
    face = st.lists(vertex, min_size=0 if repeats else 3, max_size=6, unique=not repeats)
    faces = st.lists(face, max_size=7, unique_by=None if duplicates else frozenset)
    return mesh_of(draw(faces), vertex_count)


@st.composite
def planar_mesh(draw: st.DrawFn) -> tuple[PolygonMesh, np.ndarray]:
    """A jittered planar grid whose cells are quads, triangle pairs, or joined in twos to hexagons; some are missing."""
    columns, rows = 2 * draw(st.integers(1, 2)), draw(st.integers(1, 3))
    faces: list[list[int]] = []
    for y in range(rows):
        for x in range(0, columns, 2):
            a = y * (columns + 1) + x
            low, high = [a, a + 1, a + 2], [a + columns + 1, a + columns + 2, a + columns + 3]
            left, right = [low[0], low[1], high[1], high[0]], [low[1], low[2], high[2], high[1]]
            choices = {
                "quads": [left, right],
                "hexagon": [[*low, *high[::-1]]],
                "triangles": [left[:3], [left[0], *left[2:]], right[:3], [right[0], *right[2:]]],
                "both": [left, right[:3], [right[0], *right[2:]]],
                "hole": [],
            }
            faces += choices[draw(st.sampled_from(sorted(choices)))]
    _, points = grid(columns, rows)
    jitter = np.random.default_rng(draw(st.integers(0, 2**16))).uniform(-0.2, 0.2, (len(points), 2))
    points[:, :2] += jitter
    return mesh_of(faces, len(points)), points
