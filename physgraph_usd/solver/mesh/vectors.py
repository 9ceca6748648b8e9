"""Vectors and small matrices of many elements, as arrays of components: the elements are the last axis."""

from __future__ import annotations

from functools import reduce

import numpy as np


def at_corners(x: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Positions, shape (V, 3), at each corner of elements, shape (N, K), as arrays of components: shape (K, 3, N)."""
    return x.T.take(elements.T, axis=1).swapaxes(0, 1)


def mean_of(values: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Mean of the vertices' values, shape (..., V), over the corners of elements, shape (N, K): shape (..., N)."""
    return reduce(np.add, (values.take(corner, axis=-1) for corner in elements.T)) / elements.shape[1]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of vectors, shapes (3, N)."""
    return np.stack([a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)])


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products of vectors, shapes (..., 3, N)."""
    products = a * b
    return products[..., 0, :] + products[..., 2, :] + products[..., 1, :]  # In this order, as `np.einsum` adds.


def norm(a: np.ndarray) -> np.ndarray:
    """Lengths of vectors, shapes (..., 3, N)."""
    return np.sqrt((a**2).sum(axis=-2))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of small matrices, shapes (I, J, N) and (J, K, N), rounded as by BLAS, in fused additions."""
    import torch  # noqa: PLC0415  stages are read without torch

    first, second = torch.as_tensor(a), torch.as_tensor(b)
    total = first[:, 0, None] * second[0]
    for j in range(1, len(b)):
        total = torch.addcmul(total, first[:, j, None], second[j])
    return total.numpy()


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverses of symmetric matrices, shape (2, 2, N), by elimination with the larger entry of the first row first."""
    (a, b), (_, d) = matrix
    turned = np.abs(b) > np.abs(a)
    (pivot, under), (beside, last) = (np.where(turned, row[::-1], row) for row in (matrix[0], (b, d)))
    factor = under * (1.0 / pivot)
    column = np.stack([1.0 - turned, turned])
    second = (column[::-1] - factor * column) * (1.0 / (last - factor * beside))
    return np.stack([(column - beside * second) * (1.0 / pivot), second])
