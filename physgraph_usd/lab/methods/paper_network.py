"""The encode-process-decode network of "PhysGraph: Physics-Based Cloth Enhancement Using Graph Neural Networks"."""

from __future__ import annotations

import functools
import importlib.util
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

LATENTS = (32, 64, 128)
"""Latent sizes supported by the kernels of `messages`."""
PIECE = 4096
"""Edges that are updated at once on a CPU: what lies between the layers of more does not stay in its cache, and from
32 MB on the system hands out fresh pages each time."""


@dataclass(frozen=True, eq=False)
class DirectedEdges:
    """The edges in both directions, sorted by their receiver.

    Attributes:
        sender: Start vertex, shape (2E,).
        receiver: End vertex, shape (2E,).
        degree: How many end at each vertex, shape (V,).
    """

    sender: Int[Tensor, " directed"]
    receiver: Int[Tensor, " directed"]
    degree: Int[Tensor, " vertices"]

    @staticmethod
    def of(edges: Int[Tensor, "edges 2"], vertices: int) -> DirectedEdges:
        """Each edge in both directions."""
        sender, receiver = torch.cat([edges, edges.flip(1)]).long().T
        order = receiver.argsort(stable=True)
        return DirectedEdges(sender[order], receiver[order], torch.bincount(receiver, minlength=vertices))


@dataclass(frozen=True)
class PaperConfig:
    """Size of a `PaperNetwork`.

    Attributes:
        latent: Numbers per vertex and edge inside.
        rounds: Rounds of message passing.
        history: Past displacements and forces among the features (H).
        shared: All rounds have the same weights.
        features: "scaled" without units or "paper", metres and newtons as they are.
    """

    latent: int = 128
    rounds: int = 10
    history: int = 2
    shared: bool = True
    features: str = "scaled"


