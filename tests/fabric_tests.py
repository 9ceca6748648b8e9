"""A fabric laboratory: strips pulled, frames sheared, strips that hang over, and Cusick's drape test, for each preset.

    python tests/fabric_tests.py [--edge METRES]

prints the tables of docs/fabrics.md. Pulled strips give Young's modulus along warp and weft, a sheared frame the shear
stiffness, strips of two bending lengths clamped at one end the bending stiffness, by the heavy elastica. In the drape
test a disc of 30 cm hangs over one of 18 cm (ISO 9073-9), in triangles of 6 mm or of EDGE metres; the coefficient is
the shadow's share of the ring between them. A disc comes to rest in several numbers of folds, whose energies differ by
a few percent: it is started in some, and as in a laboratory the mean counts.
"""

import argparse
import sys
from dataclasses import replace

import numpy as np
from probes import G, cantilever, clamped, hang, plane_stiffness, rigidity_from, tensile_test
from sheets import equilateral, level_of

from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.forces.membrane import in_plane_terms, shear_stiffness
from physgraph_usd.solver.level import Level

OUTER, INNER = 0.15, 0.09
"""Radii of the fabric and of the support [m]."""
EDGE = 0.006
BANDS = {
    "silk": (20, 40),
    "polyester": (20, 40),
    "cotton": (60, 76),
    "wool": (40, 70),
    "leather": (47, 70),
    "denim": (70, 90),
}
"""Coefficients that are published for such fabrics [%]."""
FOLDS = (5, 6, 7, 8)
PIXELS = 1200


def disc(edge: float) -> tuple[Level, np.ndarray]:
    """A disc of equilateral triangles, held over the support, whose rim is drawn onto the circle; and its rim.

    What lies next to the support's edge is drawn onto that, so that the ring is as wide on every mesh.
    """
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
    radius = np.linalg.norm(points, axis=1)
    beside = np.abs(radius - INNER) < 0.45 * edge
    points[beside] *= INNER / radius[beside, None]
    held = np.linalg.norm(points, axis=1) <= INNER + 1e-6
    return level_of(points, triangles, pin=held.astype(float), warp=np.array([1.0, 0.0, 0.0])), rim


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


def drape(fabric: Fabric, folds: int, *, edge: float = EDGE) -> float:
    """Drape coefficient [%] of a disc that is started in a number of folds."""
    level = clamped(disc(edge)[0])
    flat = level.rest.numpy()
    out = np.maximum(np.linalg.norm(flat, axis=1) - INNER, 0.0)
    start = flat.copy()
    start[:, 2] = -3.0 * out**2 + 0.15 * out * np.cos(folds * np.arctan2(flat[:, 1], flat[:, 0]))
    settled = hang(level, start, fabric)
    ring = np.pi * (OUTER**2 - INNER**2)
    return 100.0 * (shadow(settled, level.triangles.numpy()) - np.pi * INNER**2) / ring


def drapes(fabric: Fabric, *, edge: float = EDGE) -> list[float]:
    """Drape coefficients [%] from several numbers of folds."""
    return [drape(fabric, folds, edge=edge) for folds in FOLDS]


def turned(fabric: Fabric) -> Fabric:
    """The fabric with warp and weft exchanged."""
    weft = [fabric.stretch if fabric.weft_stretch is None else fabric.weft_stretch]
    weft.append(fabric.bend if fabric.weft_bend is None else fabric.weft_bend)
    return replace(fabric, stretch=weft[0], weft_stretch=fabric.stretch, bend=weft[1], weft_bend=fabric.bend)


def measured(fabric: Fabric) -> dict[str, tuple[float, float]]:
    """Each stiffness that a sheet shows, and the one that it was given."""
    along = np.array([1.0, 0.0, 0.0])
    points, triangles = equilateral(0.16, 0.16, 0.01)
    level = level_of(points, triangles, warp=along)
    free = replace(fabric, stretch_limit=None, warp_ease=0.0, weft_ease=0.0)
    found: dict[str, tuple[float, float]] = {}
    for name, way in (("warp", free), ("weft", turned(free))):
        found[f"stretch, {name}"] = tensile_test(level, in_plane_terms(level, [way]))[0], way.stretch
        length = 2.0 * (way.bend / (way.density * G)) ** (1 / 3)
        angle = cantilever("equilateral", length, way, warp=along)
        found[f"bend, {name}"] = rigidity_from(angle, length, way.density), way.bend * (1.0 - 1.0 / 9.0)
    shear = 1.0 / np.linalg.inv(plane_stiffness(level, in_plane_terms(level, [free])))[2, 2]
    return found | {"shear": (float(shear), shear_stiffness(free))}


def drape_row(name: str, *, edge: float) -> str:
    fabric, (low, high) = PRESETS[name], BANDS[name]
    length = 100.0 * (fabric.bend / (fabric.density * G)) ** (1 / 3)
    every = drapes(fabric, edge=edge)
    mean = float(np.mean(every))
    verdict = "in the band" if low <= mean <= high else "**below**" if mean < low else "**above**"
    spread = f"{min(every):.0f} to {max(every):.0f} %"
    return f"| {name} | {length:.2f} | {mean:.1f} % | {spread} | {low} to {high} % | {verdict} |\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=float, default=EDGE, help="Edge of the disc's triangles [m].")
    edge = parser.parse_args().edge
    prepare_device("cpu")
    names = ("stretch, warp", "stretch, weft", "shear", "bend, warp", "bend, weft")
    sys.stdout.write(f"| fabric: shown over given | {' | '.join(names)} |\n|---|---|---|---|---|---|\n")
    for name in PRESETS:
        shown = measured(PRESETS[name])
        sys.stdout.write(f"| {name} | {' | '.join(f'{shown[each][0] / shown[each][1]:.3f}' for each in names)} |\n")
    sys.stdout.write("\n| fabric | bending length [cm] | coefficient | from other folds | published | |\n")
    sys.stdout.write("|---|---|---|---|---|---|\n")
    for name in BANDS:
        sys.stdout.write(drape_row(name, edge=edge))
        sys.stdout.flush()


if __name__ == "__main__":
    main()
