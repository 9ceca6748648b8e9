"""Cusick's drape test: a disc of fabric hangs over a smaller one, and its shadow tells how stiff it is.

    python tests/drape.py [EDGE]

prints the table of docs/fabrics.md: a disc of 30 cm over one of 18 cm, in triangles of 6 mm or of EDGE metres. The
coefficient is the shadow's share of the ring between the two discs. A disc comes to rest in several numbers of folds;
it is started in some, and the one of least energy counts. The bands are those of docs/fabrics.md.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from probes import G, hang
from sheets import equilateral, level_of

from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.forces.gravity import Gravity
from physgraph_usd.solver.forces.membrane import in_plane_terms
from physgraph_usd.solver.level import Level

OUTER, INNER = 0.15, 0.09
"""Radii of the fabric and of the support [m]."""
EDGE = 0.006
BANDS = {"silk": (20, 40), "cotton": (60, 76), "wool": (40, 70), "denim": (70, 90), "leather": (47, 70)}
"""Coefficients that are published for such fabrics [%]."""
FOLDS = (5, 6, 7, 8)
PIXELS = 1200


def disc(edge: float) -> tuple[Level, np.ndarray]:
    """A disc of equilateral triangles whose rim is drawn onto the circle, held over the support; and its rim."""
    points, triangles = equilateral(2.4 * OUTER, 2.4 * OUTER, edge)
    middle = points.mean(axis=0)
    points = points - points[np.linalg.norm(points - middle, axis=1).argmin()]
    kept = np.linalg.norm(points, axis=1) < OUTER + 0.5 * edge
    used, corners = np.unique(triangles[kept[triangles].all(axis=1)], return_inverse=True)
    points, triangles = points[used], corners.reshape(-1, 3)
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    ends, count = np.unique(sides, axis=0, return_counts=True)
    rim = np.unique(ends[count == 1])
    points[rim] *= OUTER / np.linalg.norm(points[rim], axis=1, keepdims=True)
    held = np.linalg.norm(points, axis=1) <= INNER + 1e-6
    return level_of(points, triangles, pin=held.astype(float)), rim


def shadow(points: np.ndarray, triangles: np.ndarray) -> float:
    """Area that triangles hide, seen along z [m^2]."""
    hidden = np.zeros((PIXELS, PIXELS), bool)
    reach = 1.1 * OUTER
    for a, b, c in ((points[:, :2] + reach) / (2 * reach) * PIXELS)[triangles]:
        low, high = np.floor(np.min([a, b, c], axis=0)).astype(int), np.ceil(np.max([a, b, c], axis=0)).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area:
            s = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
            t = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
            hidden[low[1] : high[1], low[0] : high[0]] |= (s >= 0) & (t >= 0) & (s + t <= 1)
    return float(hidden.sum()) * (2 * reach / PIXELS) ** 2


def drape(fabric: Fabric, folds: int, *, edge: float = EDGE) -> tuple[float, float]:
    """Drape coefficient [%] and energy [J] of a disc that is started in a number of folds."""
    level, _ = disc(edge)
    flat = level.rest.numpy()
    out = np.maximum(np.linalg.norm(flat, axis=1) - INNER, 0.0)
    start = flat.copy()
    start[:, 2] = -3.0 * out**2 + 0.15 * out * np.cos(folds * np.arctan2(flat[:, 1], flat[:, 0]))
    settled = hang(level, start, fabric)
    weight = Gravity(level, torch.tensor([fabric.density]), np.array([0.0, 0.0, -G]))
    forces = (*in_plane_terms(level, [fabric]), Bending(level, torch.tensor([fabric.bend])), weight)
    energy = sum(ForceModule(forces).energies(torch.as_tensor(settled)).values())
    ring = np.pi * (OUTER**2 - INNER**2)
    return 100.0 * (shadow(settled, level.triangles.numpy()) - np.pi * INNER**2) / ring, energy


def main() -> None:
    """Print the table."""
    edge = float(sys.argv[1]) if len(sys.argv) > 1 else EDGE
    sys.stdout.write(
        "| fabric | bending length [cm] | coefficient | from other folds | published | |\n|---|---|---|---|---|---|\n"
    )
    for name, (low, high) in BANDS.items():
        fabric = PRESETS[name]
        length = 100.0 * (fabric.bend / (fabric.density * G)) ** (1 / 3)
        found = [drape(fabric, folds, edge=edge) for folds in FOLDS]
        least, all_of_them = min(found, key=lambda each: each[1])[0], [each[0] for each in found]
        verdict = "in the band" if low <= least <= high else "**below**" if least < low else "**above**"
        sys.stdout.write(
            f"| {name} | {length:.2f} | {least:.0f} % | {min(all_of_them):.0f} to {max(all_of_them):.0f} % | "
            f"{low} to {high} % | {verdict} |\n"
        )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
