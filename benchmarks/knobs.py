"""Do some vertices of refined cloth stand out because of how the mesh is made?

    python -m benchmarks.knobs SHOT LAYER PRIM
    python -m benchmarks.knobs --all [--only NAME] [--frames 3] [--level 2] [--keep FOLDER]

A vertex stands off by its distance from its neighbours' mean along the normal. The means are taken over the interior
vertices of regular valence of each kind: the cage's own, and the edge and face points of each subdivision. Where the
mesh does not show, the largest mean is little over the smallest. Smooth subdivision (Catmull-Clark, Loop) of the same
cage says how much of the ratio comes from the cage. Areas are those of the refined cloth over its rest shape's and over
its cage's. Garments are all of quads or all of triangles.

--all refines some frames of each of `SHOWN` by default options and converged, and prints a row each; --keep leaves
stages and layers in a folder, for `benchmarks.looks`. Real shots are read from the folder that PHYSGRAPH_DATA names.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
from scipy import sparse

from benchmarks.quad_garments import GARMENTS, write_garment
from benchmarks.rows import say, table
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.mesh.subdivide import Refinement, compose, fine_count, smooth, subdivide_times
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.read.meshes import DrawnStage
from physgraph_usd.usd.read.reader import open_shot

WAYS: dict[str, RefineOptions] = {
    "default": RefineOptions(),
    "converged": RefineOptions(integrator="quasi-newton", steps=60),
}
"""Options by name. Sixty steps reach the ratio of two hundred."""
MOST_LEVELS = 6
"""Subdivisions that are tried to find a layer's level."""


@dataclass(frozen=True)
class Shown:
    """A garment of the table.

    Attributes:
        prim: Its path.
        first: Its first time code here.
        file: Its shot below the folder of real shots, or "" for a sample or one of `benchmarks.quad_garments`. Bodies
            of real shots, which they do not name, are left out.
    """

    prim: str
    first: float
    file: str = ""


SHOWN = {
    "dancer": Shown("/DancerShot/Dress", 30.0),
    "swatch": Shown("/SwatchShot/Swatch", 20.0),
    "shorts": Shown("/shot/char/shorts", 20.0, "02_makehuman_usdskel_dm.usdc"),
    "flag": Shown("/shot/flag", 20.0, "07_flag_quads_nocollider.usda"),
    "cape": Shown("/CapeShot/Cape", 12.0),
    "trousers": Shown("/TrousersShot/Trousers", 10.0),
    "coat": Shown("/CoatShot/Coat", 14.0),
}
"""Garments by name."""


@dataclass(frozen=True)
class Knobs:
    """How vertices stand off, and areas.

    Attributes:
        refined: Mean distance from the neighbours' mean [mm] by kind of vertex, of the refined cloth.
        smooth: The same of the smooth subdivision of the cage.
        over_rest: Area of the refined cloth over that of its rest shape.
        over_cage: Area of the refined cloth over that of its cage.
    """

    refined: dict[str, float]
    smooth: dict[str, float]
    over_rest: float
    over_cage: float

    def cells(self) -> list[str]:
        """Ratios of the refined cloth and of smooth subdivision, areas, and the kinds of the refined cloth."""
        figures = [_ratio(self.refined), _ratio(self.smooth), self.over_rest, self.over_cage]
        kinds = ", ".join(f"{kind} {value:.3f}" for kind, value in self.refined.items())
        return [*(f"{figure:.3f}" for figure in figures), kinds]


HEAD = ("largest / smallest", "of smooth subdivision", "area over rest", "over cage", "kinds [mm]")
"""Titles of `Knobs.cells`."""


@click.command(help=str(__doc__).splitlines()[0])
@click.argument("paths", nargs=-1)
@click.option("--all", "every", is_flag=True, help="Refine and print a table.")
@click.option("--only", multiple=True, type=click.Choice(list(SHOWN)))
@click.option("--way", "ways", multiple=True, type=click.Choice(list(WAYS)), default=list(WAYS))
@click.option("--frames", default=3, show_default=True)
@click.option("--level", default=2, show_default=True)
@click.option("--keep", type=click.Path(path_type=Path), help="Folder for stages and layers.")
def main(
    paths: Sequence[str],
    *,
    every: bool,
    only: Sequence[str],
    ways: Sequence[str],
    frames: int,
    level: int,
    keep: Path | None,
) -> None:
    """Print the figures of one layer, or the table."""
    if not every:
        shot, layer, prim = paths
        say(table(HEAD, [knobs_of(Path(shot), Path(layer), prim).cells()]))
        return
    say(table(("garment", "options", *HEAD), []))
    with tempfile.TemporaryDirectory() as made:
        for name in only or SHOWN:
            for way in ways:
                found = refined_knobs(name, way, keep or Path(made), frames=frames, level=level)
                cells = ["not there"] if found is None else found.cells()
                say(f"| {' | '.join([name, way, *cells])} |")


def refined_knobs(name: str, way: str, folder: Path, *, frames: int, level: int) -> Knobs | None:
    """Refine some frames of one of `SHOWN` into ``<folder>/<name>_<way>.usdc``; None where its shot is not there."""
    shown, shot = SHOWN[name], shot_of(name, folder)
    if shot is None:
        return None
    layer = folder / f"{name}_{way}.usdc"
    span = (shown.first, shown.first + frames - 1.0)
    refine_shot(shot, layer, replace(WAYS[way], garments=(shown.prim,), frames=span, level=level, overwrite=True))
    return knobs_of(shot, layer, shown.prim)