class PaperNetwork(nn.Module):
    """Encode, process, decode; two hidden layers, LayerNorm on all but the decoder, residuals, sums."""

    def __init__(self, config: PaperConfig) -> None:
        """Make the five perceptrons; the decoder's last layer starts at zero."""
        super().__init__()
        self.config = config
        latent, rounds = config.latent, 1 if config.shared else config.rounds
        self.vertex_scale, self.edge_scale = Normaliser(6 * config.history), Normaliser(8)
        self.encode_vertex = _perceptron(6 * config.history + 1, latent, latent)
        self.encode_edge = _perceptron(8, latent, latent)
        self.update_edge = nn.ModuleList(_perceptron(3 * latent, latent, latent) for _ in range(rounds))
        self.update_vertex = nn.ModuleList(_perceptron(2 * latent, latent, latent) for _ in range(rounds))
        self.decode = _perceptron(latent, latent, 3, norm=False)
        self.step_length = nn.Parameter(torch.tensor(1.0))
        for parameter in self.decode[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(
        self,
        vertex: Float[Tensor, "vertices features"],
        edge: Float[Tensor, "directed 8"],
        fixed: Float[Tensor, "vertices 1"],
        *,
        edges: DirectedEdges,
    ) -> Float[Tensor, "vertices 3"]:
        """Displacement in local edge lengths.

        Args:
            vertex: Past displacements and forces.
            edge: Present and rest spans and their lengths, of each edge in both directions.
            fixed: 1 for a fixed vertex.
            edges: The edges in both directions.
        """
        v = self.encode_vertex(torch.cat([self.vertex_scale(vertex), fixed], dim=1))  # V L
        e = self.encode_edge(self.edge_scale(edge))  # 2E L
        kernels = self._kernels(e)
        for k in range(self.config.rounds):
            layers = 0 if self.config.shared else k
            at_edge, at_vertex = (cast(nn.Sequential, each[layers]) for each in (self.update_edge, self.update_vertex))
            e = _updated_edges(at_edge, v, e, edges=edges, kernels=kernels)  # 2E L
            gathered = torch.segment_reduce(e, "sum", lengths=edges.degree, axis=0, unsafe=True)  # V L
            v = v + _vertex_update(at_vertex, v, gathered, kernels=kernels)  # V L
        return self.step_length * self.decode(v)  # V 3

    def _kernels(self, like: Tensor) -> bool:
        """Whether the rounds run as `messages`' kernels: on CUDA, without gradients, where Triton is there."""
        wanted = like.is_cuda and like.dtype == torch.float32 and not like.requires_grad
        return wanted and self.config.latent in LATENTS and has_triton()


def _updated_edges(perceptron: nn.Sequential, v: Tensor, e: Tensor, *, edges: DirectedEdges, kernels: bool) -> Tensor:
    """e and the perceptron of (receiver, sender, edge), whose first layer runs once a vertex, not once an edge."""
    first, *others = perceptron
    at_receiver, at_sender, at_edge = cast(nn.Linear, first).weight.chunk(3, dim=1)
    from_receiver, from_sender = v @ at_receiver.T, v @ at_sender.T
    if kernels:
        from .messages import updated_edges  # noqa: PLC0415  Triton is not everywhere

        return updated_edges(perceptron, from_receiver, from_sender, e, ends=(edges.receiver, edges.sender))

    def change(e: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        h = nn.functional.linear(e, at_edge, cast(nn.Linear, first).bias)
        h = h + from_receiver[receiver] + from_sender[sender]
        for layer in others:
            h = layer(h)
        return h

    if torch.is_grad_enabled() or e.is_cuda:
        return e + change(e, edges.receiver, edges.sender)
    pieces = (part.split(PIECE) for part in (e, edges.receiver, edges.sender))
    return torch.cat([part + change(part, *ends) for part, *ends in zip(*pieces, strict=True)])


def _vertex_update(perceptron: nn.Sequential, v: Tensor, gathered: Tensor, *, kernels: bool) -> Tensor:
    if not kernels:
        return perceptron(torch.cat([v, gathered], dim=1))
    from .messages import updated_vertices  # noqa: PLC0415

    at_vertex = cast(nn.Linear, perceptron[0]).weight.chunk(2, dim=1)[0]
    return updated_vertices(perceptron, v @ at_vertex.T, gathered)


@functools.cache
def has_triton() -> bool:
    """Whether Triton is installed; torch's CUDA builds include Triton."""
    return importlib.util.find_spec("triton") is not None


class Normaliser(nn.Module):
    """Scales features by mean and deviation, gathered in training until frozen."""

    def __init__(self, width: int, *, most: int = 1000) -> None:
        """Start with nothing gathered.

        Args:
            width: Number of features.
            most: Calls in training after which the statistics stay.
        """
        super().__init__()
        self._most = most
        self.count: Tensor
        self.calls: Tensor
        self.total: Tensor
        self.square: Tensor
        for name, shape in (("count", ()), ("calls", ()), ("total", (width,)), ("square", (width,))):
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    def forward(self, features: Float[Tensor, "rows width"]) -> Float[Tensor, "rows width"]:
        """Scaled features."""
        if self.training and float(self.calls) < self._most:
            values = features.detach().double()
            self.calls += 1
            self.count += len(values)
            self.total += values.sum(dim=0)
            self.square += values.square().sum(dim=0)
        count = self.count.clamp_min(1.0)
        mean = self.total / count
        deviation = (self.square / count - mean.square()).clamp_min(1e-16).sqrt()
        counted = self.count > 0
        mean, deviation = torch.where(counted, mean, 0.0), torch.where(counted, deviation, 1.0)
        return (features - mean.to(features)) / deviation.to(features)


def _perceptron(inputs: int, latent: int, outputs: int, *, norm: bool = True) -> nn.Sequential:
    layers = [nn.Linear(inputs, latent), nn.ReLU(), nn.Linear(latent, latent), nn.ReLU(), nn.Linear(latent, outputs)]
    return nn.Sequential(*layers, nn.LayerNorm(outputs)) if norm else nn.Sequential(*layers)
