"""What a layer's subdivision surface keeps of the contact and the folds that were solved.

    python -m benchmarks.drawn_surface SHOT LAYER TIME...

Subdivides the refined cloth of a layer once and twice more, as a renderer does. Prints the share of edges that fold by
more than `SHARP`, the edges that pass through faces of cloth and of bodies, and how far the vertices have moved. Cloth
whose scheme is none is drawn by its polygons; its rows show what another scheme would do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from benchmarks.crossing_count import crossing_count
from benchmarks.films import edges_of
from benchmarks.rows import say
from physgraph_usd.solver.mesh.subdivide import smooth, subdivide
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.read.meshes import DrawnMesh, DrawnStage, refined_in

SHARP = 20.0
"""Angle between the normals of neighbouring triangles from which an edge counts as folded [degrees]."""


@click.command()
@click.argument("shot", type=Path)
@click.argument("layer", type=Path)
@click.argument("times", type=float, nargs=-1, required=True)
def main(shot: Path, layer: Path, times: tuple[float, ...]) -> None:
    """Print a row for each time code and number of further subdivisions."""
    stage, fine = DrawnStage(shot, layer), refined_in(layer)
    stage.bake(times)
    for time in times:
        meshes = stage.meshes(time, cages=fine)
        cloth, bodies = ([mesh for mesh in meshes if (mesh.path in fine) == side] for side in (True, False))
        first = np.concatenate([mesh.points for mesh in cloth])
        for level in range(3):
            kept = np.concatenate([mesh.points[: mesh.authored] for mesh in cloth])
            move = 1e3 * np.linalg.norm(kept - first, axis=1)
            through = crossings(cloth, []), crossings(cloth, bodies) if bodies else 0
            folded = 100.0 * np.concatenate([folds(mesh) for mesh in cloth]).mean()
            words = f"{through[0]} edges through cloth, {through[1]} through bodies"
            say(f"{time:g}, {level} more: {folded:.2f}% folded; {words}; moved {move.mean():.2f}, {move.max():.2f} mm")
            cloth = [finer(mesh) for mesh in cloth]


def finer(mesh: DrawnMesh) -> DrawnMesh:
    """A mesh smoothly subdivided once; the first points are those of the mesh, moved."""
    step = subdivide(mesh.mesh)
    colors = mesh.face_colors[step.parent_face]
    return replace(mesh, points=smooth(mesh.mesh, step) @ mesh.points, mesh=step.mesh, face_colors=colors)


def folds(mesh: DrawnMesh) -> np.ndarray:
    """Whether each inner edge of a mesh's triangles folds by more than `SHARP`."""
    corners = mesh.triangles
    a, b, c = mesh.points[corners].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    triangles = PolygonMesh(np.full(len(corners), 3), corners.ravel(), len(mesh.points))
    one, two = triangles.corner_face[triangles.twin_corners].T
    return (normal[one] * normal[two]).sum(axis=1) < np.cos(np.radians(SHARP))


def crossings(cloth: Sequence[DrawnMesh], bodies: Sequence[DrawnMesh]) -> int:
    """Edges through faces: of cloth among itself without bodies, or of cloth and bodies."""
    points, edges, faces = _joined(cloth)
    if not bodies:
        return crossing_count(points, edges, faces, same=np.unique(points, axis=0, return_inverse=True)[1].reshape(-1))
    others, body_edges, body_faces = _joined(bodies)
    both, shift = np.concatenate([points, others]), len(points)
    return crossing_count(both, edges, body_faces + shift) + crossing_count(both, body_edges + shift, faces)


def _joined(meshes: Sequence[DrawnMesh]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, edges and triangles of several meshes as one."""
    shifts = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    edges = [edges_of(mesh) + shift for mesh, shift in zip(meshes, shifts, strict=False)]
    faces = [mesh.triangles + shift for mesh, shift in zip(meshes, shifts, strict=False)]
    return np.concatenate([mesh.points for mesh in meshes]), np.concatenate(edges), np.concatenate(faces)


if __name__ == "__main__":
    main()
