"""Pictures of cloth and bodies side by side, for docs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.rows import say
from physgraph_usd.shot.page.drawing import Surface, View, draw, fit_view
from physgraph_usd.shot.page.preview import label

CLOTH, BODY = (0.30, 0.42, 0.50), (0.55, 0.48, 0.42)
"""Colours."""


@dataclass(frozen=True, eq=False)
class Thing:
    """Something drawn.

    Attributes:
        points: Positions [m], Y up, shape (V, 3).
        triangles: Corners, shape (T, 3).
        cloth: Whether it is cloth, which the camera looks at; or a body.
    """

    points: np.ndarray
    triangles: np.ndarray
    cloth: bool = True

    def surface(self) -> Surface:
        """To be drawn."""
        color = CLOTH if self.cloth else BODY
        return Surface(self.points, self.triangles, np.tile(color, (len(self.triangles), 1)))


def upright(points: np.ndarray) -> np.ndarray:
    """Positions whose up was z, with y up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def drawn(
    panels: Sequence[tuple[str, Sequence[Thing]]], view: View, *, size: tuple[int, int], floor: float
) -> Image.Image:
    """Panels side by side from one camera."""
    sheet = Image.new("RGB", (len(panels) * size[0], size[1]))
    pen = ImageDraw.Draw(sheet)
    for place, (title, things) in enumerate(panels):
        pixels = draw([thing.surface() for thing in things], view, size=size, floor=floor)
        sheet.paste(Image.fromarray(pixels), (place * size[0], 0))
        label(pen, (place * size[0], 0), size[1], lines=[title])
    return sheet


def framing(things: Sequence[Thing], size: tuple[int, int], camera: tuple[float, float]) -> tuple[View, float]:
    """A camera that sees all cloth, and the floor's height [m]."""
    points = np.concatenate([thing.points for thing in things if thing.cloth])
    view = fit_view(points, size[0] / size[1], azimuth=camera[0], elevation=camera[1])
    return view, float(points[:, 1].min()) - 0.02


def still(
    panels: Sequence[tuple[str, Sequence[Thing]]], out: Path, *, camera: tuple[float, float], size=(400, 460)
) -> None:
    """Write panels as one picture."""
    view, floor = framing([thing for _, things in panels for thing in things], size, camera)
    sheet = drawn(panels, view, size=size, floor=floor)
    out.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(128, kmeans=2, dither=Image.Dither.NONE).save(out, optimize=True)
    say(f"{out}: {out.stat().st_size / 1e3:.0f} kB")
