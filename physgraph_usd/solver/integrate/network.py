"""The network of our own learned integrator; it sees numbers without units and knows no force (DESIGN 4.4).

`Physgraph` looks at a few vectors per vertex and answers with the coefficients of their combination. It is told only
what a rotation does not change: scalar products over the mean square, and the logarithm of that. So the displacement
turns with the cloth exactly, whatever the weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from .around import PARTS, SHOWN, squashed

WHOLE = ("metric", "metric1", "metric2", "move1", "move2", "diagonal", "diagonal1", "secant")
"""Vectors of a vertex: H0^-1 F now and one and two steps ago, the last displacements, the force over H0's diagonal now
and before, the L-BFGS direction."""
VECTORS = (*WHOLE, *(f"{name}.{part}" for name in WHOLE for part in PARTS))
"""What can be combined: those and their parts."""

FLOOR = 1e-9
"""Lengths below this many edges count as none."""
LOG_SCALE, LOG_OFFSET = 0.25 / math.log(10.0), 1.5
"""The networks see (log10 + 3) / 2 of a length: of its square's natural logarithm so much, and this."""
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
        products: Between "all" vectors, or "few" of them (`pairs_of`).
        noise: Standard deviation of what is added to each vertex's features in training, so that a small change of them
            never decides.
    """

    vectors: tuple[str, ...] = ("metric", "metric1", "move1", "move2", "diagonal")
    width: int = 32
    depth: int = 2
    rounds: int = 0
    strain: bool = False
    means: bool = True
    products: str = "all"
    noise: float = 0.0


class Physgraph(nn.Module):
    """Coefficients of vectors from what rotations leave alone; untrained it answers with the first vector itself."""

    def __init__(self, config: PhysgraphConfig) -> None:
        """Make the layers; the last one starts at zero."""
        super().__init__()
        self.config = config
        count, width = len(config.vectors), config.width
        first, second = pairs_of(config)
        self._first: Tensor
        self._second: Tensor
        self._family: Tensor
        self._share: Tensor
        self.register_buffer("_first", first, persistent=False)
        self.register_buffer("_second", second, persistent=False)
        self.register_buffer("_family", torch.tensor(families_of(config.vectors)), persistent=False)
        self.register_buffer("_share", sharing(config.vectors), persistent=False)
        numbers = count + len(first)
        self.encode = nn.Linear(numbers + self._share.shape[1] + 3 * config.strain, width)
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
        size = (square @ self._share + FLOOR**2).sqrt()  # V K
        unit = vectors / size[:, self._family].unsqueeze(2)  # V N 3
        product = (unit[:, self._first] * unit[:, self._second]).sum(dim=2)  # V P
        local = [unit.square().sum(dim=2), product, _scaled_log(size)]
        if self.config.strain and strain is not None:
            local.append(_strain_features(strain, graph))  # V 3
        means = self._means(vectors, square, step, graph=graph)  # G 1 or G 1+N+P
        seen = torch.cat(local, dim=1)
        if self.training and self.config.noise:
            seen = seen + self.config.noise * torch.randn_like(seen)
        h = self.encode(seen) + self.encode_means(means)[graph.owner]  # V W
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


def families_of(names: Sequence[str]) -> tuple[int, ...]:
    """The family of each vector: forces over the diagonal are one, displacements the other.

    They differ in size by what H0^-1 carries from afar. Families are numbered in the order in which they come.
    """
    kinds = [name.startswith("diagonal") for name in names]
    order = list(dict.fromkeys(kinds))
    return tuple(order.index(kind) for kind in kinds)


def counted(names: Sequence[str]) -> tuple[bool, ...]:
    """Which vectors count in their family's mean square: all but normal parts of those that are there themselves."""
    return tuple(not (part == "normal" and whole in names) for whole, _, part in (n.partition(".") for n in names))


def sharing(names: Sequence[str]) -> Float[Tensor, "vectors families"]:
    """What gives each family's mean square, out of the squares of all vectors."""
    families = torch.tensor(families_of(names))
    own = families[:, None] == torch.arange(int(families.max()) + 1)
    own = (own & torch.tensor(counted(names))[:, None]).float()
    return own / own.sum(dim=0)


def pairs_of(config: PhysgraphConfig) -> Int[Tensor, "2 pairs"]:
    """The vectors whose scalar products a network sees.

    Normal parts are parallel: of their products a few say everything, and that with the vector itself is their square.
    "few" are those between whole vectors, between a mean or a part by strain and its own vector, and between a part and
    the first of its kind.
    """
    names = [name.partition(".")[::2] for name in config.vectors]
    kinds = [kind for _, kind in names]

    def seen(a: int, b: int) -> bool:
        (whole, kind), (other, part) = names[a], names[b]
        own = whole == other and not (kind and part) and "normal" not in (kind, part)
        return kind == part == "" or own or (kind == part and kinds.index(kind) in (a, b))

    count = len(names)
    every = [(a, b) for a in range(count) for b in range(a + 1, count)]
    chosen = [pair for pair in every if config.products == "all" or seen(*pair)]
    return torch.tensor(chosen, dtype=torch.int64).reshape(-1, 2).T


def clock_of(step: int | Tensor) -> Any:
    """What the networks see of the number of steps made."""
    return torch.log1p(step) - 1.5 if isinstance(step, Tensor) else math.log1p(step) - 1.5


def _scaled_log(length: Tensor) -> Tensor:
    return 0.5 * (length.log10() + 3.0)


def _strain_features(strain: Tensor, graph: Graph) -> Tensor:
    """Mean, mean compression and root mean square of the strain at each vertex, as `Around.stretch` has them."""
    ends = graph.edges.long().T.reshape(-1)
    shown = torch.stack([strain, strain.clamp_max(0.0), strain.square(), torch.ones_like(strain)], dim=1)  # E 4
    summed = strain.new_zeros(len(graph.spacing), 4).index_add_(0, ends, shown.repeat(2, 1))  # V 4
    mean = summed[:, :3] / summed[:, 3:].clamp_min(1.0)  # V 3
    mean = torch.cat([mean[:, :2], (mean[:, 2:] + FLOOR).sqrt()], dim=1)
    return squashed(SHOWN * mean)
