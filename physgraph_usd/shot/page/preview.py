"""Draws a refined layer beside its input shot: PNG stills and GIF loops, headless."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ...errors import LayerError, StageError, UsageError, named_time
from ...solver.scene import SAME_TIME
from ...usd.files import check_targets, files_of
from ...usd.read.meshes import NEUTRAL, DrawnMesh, DrawnStage, refined_in, shot_of
from ...usd.write.atomic import check_place, make_file, prepare_target, publish, temporary_path
from .drawing import BACKGROUND, BODY_COLOR, CLOTH_COLOR, View, draw, encode_color, fit_view, vertex_normals
from .worst import CLOSE, CloseUp

STILL, LOOP = ".png", ".gif"
"""Formats by suffix."""

CAMERA = (25.0, 10.0)
"""Azimuth and elevation [degrees]."""

ELEVATIONS = (-30.0, 45.0)
"""Elevations of a close picture's camera [degrees]."""

COMPRESSION = {"compress_level": 1}
"""Of a PNG: Pillow's strongest compression takes as long as drawing and saves a tenth."""

TURNS = (
    *((turn, 0.0) for turn in (0.0, 30.0, -30.0)),
    *((turn, lift) for lift in (25.0, -25.0) for turn in (0.0, 30.0, -30.0)),
    *((turn, 0.0) for turn in (60.0, -60.0, 180.0, 150.0, 210.0, 120.0, 240.0)),
)
"""Turns of a close picture's camera about the place, azimuth and elevation [degrees], until the place is in open view.
From 90 degrees on the camera sees the cloth's inner side."""
MOST_TURNED = 4
"""Most places that the camera turns about."""
CUT = 0.25
"""Distance before a place, in radii of its picture, up to which everything belongs to the place."""

INK, FAINT = (38, 40, 44), (112, 114, 118)
"""Colours of the labels."""


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
    """Draw the smoothly subdivided input beside the refined cloth, or a plain shot alone.

    Args:
        layer: A refined layer, or a shot.
        out: Picture to write: ``.png`` draws one time, ``.gif`` a loop.
        shot: The shot under the layer; read from the layer's record if None.
        times: Time codes to draw; if None, the last sample for a PNG and all samples for a GIF.
        size: Width and height [pixels].
        camera: Azimuth and elevation [degrees]; `CAMERA` if None.
        overwrite: Whether an existing picture may be replaced.

    Returns:
        The picture written.

    Raises:
        UsageError: As in `check_picture`, or the picture is a link or a file of the shot.
        LayerError: When the picture cannot be written.
        StageError: When a stage cannot be opened or shows no mesh.
    """
    layer, out = Path(layer), Path(out)
    check_picture(out, times=times, overwrite=True)  # A file of the shot is named as such below.
    suffix = out.suffix.lower()
    below = shot_of(layer) if shot is None else Path(shot)
    check_targets([("the picture", out)], files_of(layer) | (files_of(below) if below else set()))
    check_place(out)
    prepare_target(out, overwrite=overwrite)
    pictures = Pictures(layer, below, size, codes=times)
    codes = [float(time) for time in times] if times is not None else pictures.times or [None]
    _refuse_outside(layer, codes, [time for time in pictures.times if time is not None])
    drawn = pictures.draw(codes[-1:] if suffix == STILL else codes, camera or CAMERA)
    temporary = temporary_path(out, suffix=out.suffix)
    try:
        with make_file(temporary) as stream:
            if suffix == STILL:
                drawn[0].save(stream, "PNG", **COMPRESSION)
            else:
                _save_loop(drawn, stream, pictures.rate, codes)
        publish(temporary, out)
    except OSError as error:
        raise LayerError(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)
    return out


def _refuse_outside(layer: Path, codes: Sequence[float | None], sampled: Sequence[float]) -> None:
    """Refuse (UsageError) time codes before the first or after the last sample of the drawn garments."""
    for code in codes:
        if code is not None and sampled and not min(sampled) - SAME_TIME <= code <= max(sampled) + SAME_TIME:
            within = f"time codes {named_time(min(sampled))} to {named_time(max(sampled))}"
            raise UsageError(f"{layer} has no cloth at time code {named_time(code)}, only at {within}")


