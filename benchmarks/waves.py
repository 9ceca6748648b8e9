"""Filters by wavelength of fields on a mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import factorized

from physgraph_usd.solver.level import Level


def lowpass(level: Level, waves: Sequence[float]) -> list[Callable[[np.ndarray], np.ndarray]]:
    """Maps from a vector field on a mesh to the same without what is shorter than each of some wavelengths [m]."""
    mass, stiffness = vertex_area(level), laplacian(level)

    def one(wave: float) -> Callable[[np.ndarray], np.ndarray]:
        solve = factorized(sp.csc_matrix(sp.diags(mass) + (wave / (2.0 * np.pi)) ** 2 * stiffness))
        return lambda field: np.stack([solve(mass * column) for column in field.T], axis=1)

    return [one(wave) for wave in waves]


def vertex_area(level: Level) -> np.ndarray:
    """Area of each vertex [m^2]."""
    return np.maximum(level.vertex_area.double().cpu().numpy(), 1e-12)


def laplacian(level: Level) -> sp.csr_matrix:
    """The matrix of springs 2 a_e / l^2: the Laplacian of an equilateral mesh, times the areas."""
    ends, length = level.springs.cpu().numpy(), level.spring_length.double().cpu().numpy()
    weight = 2.0 * level.spring_area.double().cpu().numpy() / length**2
    i, j = ends.T
    count = level.vertex_count
    off = sp.coo_matrix(
        (np.concatenate([weight] * 2), (np.concatenate([i, j]), np.concatenate([j, i]))), (count, count)
    )
    graph = sp.csr_matrix(off)
    return sp.csr_matrix(sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph)
