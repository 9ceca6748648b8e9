"""Repair of the cage followed by the fine cloth, where overlapping body parts leave the cloth no room.

In overlaps of a skinned body the cage goes deep through both parts, and cloth pushed out of the parts tears. In these
overlaps the solve follows a repaired cage: cloth between overlapping parts is drawn taut from entry to exit. The
report's figures are still measured from the input. Without the repair the T-shirt ends with 2.4 times the remaining
move, and standing cloth moves by 0.77 instead of 0.47 mm; shots 02 and 09 end equal (whole shots, three ripples each).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as splinalg
import torch
from jaxtyping import Bool, Float
from scipy.sparse import csgraph
from torch import Tensor

from ..level import Level
from ..mesh.topology import patches_with
from .bodies import LevelBodies
from .cloth_mesh import ClothMesh


def repaired_cage(
    cage: Level,
    x: Float[Tensor, "coarse 3"],
    *,
    bodies: LevelBodies,
    inside: Bool[Tensor, "bodies coarse"],
    mesh: ClothMesh,
) -> Float[Tensor, "coarse 3"]:
    """The cage with the cloth between overlapping body parts as a taut membrane, pushed outside where possible.

    Args:
        x: Cage positions [m].
        bodies: The cage's view of the bodies.
        inside: The vertices inside each body.

    Returns:
        Positions [m]; x itself if no vertex is pinched.
    """
    pinched = bodies.pinched(x, inside) & cage.free[:, 0]
    if not bool(pinched.any()):
        return x
    masks = ((mask & cage.free[:, 0]).cpu().numpy() for mask in (inside.any(dim=0), pinched))
    hidden = torch.as_tensor(patches_with(np.stack(mesh.beside.nonzero(), axis=1), *masks), device=pinched.device)
    around = mesh.grown(hidden, 1) & cage.free[:, 0]
    return bodies.pushed_out(_smoothed(_membrane(x, hidden, mesh.beside), around, mesh.beside), inside)


def _membrane(x: Tensor, region: Bool[Tensor, " vertices"], beside: sp.csr_matrix) -> Tensor:
    """Positions in which each vertex of a region is the mean of the neighbours; the remaining vertices are held."""
    inner, rest = (np.flatnonzero(mask.cpu().numpy()) for mask in (region, ~region))
    rows = sp.csr_matrix(sp.diags(np.asarray(beside.sum(axis=1)).ravel()) - beside)[inner]
    touched = np.unique(csgraph.connected_components(beside, directed=False)[1][rest])
    if not len(touched):
        return x
    points = x.double().cpu().numpy().copy()
    points[inner] = splinalg.spsolve(sp.csc_matrix(rows[:, inner]), -rows[:, rest] @ points[rest])
    out = torch.as_tensor(points).to(x)
    return torch.where(out.isfinite(), out, x)


def _smoothed(x: Tensor, region: Bool[Tensor, " vertices"], beside: sp.csr_matrix) -> Tensor:
    """Positions moved half way to the mean of the neighbours."""
    vertices = np.flatnonzero(region.cpu().numpy())
    rows = beside[vertices]
    share = 1.0 / np.maximum(np.asarray(rows.sum(axis=1)), 1.0)
    points = x.double().cpu().numpy().copy()
    points[vertices] = 0.5 * (points[vertices] + share * (rows @ points))
    return torch.as_tensor(points).to(x)