def check_picture(out: Path, *, times: Sequence[float] | None, overwrite: bool) -> None:
    """Refuse (UsageError) an unknown suffix, several time codes for a still, and a picture that exists.

    Args:
        out: Picture to write.
        times: Time codes to draw; None for the usual ones.
        overwrite: Whether an existing picture may be replaced.
    """
    suffix = out.suffix.lower()
    if suffix not in {STILL, LOOP}:
        raise UsageError(f"cannot draw {out.name!r}; known suffixes: {STILL}, {LOOP}")
    if times is not None and suffix == STILL and len(times) != 1:
        raise UsageError(f"a {STILL} shows one time code, not {len(times)}; write a {LOOP} for several")
    if out.is_file() and not overwrite:
        raise UsageError(f"{out} exists; choose another name or replace it by --overwrite")


class Pictures:
    """A refined layer beside its input shot, or a plain shot alone.

    The refined cloth is drawn as a renderer draws it, by its subdivision surface. The input is subdivided smoothly to
    as many faces.

    Attributes:
        times: Time codes with samples.
        rate: Time codes per second.
    """

    def __init__(
        self, layer: Path, shot: Path | None, size: tuple[int, int], *, codes: Sequence[float] | None = None
    ) -> None:
        """Open the stages.

        Args:
            layer: A refined layer, or a plain shot.
            shot: The shot under the layer; None for a plain shot.
            size: Width and height of a picture [pixels].
            codes: Time codes to skin skinned meshes for; all if None.

        Raises:
            StageError: A stage cannot be opened.
        """
        drawn = DrawnStage(layer) if shot is None else DrawnStage(shot, layer)
        self._stages = [drawn] if shot is None else [DrawnStage(shot, beside=drawn), drawn]
        self._refined = () if shot is None else refined_in(layer)
        named = set(self._refined) & set(self._stages[0].paths())
        self._garments = tuple(sorted(named)) or self._stages[0].garments()
        self._titles = ("",) if shot is None else ("Input, subdivided", "Refined")
        self._panel, self._size = (size[0] // len(self._stages), size[1]), size
        self.rate = self._stages[-1].rate
        self.times: list[float | None] = list(self._stages[-1].times(self._refined or self._garments))
        self._cages = {*self._garments, *self._refined} if self._garments else None
        for stage in self._stages:
            stage.bake(tuple(code for code in (codes or self.times) if code is not None))

    def draw(self, codes: Sequence[float | None], camera: tuple[float, float] = CAMERA) -> list[Image.Image]:
        """Draw some time codes with one camera.

        Raises:
            StageError: A stage shows no mesh.
        """
        sampled = [self.times[i] for i in np.linspace(0, len(self.times) - 1, 5).astype(int)] if self.times else []
        spread = codes if len(codes) > 1 else [*codes, *sampled]  # Stills of one shot share their framing.
        clouds = [self._in_picture(self._stages[0].meshes(code, cages=self._cages)) for code in spread]
        if not any(map(len, clouds)):
            raise StageError("nothing to draw: the stage shows no mesh")
        points = np.concatenate(clouds)
        view = fit_view(points, self._panel[0] / self._panel[1], azimuth=camera[0], elevation=camera[1])
        floor = float(points[:, 1].min() - 0.03 * np.ptp(points, axis=0).max())
        return [self._compose(self._sides(code), code, view, floor) for code in codes]

    def draw_close(self, close: CloseUp) -> tuple[Image.Image, str]:
        """Draw both sides around a place in refined cloth, from a direction in which the place is in open view.

        The camera sees the outer side of the cloth if it can, and turns else. Bodies that hide the place in every
        direction are left out. If cloth hides it in every direction, everything before the place is cut away.

        Returns:
            The picture, and what was done to show the place, in words; "" for nothing.

        Raises:
            StageError: The stage does not show the mesh.
        """
        sides = self._sides(close.time)
        mesh = next((drawn_mesh for drawn_mesh in sides[-1] if drawn_mesh.path == close.path), None)
        if mesh is None:
            raise StageError(f"nothing to draw: <{close.path}> is not shown")
        radius = CLOSE * float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
        normals = vertex_normals(mesh)
        views = [(mesh.points[vertex], _angles(mesh.points, vertex, normals[vertex])) for vertex in close.vertices]
        centre, angles, left_out = self._open_view(sides[-1], views, radius=radius)
        ball = centre + radius * np.concatenate([np.eye(3), -np.eye(3)])
        view = fit_view(ball, self._panel[0] / self._panel[1], azimuth=angles[0], elevation=angles[1])
        remaining = [[mesh for mesh in meshes if mesh.path not in left_out] for meshes in sides]
        words = f"without {', '.join(f'<{path}>' for path in left_out)}, which would hide it" if left_out else ""
        reach = 2.0 * radius
        if not _is_open(remaining[-1], centre, angles, radius=radius):
            remaining = [[_cut(mesh, centre, view.axes[2], CUT * radius) for mesh in meshes] for meshes in sides]
            reach, words = CUT * radius, "cut open before it"
        nearest = float(np.linalg.norm(centre - view.eye)) - reach
        return self._compose(remaining, close.time, replace(view, nearest=nearest), -np.inf), words

    def _open_view(
        self, meshes: Sequence[DrawnMesh], views: Sequence[tuple[np.ndarray, tuple[float, float]]], *, radius: float
    ) -> tuple[np.ndarray, tuple[float, float], list[str]]:
        """The first place and direction in open view, and the bodies left out for it.

        Args:
            views: Places, shape (3,), with azimuth and elevation of the cloth's outer side [degrees].
            radius: Radius of the picture [m].
        """
        turned = [(centre, _turned(angles, *turn)) for turn in TURNS[1:] for centre, angles in views[:MOST_TURNED]]
        bodies = {mesh.path for mesh in meshes} - {*self._garments, *self._refined}
        cloth = [mesh for mesh in meshes if mesh.path not in bodies]
        for drawn in (meshes, cloth):
            for centre, angles in (*views, *turned):
                if _is_open(drawn, centre, angles, radius=radius):
                    hidden_by = [mesh.path for mesh in meshes if not _is_open([mesh], centre, angles, radius=radius)]
                    return centre, angles, hidden_by
        return *views[0], []

    def _in_picture(self, meshes: Sequence[DrawnMesh]) -> np.ndarray:
        """Points in a box a little larger than the garments, to show the surrounding body."""
        if not meshes:
            return np.zeros((0, 3))
        points = np.concatenate([mesh.points for mesh in meshes])
        garments = np.concatenate([mesh.points for mesh in meshes if mesh.path in self._garments] or [points])
        low, high = garments.min(axis=0), garments.max(axis=0)
        margin = 0.25 * float((high - low).max())
        return points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]

    def _sides(self, code: float | None) -> list[list[DrawnMesh]]:
        sides = [self._stages[0].meshes(code, cages=self._cages)]
        if len(self._stages) > 1:
            cages = None if self._cages is None else self._cages.difference(self._refined)
            sides.append(self._stages[1].meshes(code, cages=cages))
        faces = {mesh.path: mesh.mesh.face_count for mesh in sides[-1] if mesh.path in self._refined}
        coarse = [mesh.subdivided(faces.get(mesh.path, faces.get(f"{mesh.path}_refined", 0))) for mesh in sides[0]]
        return [[self._colored(mesh) for mesh in side] for side in (coarse, *sides[1:])]

    def _colored(self, mesh: DrawnMesh) -> DrawnMesh:
        """A mesh with the usual colour of cloth or bodies on faces without a colour, if the stage names its cloth."""
        if not self._garments and not self._refined:
            return mesh
        usual = CLOTH_COLOR if mesh.path in (*self._garments, *self._refined) else BODY_COLOR
        without = (mesh.face_colors == NEUTRAL).all(axis=1, keepdims=True)
        return replace(mesh, face_colors=np.where(without, usual, mesh.face_colors))

    def _compose(
        self, sides: Sequence[Sequence[DrawnMesh]], code: float | None, view: View, floor: float
    ) -> Image.Image:
        """The labelled panels of a time code."""
        picture = Image.new("RGB", self._size, encode_color(tuple(BACKGROUND)))
        pen = ImageDraw.Draw(picture)
        for i, (title, meshes) in enumerate(zip(self._titles, sides, strict=True)):
            pixels = draw(meshes, view, size=self._panel, floor=floor)
            picture.paste(Image.fromarray(pixels), (i * self._panel[0], 0))
            visible = [mesh for mesh in meshes if mesh.path in (*self._garments, *self._refined)] or meshes
            count = f"{sum(mesh.authored for mesh in visible):,} vertices"
            label(pen, (i * self._panel[0], 0), self._panel[1], lines=[title, count])
        if code is not None:
            corner = (self._size[0] - self._size[1] // 36, self._size[1] - self._size[1] // 24)
            pen.text(corner, f"{code:g}", FAINT, ImageFont.load_default(max(self._size[1] // 40, 8)), anchor="rs")
        return picture


def _angles(points: np.ndarray, vertex: int, normal: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation of the outer side of a mesh at a vertex [degrees]."""
    outward = normal if normal @ (points[vertex] - points.mean(axis=0)) >= 0 else -normal
    elevation = float(np.degrees(np.arcsin(np.clip(outward[1], -1.0, 1.0))))
    return float(np.degrees(np.arctan2(outward[0], outward[2]))), float(np.clip(elevation, *ELEVATIONS))


def _cut(mesh: DrawnMesh, centre: np.ndarray, backward: np.ndarray, reach: float) -> DrawnMesh:
    """A mesh without the faces that stand wholly before a place, seen from a direction.

    Args:
        mesh: The mesh.
        centre: The place [m], shape (3,).
        backward: Direction from the place to the camera, shape (3,).
        reach: Distance before the place from which on faces are left out [m].
    """
    counts, before = mesh.mesh.counts, (mesh.points - centre) @ backward
    number = np.repeat(np.arange(len(counts)), counts)
    stays = np.bincount(number, before[mesh.mesh.indices] <= reach, minlength=len(counts)) > 0
    polygons = replace(mesh.mesh, counts=counts[stays], indices=mesh.mesh.indices[stays[number]])
    return replace(mesh, mesh=polygons, face_colors=mesh.face_colors[stays])


def _turned(angles: tuple[float, float], turn: float, lift: float) -> tuple[float, float]:
    """Azimuth and elevation turned by some degrees."""
    return angles[0] + turn, float(np.clip(angles[1] + lift, *ELEVATIONS))


def _is_open(meshes: Sequence[DrawnMesh], centre: np.ndarray, angles: tuple[float, float], *, radius: float) -> bool:
    """Whether no vertex beside the line of sight, and no face across it, stands before a place.

    Args:
        angles: Azimuth and elevation of the line of sight [degrees].
        radius: Radius of the picture [m]; what stands less than `CUT` of it before the place belongs to the place.
    """
    azimuth, elevation = np.radians(angles)
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    for mesh in meshes:
        x, y, before = np.stack([right, np.cross(direction, right), direction]) @ (mesh.points - centre).T
        hides = before > CUT * radius
        if (hides & (np.hypot(x, y) < 0.5 * radius)).any():
            return False
        a = mesh.triangles[hides[mesh.triangles].any(axis=1)]
        b = np.roll(a, 1, axis=1)
        areas = x[a] * y[b] - x[b] * y[a]  # Of the corner opposite to each edge, twice: barycentric on the line.
        across = np.abs(np.sign(areas).sum(axis=1)) == 3.0
        weights, corners = np.abs(areas[across]), np.roll(a[across], -1, axis=1)
        if ((weights * before[corners]).sum(axis=1) > CUT * radius * weights.sum(axis=1)).any():
            return False
    return True


def label(pen: ImageDraw.ImageDraw, corner: tuple[int, int], height: int, *, lines: Sequence[str]) -> None:
    """Write a panel's title and, smaller, further lines.

    Args:
        pen: Draws on the picture.
        corner: The panel's left and top [pixels].
        height: The panel's height [pixels].
        lines: The title, empty for none, and the lines below.
    """
    unit = height // 36
    left, top = corner[0] + unit, corner[1]
    title, *below = lines
    if title:
        pen.text((left, top + 2 * unit), title, INK, ImageFont.load_default(max(int(1.25 * unit), 9)), anchor="ls")
    font = ImageFont.load_default(max(int(0.9 * unit), 8))
    for row, line in enumerate(below):
        baseline = top + int((3.3 + 1.2 * row) * unit if title else (2.0 + 1.2 * row) * unit)
        pen.text((left, baseline), line, FAINT, font, anchor="ls")


def _save_loop(pictures: list[Image.Image], stream: BinaryIO, rate: float, codes: Sequence[float | None]) -> None:
    """Write a GIF with a common palette for all frames, at the shot's speed."""
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
