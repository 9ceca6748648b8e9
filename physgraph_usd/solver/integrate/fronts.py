"""Index tables for factorising a matrix of a known pattern front by front (`multifrontal`).

A node's front is the dense matrix of the node's own vertices and its border: the vertices above, coupled to the node
after all vertices below are eliminated. Nodes of equal depth are grouped in batches of fronts of equal size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .dissection import Dissection

SMALLEST = 0.7
"""Least width of a batch's fronts relative to the widest; all fronts are padded to the widest."""
BATCH = 1 << 24
"""Most entries of a batch of fronts."""
NOWHERE = 1 << 40
"""An index outside every buffer, to exclude padding from all results."""


@dataclass(frozen=True, eq=False)
class Received:
    """Entries received by the nodes of a batch from one child each; `NOWHERE` for none.

    Attributes:
        rows: First index of each row of the child's update, shape (nodes, border).
        columns: Index within a row, shape (nodes, border).
        places: Row and column of each entry in the node's front, shape (nodes, border).
    """

    rows: Int[Tensor, "nodes border"]
    columns: Int[Tensor, "nodes border"]
    places: Int[Tensor, "nodes border"]


@dataclass(frozen=True, eq=False)
class Batch:
    """Nodes of equal depth eliminated together, with fronts padded to equal size.

    A front has a node's own vertices first, the border from ``inner`` on, and one more row and column for padding.

    Attributes:
        inner: Most vertices of a node.
        side: Width of the fronts.
        unit: Indices of padding on the diagonals of the flat fronts.
        source: Matrix entries copied to the fronts, shape (entries,).
        target: Indices of the copied entries in the flat fronts, shape (entries,).
        received: Entries from a first and from a second child.
        rows: First indices of the inner rows in the pass up, shape (nodes, inner).
        columns: Indices within a row, shape (nodes, width).
        down: First indices, in the pass down, of a node's entries in the rows of its border, shape (nodes, border).
        updates: First indices of the rows of the border's matrix in the depth's updates, shape (nodes, border).
        ranks: Indices within a row, shape (nodes, border).
    """

    inner: int
    side: int
    unit: Int[Tensor, " padded"]
    source: Int[Tensor, " entries"]
    target: Int[Tensor, " entries"]
    received: tuple[Received, ...]
    rows: Int[Tensor, "nodes inner"]
    columns: Int[Tensor, "nodes width"]
    down: Int[Tensor, "nodes border"]
    updates: Int[Tensor, "nodes border"]
    ranks: Int[Tensor, "nodes border"]

    def fronts(
        self, values: Float[Tensor, " entries"], updates: Float[Tensor, " places"]
    ) -> Float[Tensor, "nodes width width"]:
        """The fronts, from the matrix's entries and the children's updates, whose last entry is zero."""
        count, side = len(self.rows), self.side
        flat = values.new_zeros(count * side * side)
        flat.index_fill_(0, self.unit, 1.0)
        flat[self.target] = values[self.source]
        first = torch.arange(count, device=values.device).mul_(side * side)[:, None, None]
        for child in self.received:
            # Each child adds in a separate call, so no call adds twice to the same place.
            where = first + child.places[:, :, None] * side + child.places[:, None, :]
            flat[where] += updates[joined(child.rows, child.columns, updates)]
        return flat.reshape(count, side, side)[:, :-1, :-1]


def joined(
    rows: Int[Tensor, "nodes rows"], columns: Int[Tensor, "nodes columns"], buffer: Tensor
) -> Int[Tensor, "nodes rows columns"]:
    """Indices of rows' columns in a flat buffer; the last index if row or column is nowhere."""
    return (rows[:, :, None] + columns[:, None, :]).clamp_(max=len(buffer) - 1)


