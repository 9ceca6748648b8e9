"""What a fabric's folds look like at each level: their wavelength, their energy and what they cost.

    python -m benchmarks.levels SHOT --time 30 --preset denim --level 2 --level 3 [--garment PATH] [--steps N]

Prints for one cold frame a row a level: vertices, edges to the buckling wavelength, the RMS slope of the detail (fine
cloth less the smooth cage) by wavelength with its mean, the energy and the solver's processor time. Bands are
differences of 1 / (1 + (w k / 2 pi)^2)^2 over the rest shape's Laplacian.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.level import Level
from physgraph_usd.solver.resolution import choose_levels, sample_frames
from physgraph_usd.usd.read.reader import open_shot

WAVES = np.array([4.0, 6.0, 9.0, 13.0, 19.0, 27.0, 38.0, 54.0, 76.0])
"""Ends of the bands [mm]."""
STEEPEST = 3.0
"""Cotangents are cut off here: slivers of the rest shape would take every slope for theirs."""


def main() -> None:
    """Solve and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", type=Path)
    parser.add_argument("--garment", action="append", default=[])
    parser.add_argument("--collider", action="append", default=[])
    parser.add_argument("--time", type=float, required=True)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="jersey")
    parser.add_argument("--level", type=int, action="append", required=True)
    parser.add_argument("--steps", type=int, default=RefineOptions.steps)
    given = parser.parse_args()
    prepare_device("cpu")
    fabric = PRESETS[given.preset]
    values = {"stretchStiffness": fabric.stretch, "bendStiffness": fabric.bend, "density": fabric.density}
    sys.stdout.write(f"{given.preset} at {given.time:g}; bands of {', '.join(f'{wave:g}' for wave in WAVES)} mm\n")
    for level in given.level:
        overrides = [f"physgraph:material:{name}={value}" for name, value in values.items()]
        reading = {"garments": given.garment, "colliders": given.collider, "level": level, "overrides": overrides}
        with closing(open_shot(given.shot, **reading)) as shot:
            choice = choose_levels(shot.scene, sample_frames(shot.every_time, shot.frame))[0]
            refiner = Refiner(shot.scene, RefineOptions(steps=given.steps).solve_settings())
            frame = shot.frame(given.time)
            start = time.process_time()
            points = refiner.solve(frame).points
            seconds = time.process_time() - start
            own = refiner.group_of((0,)).levels[-1]
            assert points[0] is not None
            slope = slopes(own, points[0] - own.smooth_from_coarse @ frame.garments[0].points)
            energy = refiner.energy(frame, [each for each in points if each is not None])
        mean = np.exp((slope**2 @ np.log(np.sqrt(WAVES[1:] * WAVES[:-1]))) / (slope**2).sum())
        sys.stdout.write(
            f"level {level}: {own.vertex_count} vertices, {choice.wavelength / choice.edge:.2f} edges a wave, "
            f"slopes {' '.join(f'{1e3 * each:.0f}' for each in slope)} e-3, mean {mean:.1f} mm, "
            f"{1e3 * energy:.2f} mJ, {seconds:.1f} s\n"
        )
        sys.stdout.flush()


def slopes(level: Level, detail: np.ndarray) -> np.ndarray:
    """RMS slope of displacements [m], shape (V, 3), in each band of `WAVES`."""
    rest, triangles = level.rest.double().numpy(), level.triangles.numpy().astype(np.int64)
    stiffness, mass = laplacian(rest, triangles)
    smoothed = []
    for wave in 1e-3 * WAVES:
        solve = splu(sp.csc_matrix(sp.diags(mass) + (wave / (2.0 * np.pi)) ** 2 * stiffness)).solve
        smoothed.append(solve(mass[:, None] * solve(mass[:, None] * detail)))
    bands = [small - large for small, large in pairwise(smoothed)]
    return np.array([np.sqrt((band * (stiffness @ band)).sum() / mass.sum()) for band in bands])


def laplacian(rest: np.ndarray, triangles: np.ndarray) -> tuple[sp.csr_matrix, np.ndarray]:
    """Cotangent Laplacian and lumped areas [m^2] of a mesh."""
    count = len(rest)
    weights, mass = sp.csr_matrix((count, count)), np.full(count, 1e-12)
    for turn in range(3):
        tip, i, j = np.roll(triangles, turn, axis=1).T
        u, v = rest[i] - rest[tip], rest[j] - rest[tip]
        double = np.maximum(np.linalg.norm(np.cross(u, v), axis=1), 1e-12)
        half = 0.5 * np.clip((u * v).sum(axis=1) / double, 0.0, STEEPEST)
        weights += sp.csr_matrix((np.tile(half, 2), (np.concatenate([i, j]), np.concatenate([j, i]))), (count, count))
        mass += np.bincount(tip, double / 6.0, count)
    return sp.csr_matrix(sp.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights), mass


if __name__ == "__main__":
    main()
