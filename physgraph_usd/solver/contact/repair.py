"""Repair of the cage followed by the fine cloth, where overlapping body parts leave the cloth no room.

In overlaps of a skinned body the cage goes deep through both parts, and cloth pushed out of the parts tears. Only there
the solve follows a repaired cage: cloth between overlapping parts is drawn taut from entry to exit. The report's
figures are still measured from the input. Without it the T-shirt ends with 2.4 times the remaining move and standing
cloth moves by 0.77 for 0.47 mm; shots 02 and 09 end equal (whole shots, three ripples each).
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
    held = bodies.pinched(x, inside) & cage.free[:, 0]
    if not bool(held.any()):
        return x
    some, seeds = ((each & cage.free[:, 0]).cpu().numpy() for each in (inside.any(dim=0), held))
    hidden = torch.as_tensor(patches_with(np.stack(mesh.beside.nonzero(), axis=1), some, seeds), device=held.device)
    around = mesh.grown(hidden, 1) & cage.free[:, 0]
    return bodies.pushed_out(_smoothed(_membrane(x, hidden, mesh.beside), around, mesh.beside), inside)


def _membrane(x: Tensor, where: Bool[Tensor, " vertices"], beside: sp.csr_matrix) -> Tensor:
    """Positions with each vertex of a region at the mean of its neighbours; all other vertices are held."""
    inner, rest = (np.flatnonzero(each.cpu().numpy()) for each in (where, ~where))
    rows = sp.csr_matrix(sp.diags(np.asarray(beside.sum(axis=1)).ravel()) - beside)[inner]
    touched = np.unique(csgraph.connected_components(beside, directed=False)[1][rest])
    if not len(touched):
        return x
    points = x.double().cpu().numpy().copy()
    points[inner] = splinalg.spsolve(sp.csc_matrix(rows[:, inner]), -rows[:, rest] @ points[rest])
    out = torch.as_tensor(points).to(x)
    return torch.where(out.isfinite(), out, x)


def _smoothed(x: Tensor, where: Bool[Tensor, " vertices"], beside: sp.csr_matrix) -> Tensor:
    """Positions moved half way to the mean of the neighbours."""
    which = np.flatnonzero(where.cpu().numpy())
    rows = beside[which]
    share = 1.0 / np.maximum(np.asarray(rows.sum(axis=1)), 1.0)
    points = x.double().cpu().numpy().copy()
    points[which] = 0.5 * (points[which] + share * (rows @ points))
    return torch.as_tensor(points).to(x)
