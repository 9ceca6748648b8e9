"""The paper's updates of edges and vertices as a kernel each on CUDA.

Importing this needs Triton, which comes with torch's CUDA builds; `paper_network.PaperNetwork` does the same in torch.
At a million edges the layers there write and read some 25 arrays of a gigabyte a round; a kernel reads what it updates
once and writes it once. Products are of float16 factors, whose 10 bits are those of TF32, summed in float32; what
passes from round to round stays float32.
"""

# Triton is not installed where there is no GPU, and its language is typed by values that only Triton reads.
# pyright: reportMissingImports=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any, cast

import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor, nn

ROWS, WARPS = 64, 4
"""Edges or vertices of a block of threads, and its warps."""


def updated_edges(
    perceptron: nn.Sequential,
    from_receiver: Float[Tensor, "vertices latent"],
    from_sender: Float[Tensor, "vertices latent"],
    edge: Float[Tensor, "directed latent"],
    *,
    ends: tuple[Int[Tensor, " directed"], Int[Tensor, " directed"]],
) -> Float[Tensor, "directed latent"]:
    """The edges after a perceptron of (receiver, sender, edge) has been added to them, in place.

    Args:
        perceptron: Three layers and a LayerNorm; of the first layer only the part for the edge is read, the last third.
        from_receiver: What the first layer makes of each vertex as a receiver.
        from_sender: The same as a sender.
        edge: The edges in both directions, float32 on CUDA; overwritten.
        ends: Receiver and sender of each edge.
    """
    count, latent = edge.shape
    layers = _laid_out(perceptron, latent)
    inputs = [from_receiver.contiguous(), from_sender.contiguous(), *ends]
    _update_edges[_blocks(count)](edge, *inputs, *layers, count, latent, ROWS, num_warps=WARPS)
    return edge


def updated_vertices(
    perceptron: nn.Sequential, from_vertex: Float[Tensor, "vertices latent"], gathered: Float[Tensor, "vertices latent"]
) -> Float[Tensor, "vertices latent"]:
    """The perceptron of (vertex, gathered edges), to be added to the vertices.

    Args:
        perceptron: Three layers and a LayerNorm; of the first layer only the part for the edges is read, the last half.
        from_vertex: What the first layer makes of each vertex.
        gathered: Sums of the edges that end at each vertex; overwritten by the result.
    """
    count, latent = gathered.shape
    layers = _laid_out(perceptron, latent)
    _update_vertices[_blocks(count)](gathered, from_vertex.contiguous(), *layers, count, latent, ROWS, num_warps=WARPS)
    return gathered


def _blocks(count: int) -> tuple[int]:
    return ((count + ROWS - 1) // ROWS,)


def _laid_out(perceptron: nn.Sequential, latent: int) -> list[Any]:
    """Weights in the kernels' layout, and LayerNorm's addition to a variance."""
    first, second, third, norm = (cast(Any, perceptron[k]) for k in (0, 2, 4, 5))
    weights = [layer.weight[:, -latent:].T.half().contiguous() for layer in (first, second, third)]
    return [*weights, first.bias, second.bias, third.bias, norm.weight, norm.bias, norm.eps]


@triton.jit
def _update_edges(
    edge, receive, send, receiver, sender, w1, w2, w3, b1, b2, b3, gain, shift, eps, count,
    L: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    columns = tl.arange(0, L)
    inside = (rows < count)[:, None]
    offsets = rows.to(tl.int64)[:, None] * L + columns[None, :]
    to = tl.load(receiver + rows, mask=rows < count, other=0)[:, None] * L + columns[None, :]
    by = tl.load(sender + rows, mask=rows < count, other=0)[:, None] * L + columns[None, :]
    before = tl.load(edge + offsets, mask=inside, other=0.0)
    h = tl.load(receive + to) + tl.load(send + by)
    h = _layers(before, h, w1, w2, w3, b1, b2, b3, gain, shift, eps, L)
    tl.store(edge + offsets, before + h, mask=inside)


@triton.jit
def _update_vertices(
    gathered, from_vertex, w1, w2, w3, b1, b2, b3, gain, shift, eps, count, L: tl.constexpr, ROWS: tl.constexpr
):
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    inside = (rows < count)[:, None]
    offsets = rows.to(tl.int64)[:, None] * L + tl.arange(0, L)[None, :]
    inputs = tl.load(gathered + offsets, mask=inside, other=0.0)
    h = tl.load(from_vertex + offsets, mask=inside, other=0.0)
    h = _layers(inputs, h, w1, w2, w3, b1, b2, b3, gain, shift, eps, L)
    tl.store(gathered + offsets, h, mask=inside)


@triton.jit
def _layers(inputs, h, w1, w2, w3, b1, b2, b3, gain, shift, eps, L: tl.constexpr):
    """Three layers and a LayerNorm; ``h`` is the first layer's output for all remaining inputs."""
    columns = tl.arange(0, L)
    square = columns[:, None] * L + columns[None, :]
    h += tl.dot(inputs.to(tl.float16), tl.load(w1 + square)) + tl.load(b1 + columns)[None, :]
    h = tl.dot(tl.maximum(h, 0.0).to(tl.float16), tl.load(w2 + square)) + tl.load(b2 + columns)[None, :]
    h = tl.dot(tl.maximum(h, 0.0).to(tl.float16), tl.load(w3 + square)) + tl.load(b3 + columns)[None, :]
    h -= tl.sum(h, axis=1)[:, None] / L
    h *= tl.rsqrt(tl.sum(h * h, axis=1) / L + eps)[:, None]
    return h * tl.load(gain + columns)[None, :] + tl.load(shift + columns)[None, :]