def shot_of(name: str, folder: Path) -> Path | None:
    """The shot of one of `SHOWN`, written into a folder unless it is a real one; None where that is not there."""
    if SHOWN[name].file:
        real = Path(os.environ.get("PHYSGRAPH_DATA", "../shared/data")) / "shots" / SHOWN[name].file
        return real if real.exists() else None
    if (folder / f"{name}.usdc").exists():
        return folder / f"{name}.usdc"
    return write_garment(name, folder) if name in GARMENTS else write_sample(name, folder)


def knobs_of(file: Path, layer: Path, prim: str) -> Knobs:
    """Measure a garment of a shot in a refined layer, over the layer's samples."""
    shot, fine = open_shot(str(file), garments=[prim]), DrawnStage(file, layer)
    garment, times = shot.scene.garments[0], fine.times((prim,))
    fine.bake(times)
    refined = {time: next(mesh.points for mesh in fine.meshes(time) if mesh.path == prim) for time in times}
    refinements = refinements_of(garment.mesh, len(refined[times[0]]))
    kinds, mesh, linear = kinds_of(garment.mesh, refinements), refinements[-1].mesh, compose(refinements)
    cages = [shot.frame(time).garments[0].points for time in times]
    rounded = smooth_stencil(garment.mesh, refinements)
    off = np.mean([np.abs(standing_off(mesh, points)) for points in refined.values()], axis=0)
    off_smooth = np.mean([np.abs(standing_off(mesh, rounded @ cage)) for cage in cages], axis=0)
    areas = [np.mean([_area(mesh, each) for each in of]) for of in (refined.values(), (linear @ c for c in cages))]
    return Knobs(
        {kind: 1e3 * float(off[own].mean()) for kind, own in kinds.items()},
        {kind: 1e3 * float(off_smooth[own].mean()) for kind, own in kinds.items()},
        float(areas[0] / _area(mesh, linear @ garment.rest)),
        float(areas[0] / areas[1]),
    )


def refinements_of(cage: PolygonMesh, vertices: int) -> tuple[Refinement, ...]:
    """The subdivisions that make so many vertices of a cage.

    Raises:
        ValueError: No number of them does, or faces are neither all quads nor all triangles.
    """
    if cage.counts.min() != cage.counts.max() or cage.counts[0] not in (3, 4):
        raise ValueError("the cage's faces are neither all quads nor all triangles")
    for levels in range(1, MOST_LEVELS + 1):
        if fine_count(cage, levels) == vertices:
            return subdivide_times(cage, levels)
    raise ValueError(f"{vertices} vertices are no subdivision of a cage with {cage.vertex_count}")


def smooth_stencil(cage: PolygonMesh, refinements: Sequence[Refinement]) -> sparse.csr_matrix:
    """Smooth places of the finest vertices, shape (V_fine, V_cage)."""
    product = smooth(cage, refinements[0])
    for parent, refinement in pairwise(refinements):
        product = smooth(parent.mesh, refinement) @ product
    return product


def kinds_of(cage: PolygonMesh, refinements: Sequence[Refinement]) -> dict[str, np.ndarray]:
    """Interior vertices of regular valence of the finest mesh by kind; kinds without any are left out."""
    half, size = refinements[-1].mesh.half_edges, int(cage.counts[0])
    count = refinements[-1].mesh.vertex_count
    regular = np.bincount(half.edges.ravel(), minlength=count) == (4 if size == 4 else 6)
    regular[half.edges[half.count != 2].ravel()] = False
    kinds = {"the cage's own": np.arange(cage.vertex_count)}
    for level, refinement in enumerate(refinements, 1):
        first = refinement.parent_vertex_count
        middle = first + len(refinement.edges)
        kinds[f"edge points {level}"] = np.arange(first, middle)
        kinds[f"face points {level}"] = np.arange(middle, refinement.mesh.vertex_count)
    own = {kind: vertices[regular[vertices]] for kind, vertices in kinds.items()}
    return {kind: vertices for kind, vertices in own.items() if len(vertices)}


def standing_off(mesh: PolygonMesh, points: np.ndarray) -> np.ndarray:
    """How far each vertex stands off its neighbours' mean along its normal, shape (V,), in the points' unit."""
    return np.einsum("ij,ij->i", points - neighbour_mean(mesh, points), vertex_normals(mesh, points))


def neighbour_mean(mesh: PolygonMesh, values: np.ndarray) -> np.ndarray:
    """Mean of the values, shape (V, 3), of the vertices that share an edge with each."""
    total, (a, b) = np.zeros_like(values), mesh.half_edges.edges.T
    np.add.at(total, a, values[b])
    np.add.at(total, b, values[a])
    return total / np.maximum(np.bincount(np.concatenate([a, b]), minlength=len(values)), 1)[:, None]


def vertex_normals(mesh: PolygonMesh, points: np.ndarray) -> np.ndarray:
    """Unit normals, weighted by area, shape (V, 3)."""
    normal, across = np.zeros_like(points), _across(mesh, points)
    for corner in mesh.indices.reshape(mesh.face_count, -1).T:
        np.add.at(normal, corner, across)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def _across(mesh: PolygonMesh, points: np.ndarray) -> np.ndarray:
    """Area vectors of faces, shape (F, 3)."""
    corners = points[mesh.indices.reshape(mesh.face_count, -1)]
    # the last corner over the second is the diagonal of a quad, and a side of a triangle
    return 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])


def _area(mesh: PolygonMesh, points: np.ndarray) -> float:
    """Area of a fine mesh, whose quads are nearly flat."""
    return float(np.linalg.norm(_across(mesh, points), axis=1).sum())


def _ratio(kinds: dict[str, float]) -> float:
    """The largest over the smallest."""
    return max(kinds.values()) / min(kinds.values())


if __name__ == "__main__":
    main()
