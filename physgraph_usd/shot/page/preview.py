"""Draws a refined layer beside the shot it was made from: PNG stills and GIF loops, headless."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ...errors import LayerError, StageError, UsageError
from ...usd.files import check_targets, files_of
from ...usd.read.meshes import DrawnMesh, DrawnStage, refined_in, shot_of
from ...usd.write.atomic import check_place, make_file, prepare_target, publish, temporary_path
from .raycast import BACKGROUND, Surface, View, draw, encode_color, fit_view

STILL, LOOP = ".png", ".gif"
"""Formats by suffix."""

LIGHT_VERTICES = 6_000
"""A mesh with fewer vertices is split for drawing, flat, so that its light is as fine as its neighbour's."""

INK, FAINT = (38, 40, 44), (112, 114, 118)
"""Colours of the labels."""


@dataclass(frozen=True, eq=False)
class _Panel:
    """One side of the picture."""

    title: str
    stage: DrawnStage
    garments: tuple[str, ...]
    lined: bool


def preview(
    layer: Path | str,
    out: Path | str,
    *,
    shot: Path | str | None = None,
    times: Sequence[float] | None = None,
    size: tuple[int, int] = (1280, 640),
    camera: tuple[float, float] | None = None,
    overwrite: bool = False,
) -> Path:
    """Draw coarse beside fine, or a plain shot alone.

    Args:
        layer: A refined layer, or a shot.
        out: Picture to write: ``.png`` draws one time, ``.gif`` a loop.
        shot: The shot under the layer; found in the layer's own record when None.
        times: Time codes to draw; the last sample for a PNG and all samples for a GIF when None.
        size: Width and height [pixels].
        camera: Azimuth and elevation [degrees]; (25, 10) when None.
        overwrite: Whether a picture that is there may be replaced.

    Returns:
        The picture written.

    Raises:
        UsageError: When the suffix is unknown, a PNG is asked for several times, or the picture exists, is a link or is
            one of the shot's.
        LayerError: When nothing can be written there.
        StageError: When a stage cannot be opened or shows no mesh.
    """
    layer, out = Path(layer), Path(out)
    if out.suffix.lower() not in {STILL, LOOP}:
        raise UsageError(f"cannot draw {out.name!r}; known suffixes: {STILL}, {LOOP}")
    below = shot_of(layer) if shot is None else Path(shot)
    check_targets([("the picture", out)], files_of(layer) | (files_of(below) if below else set()))
    check_place(out)
    prepare_target(out, overwrite=overwrite)
    panels = _panels(layer, below)
    codes = _times(panels, times, out.suffix.lower())
    for panel in panels:
        panel.stage.bake(tuple(code for code in codes if code is not None))
    views = _frame(panels, codes, size, camera or (25.0, 10.0))
    pictures = [_compose(panels, code, size, views) for code in codes]
    temporary = temporary_path(out, suffix=out.suffix)
    try:
        with make_file(temporary) as stream:
            if out.suffix.lower() == STILL:
                pictures[0].save(stream, "PNG", optimize=True)
            else:
                _save_loop(pictures, stream, panels[0].stage.rate, codes)
        publish(temporary, out)
    except OSError as error:
        raise LayerError(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)
    return out


def _panels(layer: Path, shot: Path | None) -> list[_Panel]:
    """Compose what stands on each side."""
    if shot is None:
        stage = DrawnStage(layer)
        return [_Panel("", stage, stage.garments(), True)]
    fine = DrawnStage(shot, layer)
    coarse = DrawnStage(shot, turn=fine.turn)
    refined = refined_in(layer)
    source = tuple(path for path in refined if path in coarse.paths()) or coarse.garments()
    return [_Panel("Coarse input", coarse, source, True), _Panel("Refined", fine, refined, False)]


def _times(panels: list[_Panel], times: Sequence[float] | None, suffix: str) -> list[float | None]:
    """Choose the time codes to draw."""
    if times is not None:
        if suffix == STILL and len(times) != 1:
            raise UsageError(f"a {STILL} shows one time code, not {len(times)}; write a {LOOP} for several")
        return [float(time) for time in times]
    found = panels[-1].stage.times(panels[-1].garments)
    if not found:
        return [None]
    return [found[-1]] if suffix == STILL else list(found)


def _frame(
    panels: list[_Panel], codes: list[float | None], size: tuple[int, int], camera: tuple[float, float]
) -> tuple[View, float]:
    """One view for every panel and time, and the height of the ground."""
    spread = codes if len(codes) > 1 else _extremes(panels[0], codes)
    clouds: list[np.ndarray] = []
    for code in spread:
        meshes = panels[0].stage.meshes(code)
        if not meshes:
            continue
        wanted = [mesh.points for mesh in meshes if mesh.path in panels[0].garments]
        wanted = wanted or [mesh.points for mesh in meshes]
        clouds += wanted + [_near(mesh.points, np.concatenate(wanted)) for mesh in meshes]
    if not clouds:
        raise StageError("nothing to draw: the stage shows no mesh")
    points = np.concatenate(clouds)
    floor = float(points[:, 1].min())
    aspect = size[0] / len(panels) / size[1]
    drop = 0.03 * float(np.ptp(points, axis=0).max())
    return fit_view(points, aspect, azimuth=camera[0], elevation=camera[1]), floor - drop