class Tree:
    """The nodes of a dissection with their borders for a given pattern; vertices in elimination order.

    The pass up has a row for each vertex: the vertices of the vertex's node, then the node's border. The pass down also
    has a row for each vertex: the vertices of each node with the vertex in its border.

    Attributes:
        stages: First node of each depth, deepest first, and the number of nodes.
        updates: Number of entries of the borders' matrices of each depth.
        up_starts: First entry of each row of the pass up, and the entry count, shape (V + 1,).
        up_lists: Start of each row's columns in ``up_columns``, for the pass up, shape (V,).
        up_columns: Columns of each node's rows; a vertex of the border counts from V, shape (columns,).
        down_starts: First entry of each row of the pass down, and the entry count, shape (V + 1,).
        down_columns: Columns of the rows, shape (entries,).
    """

    def __init__(self, pattern: sp.csr_matrix, dissection: Dissection) -> None:
        """Simulate the elimination.

        Args:
            pattern: Symmetric pattern, shape (V, V).
            dissection: An elimination order for the pattern.
        """
        count = self._count = pattern.shape[0]
        self.stages, self._first, self._last = dissection.stages, dissection.starts[:-1], dissection.starts[1:]
        self._size = self._last - self._first
        node = np.repeat(np.arange(len(self._size)), self._size)
        place = np.empty(count, np.int64)
        place[dissection.order] = np.arange(count)
        row, column = place[np.repeat(np.arange(count), np.diff(pattern.indptr))], place[pattern.indices]
        valid = np.flatnonzero(column >= self._first[node[row]])
        self._entry = valid[np.argsort(node[row[valid]], kind="stable")]
        self._row, self._column = row[self._entry], column[self._entry]
        self._entries = np.searchsorted(node[self._row], np.arange(len(self._size) + 1))
        self._keys = self._borders(node[self._row], dissection.parent)
        self._owner, self._vertex = np.divmod(self._keys, max(count, 1))
        self._starts = np.searchsorted(self._owner, np.arange(len(self._size) + 1))
        self._border = np.diff(self._starts)
        self._children = _children(dissection.parent)
        depth = np.repeat(np.arange(len(self.stages) - 1), np.diff(self.stages))
        squares = np.concatenate([[0], np.cumsum(self._border**2)])
        self.updates = np.diff(squares[self.stages])
        self._update = squares[:-1] - squares[self.stages[depth]]
        self._lay_out_passes(node)

    def _borders(self, owner: np.ndarray, parent: np.ndarray) -> np.ndarray:
        """Node times vertex count plus vertex, for all vertices of all borders, ascending."""
        beyond = self._column >= self._last[owner]
        inner, ends = owner[beyond] * self._count + self._column[beyond], np.searchsorted(owner[beyond], self.stages)
        found, below = [], np.zeros(0, np.int64)
        for begin, end in pairwise(ends):
            child, vertex = np.divmod(below, max(self._count, 1))
            above = vertex >= self._last[parent[child]]
            passed = parent[child[above]] * self._count + vertex[above]
            below = np.unique(np.concatenate([inner[begin:end], passed]))
            found.append(below)
        return np.concatenate(found)

    def _lay_out_passes(self, node: np.ndarray) -> None:
        """The rows and columns of both passes; ``node`` is the node of each vertex."""
        width = self._size + self._border
        lists = np.cumsum(width) - width
        self.up_starts = np.concatenate([[0], np.cumsum(width[node])])
        self.up_lists = lists[node]
        self.up_columns = np.empty(int(width.sum()), np.int64)
        self.up_columns[ranges(lists, self._size)] = np.arange(self._count)
        self.up_columns[ranges(lists + self._size, self._border)] = self._count + self._vertex
        by_row = np.lexsort((self._owner, self._vertex))
        sizes = self._size[self._owner[by_row]]
        self._down = np.empty(len(by_row), np.int64)
        self._down[by_row] = np.cumsum(sizes) - sizes
        rows = np.bincount(self._vertex, weights=self._size[self._owner], minlength=self._count)
        self.down_starts = np.concatenate([[0], np.cumsum(rows.astype(np.int64))])
        self.down_columns = ranges(self._first[self._owner[by_row]], sizes)

    def batches(self, begin: int, end: int) -> Iterator[np.ndarray]:
        """The nodes of a depth, from ``begin`` to ``end``, in batches of similar width."""
        width = (self._size + self._border)[begin:end]
        nodes, width = begin + np.argsort(-width, kind="stable"), -np.sort(-width)
        while len(nodes):
            count = int((width >= SMALLEST * width[0]).sum())
            count = max(1, min(count, BATCH // (int(width[0]) + 1) ** 2))
            yield nodes[:count]
            nodes, width = nodes[count:], width[count:]

    def batch(self, nodes: np.ndarray, *, device: str) -> Batch:
        """A batch of nodes of equal depth, on a device."""
        inner, most = max(int(self._size[nodes].max()), 1), int(self._border[nodes].max())
        side, parent_rows, child_rows = inner + most + 1, np.arange(inner), np.arange(most)
        size, border = self._size[nodes, None], self._border[nodes, None]
        inside, beyond = parent_rows < size, child_rows < border
        unit = np.flatnonzero(~inside.ravel())
        up = np.concatenate([self.up_starts, [NOWHERE]])
        down = np.concatenate([self._down, [NOWHERE]])
        columns = [np.where(inside, parent_rows, NOWHERE), np.where(beyond, size + child_rows, NOWHERE)]
        received = [self._received(nodes, inner, side, slot=slot) for slot in (0, 1)]

        def put(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=device)

        source, target = self._begun(nodes, inner, side)
        return Batch(
            inner=inner,
            side=side,
            unit=put(unit // inner * side**2 + unit % inner * (side + 1)),
            source=put(source),
            target=put(target),
            received=tuple(Received(*map(put, each)) for each in received if each is not None),
            rows=put(up[np.where(inside, self._first[nodes, None] + parent_rows, -1)]),
            columns=put(np.concatenate(columns, axis=1)),
            down=put(down[np.where(beyond, self._starts[nodes, None] + child_rows, -1)]),
            updates=put(np.where(beyond, self._update[nodes, None] + child_rows * border, NOWHERE)),
            ranks=put(np.where(beyond, child_rows, NOWHERE)),
        )

    def _begun(self, nodes: np.ndarray, inner: int, side: int) -> tuple[np.ndarray, np.ndarray]:
        """`Batch.source` and `Batch.target`."""
        counts = self._entries[nodes + 1] - self._entries[nodes]
        chosen, number = ranges(self._entries[nodes], counts), np.repeat(np.arange(len(nodes)), counts)
        row = self._row[chosen] - self._first[nodes[number]]
        column = self._place(nodes[number], self._column[chosen], inner)
        beyond = column >= inner
        target = np.concatenate([row * side + column, (column * side + row)[beyond]])
        number = np.concatenate([number, number[beyond]])
        return np.concatenate([self._entry[chosen], self._entry[chosen[beyond]]]), number * side**2 + target

    def _received(self, nodes: np.ndarray, inner: int, side: int, *, slot: int) -> tuple[np.ndarray, ...] | None:
        """The arrays of `Received`, or None if no node has a child in the slot."""
        child = self._children[nodes, slot, None]
        border = np.where(child >= 0, self._border[child], 0)
        if not border.any():
            return None
        child_rows = np.arange(border.max())
        valid = child_rows < border
        vertex = self._vertex[np.where(valid, self._starts[child] + child_rows, 0)]
        places = np.where(valid, self._place(np.broadcast_to(nodes[:, None], valid.shape), vertex, inner), side - 1)
        rows = np.where(valid, self._update[child] + child_rows * border, NOWHERE)
        return rows, np.where(valid, child_rows, NOWHERE), places

    def _place(self, node: np.ndarray, vertex: np.ndarray, inner: int) -> np.ndarray:
        """Row of a vertex in the front of a node."""
        rank = np.searchsorted(self._keys, node * self._count + vertex) - self._starts[node]
        return np.where(vertex < self._last[node], vertex - self._first[node], inner + rank)


def ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Concatenation of the ranges starts[i], starts[i] + 1, ..., each with counts[i] numbers."""
    before = np.cumsum(counts) - counts
    return np.repeat(starts - before, counts) + np.arange(int(counts.sum()))


def _children(parent: np.ndarray) -> np.ndarray:
    """The two children of each node, -1 for none, shape (nodes, 2)."""
    children = np.full((len(parent), 2), -1)
    child = np.flatnonzero(parent >= 0)
    above = parent[child]
    second = np.concatenate([[False], above[1:] == above[:-1]])[: len(above)]
    children[above, second.astype(int)] = child
    return children
