"""Maps of solved cloth: numbers at fine vertices, and their colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ..solver.frame.refiner import Refiner
from ..solver.scene import Frame
from ..usd.schema import GARMENT
from .brush import Stroke
from .session import TuneSession
from .takes import Shown
from .values import MAPS, on_fine

PLAIN = "none"
LOW, MIDDLE, HIGH = np.array([[36, 64, 142], [222, 222, 218], [178, 24, 43]], float)
"""Colours, sRGB, of the least value, of the value that changes nothing, and of the largest."""
MOST_STRAIN, MOST_DISTANCE = 5.0, 10.0
"""Ends of the colour bar [%], [mm]."""


@dataclass(frozen=True)
class Map:
    """Colours of a map.

    Attributes:
        name: What the page calls it.
        unit: Of its values.
        ends: Values in the full colours; grey is at ``middle``.
        middle: The value that changes nothing.
    """

    name: str
    unit: str
    ends: tuple[float, float]
    middle: float

    @property
    def stops(self) -> list[float]:
        """The values with a colour of their own, ascending; those between have colours between."""
        return sorted({*self.ends, self.middle})

    def colors(self, values: np.ndarray | None = None) -> np.ndarray:
        """Colours of values, shape (V,), or of the stops: bytes, shape (V, 4)."""
        own = [LOW if at < self.middle else HIGH if at > self.middle else MIDDLE for at in self.stops]
        at = np.nan_to_num(self.stops if values is None else values)
        rgb = [np.interp(at, self.stops, channel) for channel in np.transpose(own)]
        return np.stack([*rgb, np.full(len(at), 255.0)], axis=1).round().astype(np.uint8)


def stretches(refiner: Refiner, frame: Frame, index: int, points: np.ndarray) -> np.ndarray:
    """Strains of a garment at fine positions: along the warp, along the weft, and the least in the surface [%].

    Means over the faces of each vertex, by their rest areas, shape (V, 3); eased cloth is longer than the rest shape.
    """
    group = refiner.group_of((index,))
    level = group.levels[-1].eased([frame.garments[index].fabric])
    corners = torch.as_tensor(points, dtype=level.dtype)[level.membrane.long().cpu()]
    sides = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], dim=2)
    along = sides @ level.membrane_inverse.cpu().reshape(-1, 2, 2)
    gram = along.transpose(1, 2) @ along
    warp, weft, cross = gram[:, 0, 0], gram[:, 1, 1], gram[:, 0, 1]
    least = 0.5 * (warp + weft) - ((0.5 * (warp - weft)) ** 2 + cross**2).sqrt()
    strains = 100.0 * (torch.stack([warp, weft, least.clamp_min(0.0)], dim=1).sqrt() - 1.0)
    weighted = level.membrane_area.cpu()[:, None] * torch.cat([strains, torch.ones_like(strains[:, :1])], dim=1)
    total = torch.zeros(len(points), 4, dtype=weighted.dtype)
    total.index_add_(0, level.membrane.long().cpu().reshape(-1), weighted.repeat_interleave(3, dim=0))
    return (total[:, :3] / total[:, 3:].clamp_min(1e-30)).numpy()


def distances(refiner: Refiner, frame: Frame, index: int, points: np.ndarray) -> np.ndarray:
    """Distance of a garment's fine positions to the nearest felt body [mm], shape (V,); infinite without bodies."""
    least = torch.full((len(points),), np.inf, dtype=torch.float64)
    for each in refiner.touching((index,), frame):
        x = torch.as_tensor(points - each.surface.origin, dtype=torch.float64)
        least = torch.minimum(least, each.surface.closest(x, torch.full_like(least, np.inf)).distance.cpu())
    return 1e3 * least.numpy()


def crossings(refiner: Refiner, frame: Frame, index: int, points: np.ndarray) -> np.ndarray:
    """1 at fine vertices in crossings with cloth or bodies, else 0, shape (V,)."""
    heat = refiner.heat(index, points)
    return np.maximum(heat["crossing"], heat["penetration"] > 0)


Finder = Callable[[Refiner, Frame, int, np.ndarray], np.ndarray]
"""Finds the values of a solver's garment, by number, in a frame at fine positions [m], shape (V, 3)."""

_SIGNED = (-MOST_STRAIN, MOST_STRAIN)
MEASURED: dict[str, tuple[Map, Finder]] = {
    each.name: (each, find)
    for each, find in (
        (Map("strain along warp", "%", _SIGNED, 0.0), lambda *at: stretches(*at)[:, 0]),
        (Map("strain along weft", "%", _SIGNED, 0.0), lambda *at: stretches(*at)[:, 1]),
        (Map("compression", "%", (-MOST_STRAIN, 0.0), 0.0), lambda *at: np.minimum(stretches(*at)[:, 2], 0.0)),
        (Map("distance to bodies", "mm", (0.0, MOST_DISTANCE), MOST_DISTANCE), distances),
        (Map("crossings", "", (0.0, 1.0), 0.0), crossings),
    )
}
"""Maps that are measured in the solved cloth. Compression is what is left in the plane: shorter folds than the level's
edges can show would take it up."""
NAMES = (PLAIN, *MEASURED, *MAPS)
"""Every map, the painted ones by the schema's short names."""


def painted_map(name: str, largest: float) -> Map:
    """Colours of a painted map with values up to ``largest``; the session has the values."""
    row = GARMENT[name]
    middle = float(row.fallback or 0.0)
    ends = (min(row.minimum or 0.0, middle - 1.0), max(largest, middle + 1.0))
    return Map(name, row.unit, ends, middle)


def find_map(
    session: TuneSession, shown: Shown, index: int, name: str, *, stroke: Stroke | None = None
) -> tuple[Map, np.ndarray] | None:
    """A map of a garment, by number, and its values at the fine vertices, shape (V,); None for `PLAIN`.

    A ``stroke`` stands in for the session's map.
    """
    points = shown.garments[index].points
    if name == PLAIN or points is None:
        return None
    if name in MEASURED:
        measured, find = MEASURED[name]
        return measured, find(session.solver.refiner, shown.frame, index, points)
    garment = session.garments[index]
    under = stroke is not None and (stroke.garment, stroke.name) == (garment, name)
    painted = stroke.values if stroke is not None and under else session.painted(garment, name)
    values = on_fine(painted, session.refinements[index])
    return painted_map(name, float(values.max(initial=0.0))), values
