"""The networks of the learned integrators; they see numbers without units and know no force (DESIGN 4.4).

`Physgraph` looks at a few vectors per vertex and answers with the coefficients of their combination. It is told only
what a rotation does not change: logarithms of lengths, cosines, means over the garment. So the displacement turns with
the cloth exactly, whatever the weights.

`PaperNetwork` is the paper's encode-process-decode network (PAPER.md P3 to P5, choices A1 to A7, A17).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from .around import PARTS

WHOLE = ("metric", "metric1", "metric2", "move1", "move2", "diagonal", "diagonal1", "secant")
"""Vectors of a vertex: H0^-1 F now and one and two steps ago, the last displacements, the force over H0's diagonal now
and before, the L-BFGS direction."""
VECTORS = (*WHOLE, *(f"{name}.{part}" for name in WHOLE for part in PARTS))
"""What can be combined: those and their parts."""

FLOOR = 1e-9
"""Lengths below this many edges count as none."""
PIECE = 4096
"""Edges that are updated at once on a CPU: what lies between the layers of more does not stay in its cache, and from
32 MB on the system hands out fresh pages each time."""
FEW = 8
"""Garments up to which sums over each are made one by one."""


@dataclass(frozen=True)
class Graph:
    """Where numbers flow.

    Attributes:
        owner: Garment of each vertex, shape (V,).
        spans: Vertex range of each garment.
        edges: End vertices, shape (E, 2).
        spacing: Mean rest edge at each vertex [m], shape (V,).
        rest_length: Rest length of the edges [m], shape (E,).
    """

    owner: Int[Tensor, " vertices"]
    spans: tuple[slice, ...]
    edges: Int[Tensor, "edges 2"]
    spacing: Float[Tensor, " vertices"]
    rest_length: Float[Tensor, " edges"]

    @property
    def garments(self) -> int:
        """Number of garments."""
        return len(self.spans)

    def total(self, values: Float[Tensor, "vertices width"]) -> Float[Tensor, "garments width"]:
        """Sums over each garment; up to `FEW` garments in an order that is the same on every run."""
        if self.garments <= FEW:
            return torch.stack([values[span].sum(dim=0) for span in self.spans])
        return values.new_zeros(self.garments, values.shape[1]).index_add_(0, self.owner, values)


@dataclass(frozen=True)
class PhysgraphConfig:
    """Size of a `Physgraph`.

    Attributes:
        vectors: Names out of `VECTORS`.
        width: Numbers per vertex inside.
        depth: Hidden layers.
        rounds: Rounds of message passing, with shared weights.
        strain: Show each vertex the strain of its edges.
        means: Show each vertex what its garment as a whole does; without, a patch moves as it would in any garment.
    """

    vectors: tuple[str, ...] = ("metric", "metric1", "move1", "move2", "diagonal")
    width: int = 32
    depth: int = 2
    rounds: int = 0
    strain: bool = False
    means: bool = True


class Physgraph(nn.Module):
    """Coefficients of vectors from what rotations leave alone; untrained it answers with the first vector itself."""

    def __init__(self, config: PhysgraphConfig) -> None:
        """Make the layers; the last one starts at zero."""
        super().__init__()
        self.config = config
        count, width = len(config.vectors), config.width
        first, second = torch.triu_indices(count, count, 1)
        self._first: Tensor
        self._second: Tensor
        self.register_buffer("_first", first, persistent=False)
        self.register_buffer("_second", second, persistent=False)
        numbers = count + len(first)
        self.encode = nn.Linear(numbers + 3 * config.strain, width)
        self.encode_means = nn.Linear(1 + numbers * config.means, width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(config.depth - 1))
        if config.rounds:
            self.message, self.update = nn.Linear(2 * width + 2, width), nn.Linear(2 * width, width)
        self.decode = nn.Linear(width, count)
        nn.init.zeros_(self.decode.weight)
        nn.init.zeros_(self.decode.bias)

    def forward(
        self,
        vectors: Float[Tensor, "vertices vectors 3"],
        strain: Float[Tensor, " edges"] | None,
        step: int | Tensor,
        *,
        graph: Graph,
    ) -> Float[Tensor, "vertices vectors"]:
        """Coefficients of the vectors.

        Args:
            vectors: The configuration's vectors, in local edge lengths.
            strain: Extension of the edges over their rest length, where the configuration asks for it.
            step: Number of steps made before, a scalar on the device while steps are recorded.
            graph: Where numbers flow.
        """
        square = vectors.square().sum(dim=2)  # V N
        length = (square + FLOOR**2).sqrt()  # V N
        unit = vectors / length.unsqueeze(2)  # V N 3
        cosine = (unit[:, self._first] * unit[:, self._second]).sum(dim=2)  # V P
        local = [_scaled_log(length), cosine]
        if self.config.strain and strain is not None:
            local.append(_strain_features(strain, graph))  # V 3
        means = self._means(vectors, square, step, graph=graph)  # G 1 or G 1+N+P
        h = self.encode(torch.cat(local, dim=1)) + self.encode_means(means)[graph.owner]  # V W
        for layer in self.hidden:
            h = layer(torch.relu(h))  # V W
        for _ in range(self.config.rounds):
            h = h + self._round(h, strain, graph)  # V W
        coefficients = self.decode(torch.relu(h))  # V N
        start = torch.zeros_like(coefficients[0])
        start[:1].fill_(1.0)
        return coefficients + start

    def _means(self, vectors: Tensor, square: Tensor, step: int | Tensor, *, graph: Graph) -> Tensor:
        """What each garment as a whole shows: root mean squares, cosines of whole fields, the step."""
        clock = square.new_ones(graph.garments, 1) * clock_of(step)  # G 1
        if not self.config.means:
            return clock
        size = graph.total(torch.ones_like(square[:, :1])).clamp_min(1.0)  # G 1
        products = (vectors[:, self._first] * vectors[:, self._second]).sum(dim=2)  # V P
        total = graph.total(square) / size  # G N
        root = (total + FLOOR**2).sqrt()  # G N
        cosine = graph.total(products) / size / (root[:, self._first] * root[:, self._second])  # G P
        return torch.cat([clock, _scaled_log(root), cosine], dim=1)

    def _round(self, h: Tensor, strain: Tensor | None, graph: Graph) -> Tensor:
        """One round of messages along the edges, both ways, averaged at each vertex."""
        ends = graph.edges.long()
        here, there = torch.cat([ends[:, 0], ends[:, 1]]), torch.cat([ends[:, 1], ends[:, 0]])
        stretch = torch.zeros_like(graph.rest_length) if strain is None else strain
        shown = torch.stack([10.0 * stretch.repeat(2), graph.rest_length.repeat(2) / graph.spacing[here] - 1.0], dim=1)
        sent = torch.relu(self.message(torch.cat([torch.relu(h[here]), torch.relu(h[there]), shown], dim=1)))  # 2E W
        degree = h.new_zeros(len(h), 1).index_add_(0, here, sent[:, :1] * 0 + 1).clamp_min(1.0)
        mean = torch.zeros_like(h).index_add_(0, here, sent) / degree  # V W
        return self.update(torch.cat([torch.relu(h), mean], dim=1))  # V W


def clock_of(step: int | Tensor) -> Any:
    """What the networks see of the number of steps made."""
    return torch.log1p(step) - 1.5 if isinstance(step, Tensor) else math.log1p(step) - 1.5


def _scaled_log(length: Tensor) -> Tensor:
    return 0.5 * (length.log10() + 3.0)


def _strain_features(strain: Tensor, graph: Graph) -> Tensor:
    """Mean, mean compression and root mean square of the strain at each vertex, compressed by asinh."""
    ends = graph.edges.long().T.reshape(-1)
    shown = torch.stack([strain, strain.clamp_max(0.0), strain.square(), torch.ones_like(strain)], dim=1)  # E 4
    summed = strain.new_zeros(len(graph.spacing), 4).index_add_(0, ends, shown.repeat(2, 1))  # V 4
    mean = summed[:, :3] / summed[:, 3:].clamp_min(1.0)  # V 3
    mean = torch.cat([mean[:, :2], (mean[:, 2:] + FLOOR).sqrt()], dim=1)
    return torch.asinh(30.0 * mean)


@dataclass(frozen=True, eq=False)
class Ways:
    """The edges in both directions, sorted by their receiver.

    Attributes:
        sender: Vertex that each starts from, shape (2E,).
        receiver: Vertex that it ends at, shape (2E,).
        degree: How many end at each vertex, shape (V,).
    """

    sender: Int[Tensor, " directed"]
    receiver: Int[Tensor, " directed"]
    degree: Int[Tensor, " vertices"]

    @staticmethod
    def of(edges: Int[Tensor, "edges 2"], vertices: int) -> Ways:
        """Both ways of each edge."""
        sender, receiver = torch.cat([edges, edges.flip(1)]).long().T
        order = receiver.argsort(stable=True)
        return Ways(sender[order], receiver[order], torch.bincount(receiver, minlength=vertices))


@dataclass(frozen=True)
class PaperConfig:
    """Size of a `PaperNetwork`.

    Attributes:
        latent: Numbers per vertex and edge inside.
        rounds: Rounds of message passing.
        history: Displacements and forces shown (H).
        shared: All rounds have the same weights.
        features: "scaled" without units (A7) or "paper", metres and newtons as they are.
    """

    latent: int = 128
    rounds: int = 10
    history: int = 2
    shared: bool = True
    features: str = "scaled"


class PaperNetwork(nn.Module):
    """Encode, process, decode; two hidden layers, LayerNorm on all but the decoder, residuals, sums (A2)."""

    def __init__(self, config: PaperConfig) -> None:
        """Make the five perceptrons; the decoder's last layer starts at zero (A6)."""
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
        ways: Ways,
    ) -> Float[Tensor, "vertices 3"]:
        """Displacement in local edge lengths.

        Args:
            vertex: Past displacements and forces (P3).
            edge: Present and rest spans and their lengths (P4), of each edge in both directions (A3).
            fixed: 1 where a vertex may not move (A17).
            ways: The edges in both directions.
        """
        v = self.encode_vertex(torch.cat([self.vertex_scale(vertex), fixed], dim=1))  # V L
        e = self.encode_edge(self.edge_scale(edge))  # 2E L
        for k in range(self.config.rounds):
            own = 0 if self.config.shared else k
            e = self._edge_update(self.update_edge[own], v, e, ways)  # 2E L
            gathered = torch.segment_reduce(e, "sum", lengths=ways.degree, axis=0, unsafe=True)  # V L
            v = v + self.update_vertex[own](torch.cat([v, gathered], dim=1))  # V L
        return self.step_length * self.decode(v)  # V 3

    def _edge_update(self, perceptron: nn.Module, v: Tensor, e: Tensor, ways: Ways) -> Tensor:
        """The perceptron of (receiver, sender, edge); its first layer meets each vertex once, not once an edge."""
        first, *others = cast(nn.Sequential, perceptron)
        at_receiver, at_sender, at_edge = cast(nn.Linear, first).weight.chunk(3, dim=1)
        from_receiver, from_sender = v @ at_receiver.T, v @ at_sender.T
        bias = cast(nn.Linear, first).bias

        def change(e: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
            h = nn.functional.linear(e, at_edge, bias)
            h = h + from_receiver[receiver] + from_sender[sender]
            for layer in others:
                h = layer(h)
            return h

        if torch.is_grad_enabled() or e.device.type != "cpu":
            return e + change(e, ways.receiver, ways.sender)
        pieces = (part.split(PIECE) for part in (e, ways.receiver, ways.sender))
        return torch.cat([part + change(part, *ends) for part, *ends in zip(*pieces, strict=True)])


class Normaliser(nn.Module):
    """Scales features by their mean and deviation, gathered while training until it is frozen (A5)."""

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
            shown = features.detach().double()
            self.calls += 1
            self.count += len(shown)
            self.total += shown.sum(dim=0)
            self.square += shown.square().sum(dim=0)
        count = self.count.clamp_min(1.0)
        mean = self.total / count
        deviation = (self.square / count - mean.square()).clamp_min(1e-16).sqrt()
        known = self.count > 0
        mean, deviation = torch.where(known, mean, 0.0), torch.where(known, deviation, 1.0)
        return (features - mean.to(features)) / deviation.to(features)


def _perceptron(inputs: int, latent: int, outputs: int, *, norm: bool = True) -> nn.Sequential:
    layers = [nn.Linear(inputs, latent), nn.ReLU(), nn.Linear(latent, latent), nn.ReLU(), nn.Linear(latent, outputs)]
    return nn.Sequential(*layers, nn.LayerNorm(outputs)) if norm else nn.Sequential(*layers)
