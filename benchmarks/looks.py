"""Pictures of refined layers side by side, whole and close under raking light, where dots and ladders show.

    python -m benchmarks.looks OUT.png SHOT PRIM LAYER... [--time T] [--camera 25 8] [--at X Y Z] [--size 0.25]

A column a layer, and last smooth subdivision (Catmull-Clark, Loop) of the cage. The upper row shows the garment and the
bodies as a report does. The lower row shows a part of the garment of some size, alone, under a light that grazes it and
wraps round it, so that no fold is all black. Unless --at gives the part's middle in metres, Y up, that is where
vertices of the first layer most stand off otherwise than their neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree

from benchmarks.knobs import neighbour_mean, refinements_of, smooth_stencil, standing_off, vertex_normals
from benchmarks.rows import say
from physgraph_usd.shot.page.drawing import draw, encode_color, fit_view
from physgraph_usd.shot.page.preview import label
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.read.meshes import DrawnMesh, DrawnStage
from physgraph_usd.usd.read.reader import open_shot

GRAZING = np.radians(76.0)
"""Angle between the light and the mean normal of the cloth in close pictures [rad]."""
DENSE = 1.6
"""Samples a pixel along the side of a face in close pictures: no pixel of the face is left without one."""

Side = tuple[str, list[DrawnMesh]]
"""A title and the meshes under it."""


@click.command(help=str(__doc__).splitlines()[0])
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("shot", type=click.Path(exists=True, path_type=Path))
@click.argument("prim")
@click.argument("layers", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--time", type=float, help="Time code.  [default: the first layer's last]")
@click.option("--camera", type=float, nargs=2, default=(25.0, 8.0), show_default=True)
@click.option("--at", type=float, nargs=3, help="Middle of the close picture.")
@click.option("--size", default=0.25, show_default=True, help="Its height [m].")
@click.option("--panel", default=640, show_default=True, help="Side of a panel [pixels].")
def main(
    out: Path,
    shot: Path,
    prim: str,
    layers: Sequence[Path],
    *,
    time: float | None,
    camera: tuple[float, float],
    at: Sequence[float] | None,
    size: float,
    panel: int,
) -> None:
    """Draw the picture."""
    stages = [DrawnStage(shot, layer) for layer in layers]
    code = stages[0].times((prim,))[-1] if time is None else time
    for stage in stages:
        stage.bake((code,))
    sides: list[Side] = [(layer.stem, stage.meshes(code)) for layer, stage in zip(layers, stages, strict=True)]
    mesh, rounded = smoothed(shot, prim, _cloth(sides[0], prim), code)
    sides.append(("Smooth subdivision", [rounded if each.path == prim else each for each in sides[0][1]]))
    cloth = [_cloth(side, prim) for side in sides]
    middle = worst_place(mesh, cloth[0].points, 0.5 * size) if not at else np.asarray(at)
    rows = [
        whole(sides, prim, camera, panel),
        close(mesh, [each.points for each in cloth], middle, size=size, panel=panel),
    ]
    sheet = Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0))
    pen = ImageDraw.Draw(sheet)
    for column, (title, _) in enumerate(sides):
        label(pen, (column * panel, 0), panel, lines=[title])
    sheet.save(out)
    say(f"{out}: time {code:g}, close at {middle.round(3).tolist()}")


def smoothed(shot: Path, prim: str, fine: DrawnMesh, time: float) -> tuple[PolygonMesh, DrawnMesh]:
    """The finest faces of a garment, and a drawn mesh with its vertices where smooth subdivision puts them."""
    cage = open_shot(str(shot), garments=[prim]).scene.garments[0].mesh
    refinements = refinements_of(cage, len(fine.points))
    plain = DrawnStage(shot)
    plain.bake((time,))
    points = next(mesh.points for mesh in plain.meshes(time) if mesh.path == prim)
    return refinements[-1].mesh, replace(fine, points=smooth_stencil(cage, refinements) @ points)


def worst_place(mesh: PolygonMesh, points: np.ndarray, radius: float) -> np.ndarray:
    """The middle of the ball without borders in which most vertices stand off otherwise than their neighbours.

    The median says where dots cover the cloth; the mean would find the sharpest crease.
    """
    off = standing_off(mesh, points)[:, None]
    dots = np.abs(off - neighbour_mean(mesh, off))[:, 0]
    border = points[np.unique(mesh.half_edges.edges[mesh.half_edges.count != 2])]
    places = points[:: max(len(points) // 2000, 1)]
    if len(border):
        far = np.asarray(cKDTree(border).query(places)[0])
        places = places[far > min(radius, 0.9 * far.max())]
    near = cKDTree(points).query_ball_point(places, radius)
    return places[np.argmax([np.median(dots[each]) for each in near])]


def whole(sides: Sequence[Side], prim: str, camera: tuple[float, float], panel: int) -> list[np.ndarray]:
    """The garment and what it touches, one picture a side."""
    points = np.concatenate([_cloth(side, prim).points for side in sides])
    view, floor = fit_view(points, 1.0, azimuth=camera[0], elevation=camera[1]), float(points[:, 1].min()) - 0.02
    return [draw(meshes, view, size=(panel, panel), floor=floor) for _, meshes in sides]


def close(
    mesh: PolygonMesh, clouds: Sequence[np.ndarray], middle: np.ndarray, *, size: float, panel: int
) -> list[np.ndarray]:
    """The cloth round a place under raking light, one picture a set of points, all from the camera of the first."""
    near = np.linalg.norm(clouds[0] - middle, axis=1) < 0.5 * size
    back = vertex_normals(mesh, clouds[0])[near].sum(axis=0)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    scale = panel / size
    return [_raked(mesh, scale * (points - middle) @ axes.T, panel) for points in clouds]


def _raked(mesh: PolygonMesh, points: np.ndarray, panel: int) -> np.ndarray:
    """A picture of a mesh in the camera's frame, in pixels from its middle, seen along -Z and lit from the upper left.

    Faces are sampled bilinearly, normals too: the diagonals that a renderer's triangles draw on quads do not show.
    """
    corners = mesh.indices.reshape(mesh.face_count, -1)[:, [0, 1, 2, -1]]
    corners = corners[(np.abs(points[corners, :2]).max(axis=2) < 0.5 * panel).any(axis=1)]
    sides = np.linalg.norm(points[corners] - points[np.roll(corners, 1, axis=1)], axis=2)
    count = int(np.ceil(DENSE * sides.max(initial=1.0)))
    u, v = (each.ravel() for each in np.meshgrid(*2 * [(np.arange(count) + 0.5) / count]))
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1).astype(np.float32)
    place = np.einsum("sc,fck->fsk", weights, points[corners].astype(np.float32)).reshape(-1, 3)
    pixel = np.floor(place[:, :2] * (1, -1) + 0.5 * panel).astype(int)
    seen = np.flatnonzero(((pixel >= 0) & (pixel < panel)).all(axis=1))
    seen = seen[np.argsort(place[seen, 2])]  # the nearest comes last, and stays
    front = np.full(panel * panel, -1)
    front[pixel[seen, 1] * panel + pixel[seen, 0]] = seen
    face, sample = np.divmod(front[front >= 0], count * count)
    normal = np.einsum("hc,hck->hk", weights[sample], vertex_normals(mesh, points)[corners[face]])
    normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0) / np.linalg.norm(normal, axis=1, keepdims=True)
    light = np.array([-np.sin(GRAZING) * np.sqrt(0.5), np.sin(GRAZING) * np.sqrt(0.5), np.cos(GRAZING)])
    shades = np.array([encode_color((shade,) * 3) for shade in np.linspace(0.0, 1.0, 256)], np.uint8)
    lit = (0.5 + 0.5 * normal @ light).clip(0.0, 1.0) ** 2  # Lambert's law wrapped round to the far side
    picture = np.full((panel * panel, 3), 255, np.uint8)
    picture[front >= 0] = shades[(255.0 * lit).astype(int)]
    return picture.reshape(panel, panel, 3)


def _cloth(side: Side, prim: str) -> DrawnMesh:
    """The garment's mesh."""
    return next(mesh for mesh in side[1] if mesh.path == prim)


if __name__ == "__main__":
    main()
