"""The potential once more, written independently in plain torch, for autograd to differentiate; and finite differences.

The formulas of the forces on the authored triangles alone: nothing here reads a `Level`'s derived fields.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from physgraph_usd.solver.forces.base import Force

HINGE_CAP = 10.0
Energy = Callable[[Tensor], Tensor]


def area(rest: Tensor, triangles: np.ndarray) -> Tensor:
    """Area of each triangle."""
    a, b, c = (rest[triangles[:, n]] for n in range(3))
    return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)


def sides(triangles: np.ndarray) -> dict[tuple[int, int], list[int]]:
    """Triangles at each undirected side."""
    found: dict[tuple[int, int], list[int]] = defaultdict(list)
    for number, (a, b, c) in enumerate(triangles.tolist()):
        for p, q in ((a, b), (b, c), (c, a)):
            found[min(p, q), max(p, q)].append(number)
    return found


def stretch_energy(rest: Tensor, triangles: np.ndarray, youngs: float) -> Energy:
    """Springs along the sides."""
    areas = area(rest, triangles)
    found = sides(triangles)
    ends = torch.tensor(list(found))
    share = torch.stack([areas[numbers].sum() / 3 for numbers in found.values()])
    l0 = (rest[ends[:, 1]] - rest[ends[:, 0]]).norm(dim=1)
    k = 3 * youngs * share / l0**2
    return lambda x: (0.5 * k * ((x[ends[:, 1]] - x[ends[:, 0]]).norm(dim=1) - l0) ** 2).sum()


def fold(x: Tensor, hinges: Tensor) -> Tensor:
    """Angle about the edge from the first triangle's plane to the second's, 0 when flat, by projection."""
    i, j, k, m = (x[hinges[:, n]] for n in range(4))
    e = (j - i) / (j - i).norm(dim=1, keepdim=True)

    def across(p: Tensor) -> Tensor:
        return (p - i) - ((p - i) * e).sum(dim=1, keepdim=True) * e

    u, v = across(k), -across(m)
    return torch.atan2((torch.linalg.cross(u, v) * e).sum(dim=1), (u * v).sum(dim=1))


def hinge_list(triangles: np.ndarray) -> tuple[Tensor, Tensor]:
    """Corners (i, j, k, l) and the two triangles of each side with exactly two triangles."""
    corners, pairs = [], []
    for (i, j), numbers in sides(triangles).items():
        if len(numbers) == 2:
            k, m = (next(v for v in triangles[n].tolist() if v not in (i, j)) for n in numbers)
            if k != m:
                corners.append([i, j, k, m])
                pairs.append(numbers)
    return torch.tensor(corners, dtype=torch.long).reshape(-1, 4), torch.tensor(pairs, dtype=torch.long).reshape(-1, 2)


def bending_energy(rest: Tensor, triangles: np.ndarray, rigidity: float, *, bent: bool = False) -> Energy:
    """Hinges at the sides."""
    areas = area(rest, triangles)
    hinges, pairs = hinge_list(triangles)
    both = areas[pairs].sum(dim=1)
    l0 = (rest[hinges[:, 1]] - rest[hinges[:, 0]]).norm(dim=1)
    w = rigidity * (l0**2 / both).clamp_max(HINGE_CAP)
    theta0 = fold(rest, hinges) if bent else torch.zeros(len(hinges), dtype=rest.dtype)

    def energy(x: Tensor) -> Tensor:
        bend = fold(x, hinges) - theta0
        bend = bend - 2 * torch.pi * torch.round(bend.detach() / (2 * torch.pi))
        return (0.5 * w * bend**2).sum()

    return energy


def membrane_energy(rest: Tensor, triangles: np.ndarray, youngs: float, shear: float) -> Energy:
    """Triangles that stretch along two axes and shear by the angle between them; axes by projection."""
    areas = area(rest, triangles)
    a, b, c = (rest[triangles[:, n]] for n in range(3))
    normal = torch.linalg.cross(b - a, c - a)
    normal = normal / normal.norm(dim=1, keepdim=True)
    pick = normal.abs().argmin(dim=1)
    axis = torch.eye(3, dtype=rest.dtype)[pick]
    axis = axis - (axis * normal).sum(dim=1, keepdim=True) * normal
    axis = axis / axis.norm(dim=1, keepdim=True)
    other = torch.linalg.cross(normal, axis)
    frame = torch.stack([axis, other, normal], dim=2)
    inverse = torch.linalg.inv(torch.stack([b - a, c - a, normal], dim=2))
    c11 = youngs / (1 - 1 / 9)
    longest = torch.stack([(a - b).norm(dim=1), (b - c).norm(dim=1), (c - a).norm(dim=1)]).amax(dim=0)
    sound = (4 * areas / longest**2).clamp_max(1.0)
    weight = areas * sound

    def energy(x: Tensor) -> Tensor:
        p, q, r = (x[triangles[:, n]] for n in range(3))
        gradient = torch.stack([q - p, r - p, torch.zeros_like(p)], dim=2) @ inverse @ frame
        f1, f2 = gradient[:, :, 0], gradient[:, :, 1]
        e1, e2 = f1.norm(dim=1) - 1, f2.norm(dim=1) - 1
        n1, n2 = ((f**2).sum(dim=1) + 0.04 for f in (f1, f2))
        sine = (1 + 0.04) * (f1 * f2).sum(dim=1) / (n1 * n2).sqrt()
        return (weight * (c11 / 2 * (e1**2 + e2**2 + 2 / 3 * e1 * e2) + shear / 2 * sine**2)).sum()

    return energy


def autograd_force(energy: Energy, x: Tensor) -> tuple[float, Tensor]:
    """Energy and minus its gradient."""
    x = x.clone().requires_grad_()
    value = energy(x)
    (gradient,) = torch.autograd.grad(value, x)
    return float(value.detach()), -gradient


def evaluate(force: Force, x: Tensor) -> tuple[float, Tensor]:
    """Energy and force of a term."""
    out = torch.zeros_like(x)
    energy = force.add_force(x, out)
    return float(energy), out


def difference_force(force: Force, x: Tensor, step: float, *, vertices: Sequence[int] | None = None) -> Tensor:
    """Minus the energy's gradient by central differences of sixth order, zero at vertices not asked for."""
    out = torch.zeros_like(x)
    for v in range(len(x)) if vertices is None else vertices:
        for axis in range(3):
            for weight, shift in ((45, 1), (-9, 2), (1, 3)):
                for sign in (1, -1):
                    moved = x.clone()
                    moved[v, axis] += sign * shift * step
                    out[v, axis] -= sign * weight / (60 * step) * evaluate(force, moved)[0]
    return out


def apart(found: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest expected entry."""
    return float((found - expected).abs().max() / expected.abs().max().clamp_min(1e-300))
