"""T-shaped pillows of quads: two flat panels sewn along their outline and inflated.

Both the T-shirt and the body in it are made this way. The height of the panels is the square root of the solution
of a Poisson equation that is zero on the seams and free on the openings: across a strip that gives an ellipse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ...usd.write.plain import FaceVarying


@dataclass(frozen=True)
class Cut:
    """Measures of a T-shape [m].

    Attributes:
        half_width: Half width of the torso.
        armpit, shoulder, hem: Heights of the armpit, of the shoulder and of the lower end.
        sleeve: Length of a sleeve beyond the torso.
        neck: Half width of the neck's opening; 0 closes it.
        cells: Quads across the torso, along a sleeve, below the armpit and across a sleeve.
        closed: Whether hem and sleeve ends are sewn too.
        depth: Half depth over half width, of the torso and of the sleeves.
    """

    half_width: float
    armpit: float
    shoulder: float
    hem: float
    sleeve: float
    neck: float
    cells: tuple[int, int, int, int]
    closed: bool = False
    depth: tuple[float, float] = (0.66, 0.92)


@dataclass(frozen=True, eq=False)
class Pillow:
    """A sewn and inflated T-shape.

    Attributes:
        quads: Faces, front panel first, shape (F, 4).
        points: Positions with level sleeves [m], shape (V, 3); Z is front.
        uv: The panels side by side.
        cell: Row and column of each face on its panel, shape (F, 2).
    """

    quads: np.ndarray
    points: np.ndarray
    uv: FaceVarying
    cell: np.ndarray


def sew(cut: Cut) -> Pillow:
    """A T-shape cut, sewn and inflated."""
    x, y = _lines(cut)
    torso, sleeve, below, _ = cut.cells
    rows, columns = np.meshgrid(np.arange(len(y)), np.arange(len(x)), indexing="ij")
    on_torso = (columns >= sleeve) & (columns <= sleeve + torso)
    used = on_torso | (rows >= below)
    seam = used & _seams(cut, rows, columns, x)
    number = np.where(used, np.cumsum(used).reshape(used.shape) - 1, -1)
    corners = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1)
    is_whole = (corners >= 0).all(axis=-1)
    cells, quads = np.argwhere(is_whole), corners[is_whole]
    flat = np.stack([x[columns[used]], y[rows[used]]], axis=1)
    t = np.clip((np.abs(flat[:, 0]) / cut.half_width - 0.75) / 0.5, 0.0, 1.0)
    depth = cut.depth[0] + (cut.depth[1] - cut.depth[0]) * t * t * (3.0 - 2.0 * t)
    height = _inflate(flat, quads, seam[used]) * depth
    count = len(flat)
    back = np.where(seam[used], np.arange(count), count + np.cumsum(~seam[used]) - 1)
    points = np.concatenate(
        [np.column_stack([flat, height]), np.column_stack([flat[~seam[used]], -height[~seam[used]]])]
    )
    middle = flat.min(axis=0)
    size = 2.1 * float(np.ptp(flat[:, 0]))
    uv = (flat - middle) / size
    mirrored = np.column_stack([1.0 - uv[:, 0], uv[:, 1]])
    return Pillow(
        np.concatenate([quads, back[quads][:, ::-1]]),
        points,
        FaceVarying(np.concatenate([uv, mirrored]), np.concatenate([quads, (count + quads)[:, ::-1]]).ravel()),
        np.concatenate([cells, cells]),
    )


def _lines(cut: Cut) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the grid's columns and rows, closer together towards seams."""
    torso, sleeve, below, across = cut.cells
    inner = cut.half_width * _ends_closer(torso, 0.5)
    step = cut.sleeve * np.arange(1, sleeve + 1) / sleeve
    x = np.concatenate([-cut.half_width - step[::-1], inner, cut.half_width + step])
    low = cut.hem + (cut.armpit - cut.hem) * np.arange(below) / below
    high = 0.5 * (cut.armpit + cut.shoulder) + 0.5 * (cut.shoulder - cut.armpit) * _ends_closer(across, 0.6)
    return x, np.concatenate([low, high])


def _ends_closer(cells: int, cosine: float) -> np.ndarray:
    """Positions from -1 to 1 with even spacing and a fraction of cosine spacing."""
    even = np.linspace(-1.0, 1.0, cells + 1)
    return (1.0 - cosine) * even + cosine * np.sin(0.5 * np.pi * even)


def _seams(cut: Cut, rows: np.ndarray, columns: np.ndarray, x: np.ndarray) -> np.ndarray:
    torso, sleeve, below, _ = cut.cells
    sides = ((columns == sleeve) | (columns == sleeve + torso)) & (rows <= below)
    under = (rows == below) & ((columns <= sleeve) | (columns >= sleeve + torso))
    top = (rows == rows.max()) & (np.abs(x[columns]) >= cut.neck)
    ends = (rows == 0) | (columns == 0) | (columns == columns.max())
    return sides | under | top | (ends & cut.closed)


def _inflate(flat: np.ndarray, quads: np.ndarray, seam: np.ndarray) -> np.ndarray:
    """Square root of the solution of laplace(u) = -2, zero on seams, free elsewhere (five-point finite volumes)."""
    count = len(flat)
    width = flat[quads[:, 1], 0] - flat[quads[:, 0], 0]
    tall = flat[quads[:, 3], 1] - flat[quads[:, 0], 1]
    pairs = [quads[:, [0, 1]], quads[:, [3, 2]], quads[:, [0, 3]], quads[:, [1, 2]]]
    weights = np.concatenate([0.5 * tall / width] * 2 + [0.5 * width / tall] * 2)
    i, j = np.concatenate(pairs).T
    links = sparse.coo_matrix((weights, (i, j)), shape=(count, count))
    links = links + links.T
    system = sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links
    right = np.zeros(count)
    for corner in quads.T:
        np.add.at(right, corner, 0.5 * width * tall)
    free = np.flatnonzero(~seam)
    solution = np.zeros(count)
    solution[free] = splu(sparse.csc_matrix(sparse.csr_matrix(system)[free][:, free])).solve(right[free])
    return np.sqrt(solution.clip(0.0))