def _near(points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The points in a box a little larger than what must be seen, so that a collider shows around its garment."""
    low, high = wanted.min(axis=0), wanted.max(axis=0)
    margin = 0.25 * float((high - low).max())
    return points[((points > low - margin) & (points < high + margin)).all(axis=1)]


def _extremes(panel: _Panel, codes: list[float | None]) -> list[float | None]:
    """The drawn time with some others, so that stills of one shot share their framing."""
    found = panel.stage.times(panel.garments)
    return codes + [found[i] for i in np.linspace(0, len(found) - 1, 5).astype(int)] if found else codes


def _compose(panels: list[_Panel], code: float | None, size: tuple[int, int], views: tuple[View, float]) -> Image.Image:
    """Draw all panels at one time and label them."""
    width = size[0] // len(panels)
    picture = Image.new("RGB", size, encode_color(tuple(BACKGROUND)))
    pen = ImageDraw.Draw(picture)
    for i, panel in enumerate(panels):
        meshes = panel.stage.meshes(code)
        surfaces = [surface_of(mesh, lined=panel.lined and _is_refined(mesh, panel)) for mesh in meshes]
        pixels = draw(surfaces, views[0], size=(width, size[1]), floor=views[1])
        picture.paste(Image.fromarray(pixels), (i * width, 0))
        shown = [mesh for mesh in meshes if mesh.path in panel.garments] or meshes
        count = f"{sum(len(mesh.points) for mesh in shown):,} vertices"
        label(pen, (i * width, 0), size[1], lines=[panel.title, count])
    if code is not None:
        place = (size[0] - size[1] // 36, size[1] - size[1] // 24)
        pen.text(place, f"{code:g}", FAINT, ImageFont.load_default(max(size[1] // 40, 8)), anchor="rs")
    return picture


def _is_refined(mesh: DrawnMesh, panel: _Panel) -> bool:
    """Whether a mesh is what the picture is about; all are where none is named."""
    return mesh.path in panel.garments or not panel.garments


def surface_of(mesh: DrawnMesh, *, lined: bool) -> Surface:
    """Prepare a mesh for drawing.

    Args:
        mesh: The mesh.
        lined: Whether its edges show.
    """
    surface = Surface(mesh.points, mesh.triangles, mesh.colors, mesh.edges if lined else None)
    while len(surface.points) < LIGHT_VERTICES and len(surface.triangles):
        surface = _split(surface)
    return surface


def _split(surface: Surface) -> Surface:
    """Quarter every triangle without changing the shape."""
    triangles = surface.triangles
    sides = np.sort(np.stack([np.roll(triangles, -1, axis=1), np.roll(triangles, -2, axis=1)], axis=2), axis=2)
    pairs, which = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    middle = len(surface.points) + which.reshape(-1, 3)  # middle[:, k] halves the edge opposite corner k
    points = np.concatenate([surface.points, surface.points[pairs].mean(axis=1)])
    (a, b, c), (p, q, r) = triangles.T, middle.T
    quarters = np.stack([np.stack(t, axis=1) for t in ((a, r, q), (r, b, p), (q, p, c), (p, q, r))], axis=1)
    edges = None
    if surface.edges is not None:
        keep = np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0], [0, 0, 0]], bool)
        edges = (surface.edges[:, None, :] & keep).reshape(-1, 3)
    return Surface(points, quarters.reshape(-1, 3), np.repeat(surface.colors, 4, axis=0), edges)


def label(pen: ImageDraw.ImageDraw, corner: tuple[int, int], height: int, *, lines: Sequence[str]) -> None:
    """Write a panel's title and, smaller, what it shows.

    Args:
        pen: Draws on the picture.
        corner: The panel's left and top [pixels].
        height: The panel's height [pixels].
        lines: The title, empty for none, and what stands below it.
    """
    unit = height // 36
    left, top = corner[0] + unit, corner[1]
    title, *below = lines
    if title:
        pen.text((left, top + 2 * unit), title, INK, ImageFont.load_default(max(int(1.25 * unit), 9)), anchor="ls")
    font = ImageFont.load_default(max(int(0.9 * unit), 8))
    for row, line in enumerate(below):
        place = top + int((3.3 + 1.2 * row) * unit if title else (2.0 + 1.2 * row) * unit)
        pen.text((left, place), line, FAINT, font, anchor="ls")


def _save_loop(pictures: list[Image.Image], stream: BinaryIO, rate: float, codes: list[float | None]) -> None:
    """Write a GIF with one palette for all frames and the shot's own speed."""
    chosen = [pictures[i] for i in np.linspace(0, len(pictures) - 1, 4).astype(int)]
    strip = Image.new("RGB", (chosen[0].width, sum(p.height for p in chosen)))
    for i, picture in enumerate(chosen):
        strip.paste(picture, (0, i * picture.height))
    palette = strip.quantize(160, method=Image.Quantize.MEDIANCUT)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    gap = float(np.median(np.diff([c for c in codes if c is not None]))) if len(codes) > 1 else 1.0
    frames[0].save(
        stream,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=max(20, round(1000.0 * gap / rate)),
        loop=0,
        optimize=True,
    )
