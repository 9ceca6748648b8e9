"""How fine a garment must be: no more than its wrinkles, and whether it was fine enough.

The buckling wavelength is 2 pi sqrt(D / (Y strain)), with the compression of the cage's edges, 90th percentile over
a few frames. It is the shortest wave in which the cloth can fold; settled folds are longer (`folds.py`).
A level resolves it when its mean edge is under a fifth of it, and carries nothing of it when two edges are longer. That
is for the choice beforehand. Afterwards the folds show it: on too coarse a mesh wrinkles of its own size appear, and
edges fold sharply.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ..errors import StageError
from .folds import EDGES_PER_WAVE, raised_by
from .mesh.subdivide import fine_count
from .mesh.topology import edges_of
from .scene import Frame, Garment, GarmentFrame, Scene

if TYPE_CHECKING:
    from torch import Tensor

    from .level import Level

AUTO = -1
MOST = 4
SAMPLED_FRAMES = 5
LEAST_STRAIN = 0.01
SHARP_FOLD = math.radians(45.0)
SHARP_FRACTION = 0.01
"""Fraction of sharp folds from which the mesh shows: 0.1% on the T-shirt at level 3, 1.1% at level 2, where it does."""
LEAST_TENSION = 1e-9
"""[N/m]; cloth without stiffness does not buckle."""
SHORTEST_WAVE = 1e-3
"""In cage edges; cloth that does not resist bending has no shortest wave."""


@dataclass(frozen=True)
class LevelChoice:
    """A garment's number of subdivisions and why.

    Attributes:
        level: Number of subdivisions.
        reason: Why, in words.
        wavelength: Buckling wavelength [m].
        edge: Mean rest edge at that level [m].
        needed: The least level that resolves the wavelength.
        vertices: Number of vertices at the chosen level, and at the one needed.
        raised: For the cage and each level up to the chosen one, how many times its own the bending stiffness is on
            the mean edge.
        compression: Compression of the cage's edges, 90th percentile over the frames, at least `LEAST_STRAIN`; 0
            without edges or frames.
    """

    level: int
    reason: str
    wavelength: float
    edge: float
    needed: int
    vertices: tuple[int, int]
    raised: tuple[float, ...] = ()
    compression: float = 0.0

    @property
    def is_tight(self) -> bool:
        """Whether the cage has no slack: edge compression is at most `LEAST_STRAIN`, too little for folds."""
        return 0.0 < self.compression <= LEAST_STRAIN


def sample_frames(
    times: Sequence[float], frame_at: Callable[[float | None], Frame], *, most: int = SAMPLED_FRAMES
) -> list[Frame]:
    """Read a few frames spread over the shot, the first and the last among them; unreadable ones are left out.

    Args:
        times: Its time codes; of none, the default values are read.
        frame_at: Reads a frame.
        most: Most frames to read.
    """
    picks = np.linspace(0, len(times) - 1, min(most, len(times))).round().astype(int)
    picked: list[float | None] = [times[i] for i in picks] or [None]
    return [frame for time in picked if (frame := _readable(frame_at, time)) is not None]


def choose_levels(scene: Scene, frames: Sequence[Frame]) -> list[LevelChoice]:
    """Take each garment's own level, or for `AUTO` the least that resolves its wrinkles.

    Args:
        frames: A few of its frames.

    Returns:
        One choice per garment.
    """
    return [
        _choose(garment, [frame.garments[index] for frame in frames]) for index, garment in enumerate(scene.garments)
    ]


def _readable(frame_at: Callable[[float | None], Frame], time: float | None) -> Frame | None:
    """A frame, or None where the stage is broken: its turn to be refined will name what is wrong."""
    try:
        return frame_at(time)
    except StageError:
        return None


def _choose(garment: Garment, frames: list[GarmentFrame]) -> LevelChoice:
    ends = edges_of(garment.mesh.triangulate(garment.rest).triangles, garment.mesh.vertex_count).vertices
    if not len(ends) or not frames:
        level = 0 if garment.level == AUTO else garment.level
        count = fine_count(garment.mesh, level)
        return LevelChoice(level, "there are no faces or no readable frames to go by", 0.0, 0.0, level, (count, count))
    fabric = frames[0].fabric
    rest = np.linalg.norm(garment.rest[ends[:, 1]] - garment.rest[ends[:, 0]], axis=1)
    rest = rest * (1.0 + max(fabric.warp_ease, fabric.weft_ease))
    strain, edge = _compression(rest, ends, frames), float(rest.mean())
    wave = 2.0 * math.pi * math.sqrt(fabric.bend / max(fabric.stretch * strain, LEAST_TENSION))
    text = f"wrinkles of {1e3 * wave:.1f} mm (compression {strain:.2g}), cage edges of {1e3 * edge:.1f} mm"
    needed = math.ceil(math.log2(max(edge * EDGES_PER_WAVE / max(wave, SHORTEST_WAVE * edge), 1.0)))
    level, reason = garment.level, f"as authored or asked for; {text}"
    if level == AUTO:
        level, reason = (
            min(needed, MOST),
            f"auto: {text}" + (f", which takes no more than level {MOST}" * (needed > MOST)),
        )
    fine = edge / 2**level
    counts = fine_count(garment.mesh, level), fine_count(garment.mesh, needed)
    raised = tuple(raised_by(fabric, edge / 2**depth) if garment.raises_bending else 1.0 for depth in range(level + 1))
    reason += f"; edges of {1e3 * fine:.1f} mm resolve wrinkles of {1e3 * EDGES_PER_WAVE * fine:.1f} mm and more"
    reason += f"; bending is raised {raised[-1]:.3g} times" if raised[-1] > 1.0 else ""
    return LevelChoice(level, reason, wave, fine, needed, counts, raised, strain)


def _compression(rest: np.ndarray, ends: np.ndarray, frames: list[GarmentFrame]) -> float:
    """90th percentile of the cage edges' compression over some frames."""
    lengths = [np.linalg.norm(f.points[ends[:, 1]] - f.points[ends[:, 0]], axis=1) for f in frames]
    ratios = np.concatenate(lengths) / np.tile(np.maximum(rest, 1e-12), len(frames))
    return max(float(np.percentile(1.0 - ratios, 90)), LEAST_STRAIN)


def sharp_folds(level: Level, x: Float[Tensor, "vertices 3"]) -> float:
    """Fraction of the hinges that fold by more than 45 degrees."""
    return float((level.folds(x) < math.cos(SHARP_FOLD)).double().mean()) if len(level.hinges) else 0.0


def edge_strain(level: Level, x: Float[Tensor, "vertices 3"]) -> dict[str, float]:
    """Size of the edges' relative extension: median, 99th percentile and largest."""
    if not len(level.edges):
        return {"p50": 0.0, "p99": 0.0, "max": 0.0}
    strain = (level.lengths(x) / level.rest_length - 1.0).abs().cpu().numpy()
    p99, p50 = (_percentile(strain, share) for share in (0.99, 0.5))
    return {"p50": p50, "p99": p99, "max": float(strain.max())}


def _percentile(values: np.ndarray, share: float) -> float:
    """The value with a share of the values, shape (N,), below: `np.percentile`, but faster; it reorders the values."""
    at = share * (len(values) - 1)
    below = int(at)
    values.partition(below)
    low, high = values[below], values[below + 1 :].min(initial=values.max())
    apart, part = float(high - low), at - below
    return float(low) + apart * part if part < 0.5 else float(high) - apart * (1.0 - part)
