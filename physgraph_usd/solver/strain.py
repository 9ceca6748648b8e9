"""Which parts of a garment the animation holds at another size than the rest shape's.

Where the rest shape is not the cloth's, refined cloth returns to the rest shape's size: a puffed sleeve deflates. Cloth
pushed together in most frames is reported only, since folding it is what refining is for; the opposite gets a warning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .colliders.pose import extent
from .mesh.topology import joined_by
from .scene import Garment

STRAINED = 1.1
"""Area over rest area, or its inverse, from which a face is strained."""
LEAST_GATHERED = 0.25
"""Area over rest area under which cloth is not gathered: the rest shape is another one's, or broken."""
LEAST_FRACTION = 0.01
"""Of the garment's rest area; smaller parts, such as single faces in a fold, are passed over."""
MOST_STRETCHED = 0.1
"""Fraction of the garment's rest area that may need another rest shape without a warning. Skinning at raised arms and
edges under draped sheets stretch up to 6% of a garment by 18 to 44%; wrong rest shapes are another size on 14% or more.
"""
COVERED = 0.9
"""Fraction of a part's faces inside a subset from which the part is named after the subset."""
THIRD = 1.0 / 6.0
"""How far from the middle of a box its middle third ends, in its sizes."""
LARGEST = 4.0
"""Largest ratio of the sizes of refined cloth and cage, either way; the validator refuses larger ratios."""
COLLAPSED = 0.01
"""Ratio of cage size to rest size below which a frame is only upsampled: edges of a few centimetres at rest are then
shorter than the cloth is thick, and every vertex touches its neighbours."""


@dataclass(frozen=True)
class StrainedPart:
    """Connected faces whose area differs from their rest area in most frames.

    Attributes:
        where: Which part, in words: its subset, or the part of the rest shape.
        faces: Number of faces.
        area_ratio: Area over rest area, median over the frames.
        share: Of the garment's rest area.
    """

    where: str
    faces: int
    area_ratio: float
    share: float

    @property
    def needs_rest(self) -> bool:
        """Whether refining spoils the part: cloth that is larger shrinks, and far smaller cloth has another's shape."""
        return self.area_ratio > 1.0 or self.area_ratio < LEAST_GATHERED


def strained_parts(
    garment: Garment, frames: Sequence[np.ndarray], subsets: Mapping[str, np.ndarray], *, up: np.ndarray
) -> list[StrainedPart]:
    """Find the parts that are larger, or smaller, than at rest by more than a tenth in most frames.

    Args:
        frames: Positions of its cage [m], each of shape (V, 3).
        subsets: Faces of each named subset of the cage.
        up: Away from where gravity pulls, shape (3,), of any length.

    Returns:
        The parts, largest first.
    """
    rest = _face_areas(garment, garment.rest)
    if not frames or not rest.sum() > 0:
        return []
    areas = np.array([_face_areas(garment, points) for points in frames])
    ratio = np.divide(np.median(areas, axis=0), rest, out=np.ones_like(rest), where=rest > 0)
    parts = []
    for strained in (ratio > STRAINED, ratio < 1.0 / STRAINED):
        for faces in _connected(garment, np.flatnonzero(strained)):
            share = float(rest[faces].sum() / rest.sum())
            if share >= LEAST_FRACTION:
                size = float(np.median(areas[:, faces].sum(axis=1)) / rest[faces].sum())
                location = _where(garment, faces, subsets, up)
                parts.append(StrainedPart(location, len(faces), round(size, 3), round(share, 4)))
    return sorted(parts, key=lambda part: -part.share)


def size_left(garment: Garment, points: np.ndarray) -> float:
    """How large a cage at positions [m], shape (V, 3), is along its longest axis over its rest shape; 1 without one."""
    sizes = [float(extent(positions).max()) if len(positions) else 0.0 for positions in (points, garment.rest)]
    return sizes[0] / sizes[1] if sizes[1] > 0 else 1.0


def strayed(cage: np.ndarray, fine: np.ndarray, *, before: np.ndarray | None = None) -> str:
    """Why refined cloth is no refinement of its cage any more, in words, or "": farther from it than it is large, or of
    another size.

    Args:
        cage: Positions of the cage [m], shape (V, 3).
        fine: Positions of the refined cloth [m], shape (V_fine, 3).
        before: Positions of the cage in the frame before, or None: cloth may stay as small as that was.
    """
    if not len(cage) or not len(fine):
        return ""
    earlier = cage if before is None else before
    size, fine_size, earlier_size = (float(np.linalg.norm(extent(positions))) for positions in (cage, fine, earlier))
    # `mean` over rows is slow.
    middle, fine_middle = (np.ones(len(positions)) @ positions / len(positions) for positions in (cage, fine))
    away = float(np.linalg.norm(fine_middle - middle))
    if away > size:
        return f"the refined cloth lies {1e3 * away:.4g} mm from its cage, which is {1e3 * size:.4g} mm large"
    if not min(size, earlier_size) / LARGEST <= fine_size <= LARGEST * size:
        return f"the refined cloth is {1e3 * fine_size:.4g} mm large, its cage {1e3 * size:.4g} mm"
    return ""


def has_collapsed(garment: Garment, points: np.ndarray) -> bool:
    """Whether a cage at positions [m], shape (V, 3), has shrunk to nothing."""
    return size_left(garment, points) < COLLAPSED


def _face_areas(garment: Garment, points: np.ndarray) -> np.ndarray:
    """Area of each face of the cage [m^2], shape (F,)."""
    split = garment.mesh.triangulate(garment.rest)
    a, b, c = (points[split.triangles[:, corner]] for corner in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.bincount(split.face, area, garment.mesh.face_count)


def _connected(garment: Garment, faces: np.ndarray) -> list[np.ndarray]:
    """Connected components of faces, which share vertices."""
    mesh = garment.mesh
    corners = np.flatnonzero(np.isin(mesh.corner_face, faces))
    sides = np.stack([mesh.indices[corners], mesh.indices[mesh.next_corner[corners]]], axis=1)
    label = joined_by(sides, mesh.vertex_count)[mesh.indices[mesh.starts[faces]]]
    return [faces[label == number] for number in np.unique(label)]


def _where(garment: Garment, faces: np.ndarray, subsets: Mapping[str, np.ndarray], up: np.ndarray) -> str:
    """The smallest subset that covers the faces, or in which part of the rest shape's bounding box they are."""
    covering = [name for name, inside in subsets.items() if np.isin(faces, inside).mean() >= COVERED]
    if covering:
        return f"in GeomSubset {min(covering, key=lambda name: len(subsets[name]))}"
    if 4 * len(faces) > 3 * garment.mesh.face_count:
        return "all over it"
    corners = garment.mesh.indices[np.isin(garment.mesh.corner_face, faces)]
    low, size = garment.rest.min(axis=0), np.ptp(garment.rest, axis=0)
    middle = garment.rest[corners].mean(axis=0) - low
    at = np.divide(middle, size, out=np.full(3, 0.5), where=size > 0) - 0.5
    height = int(np.abs(up).argmax())
    upper = "upper part" if at[height] * up[height] > 0 else "lower part"
    part = f"in its {upper if abs(at[height]) > THIRD and up.any() else 'middle'}"
    across = [k for k in range(3) if abs(at[k]) > THIRD and not (k == height and up.any())]
    sides = [("+" if at[k] > 0 else "-") + "XYZ"[k] for k in across]
    return part + (f", towards {' and '.join(sides)}" if sides else "")
