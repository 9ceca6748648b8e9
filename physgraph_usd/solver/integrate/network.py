"""The network of the learned integrator `physgraph`; its inputs are unitless numbers, and name no force.

The network outputs the coefficients of a few vectors per vertex. Its features are rotation invariant only: scalar
products relative to the mean square, and the logarithm of the mean square. Therefore the displacement rotates exactly
with the cloth, for any weights. Each vertex sees only its own surroundings, so a patch moves equally in any garment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from .vertex_frame import PARTS

WHOLE = ("metric", "metric1", "metric2", "move1", "move2", "diagonal", "diagonal1", "secant")
"""Vectors of a vertex: H0^-1 F now and one and two steps ago, the last displacements, the force over H0's diagonal now
and before, the L-BFGS direction."""
VECTORS = (*WHOLE, *(f"{name}.{part}" for name in WHOLE for part in PARTS))
"""Vectors available for combination: `WHOLE` and the parts."""

ZERO_LENGTH = 1e-9
"""Lengths below this many edges count as zero."""
LOG_SCALE, LOG_OFFSET = 0.25 / math.log(10.0), 1.5
"""Scale and offset of lengths: (log10 + 3) / 2 of a length, from the natural logarithm of the squared length."""

Parts = tuple[tuple[int, bool], ...]
Pairs = tuple[tuple[int, int], ...]
Families = tuple[tuple[int, bool], ...]


@dataclass(frozen=True)
class PhysgraphConfig:
    """Size of a `Physgraph`.

    Attributes:
        vectors: Names in `VECTORS`.
        width: Hidden numbers per vertex.
        depth: Hidden layers.
    """

    vectors: tuple[str, ...] = ("metric", "metric1", "move1", "move2", "diagonal")
    width: int = 32
    depth: int = 2


class Physgraph(nn.Module):
    """Coefficients of vectors from rotation-invariant features; an untrained network returns the first vector."""

    def __init__(self, config: PhysgraphConfig) -> None:
        """Make the layers; the last one starts at zero."""
        super().__init__()
        self.config = config
        count, width = len(config.vectors), config.width
        first, second = pairs_of(config.vectors)
        self._first: Tensor
        self._second: Tensor
        self._family: Tensor
        self._mean: Tensor
        self.register_buffer("_first", first, persistent=False)
        self.register_buffer("_second", second, persistent=False)
        self.register_buffer("_family", torch.tensor(families_of(config.vectors)), persistent=False)
        self.register_buffer("_mean", family_means(config.vectors), persistent=False)
        self.encode = nn.Linear(count + len(first) + self._mean.shape[1], width)
        self.encode_means = nn.Linear(1, width, bias=False)  # Of the number of steps; weights files fix the name.
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(config.depth - 1))
        self.decode = nn.Linear(width, count)
        nn.init.zeros_(self.decode.weight)
        nn.init.zeros_(self.decode.bias)

    def forward(self, vectors: Float[Tensor, "vertices vectors 3"], step: int) -> Float[Tensor, "vertices vectors"]:
        """Coefficients of the vectors.

        Args:
            vectors: The configuration's vectors, in local edge lengths.
            step: Number of previous steps.
        """
        square = vectors.square().sum(dim=2)  # V N
        size = (square @ self._mean + ZERO_LENGTH**2).sqrt()  # V K
        unit = vectors / size[:, self._family].unsqueeze(2)  # V N 3
        product = (unit[:, self._first] * unit[:, self._second]).sum(dim=2)  # V P
        seen = torch.cat([unit.square().sum(dim=2), product, 0.5 * (size.log10() + 3.0)], dim=1)
        h = self.encode(seen) + self.encode_means.weight[:, 0] * clock_of(step)  # V W
        for layer in self.hidden:
            h = layer(torch.relu(h))  # V W
        coefficients = self.decode(torch.relu(h))  # V N
        start = torch.zeros_like(coefficients[0])
        start[:1].fill_(1.0)
        return coefficients + start


def families_of(names: Sequence[str]) -> tuple[int, ...]:
    """The family of each vector: forces over the diagonal form one family, displacements the second.

    Families differ in size because H0^-1 collects distant forces. Families are numbered in order of appearance.
    """
    kinds = [name.startswith("diagonal") for name in names]
    order = list(dict.fromkeys(kinds))
    return tuple(order.index(kind) for kind in kinds)


def counted(names: Sequence[str]) -> tuple[bool, ...]:
    """Whether each vector counts in its family's mean square: all but normal parts of vectors present themselves."""
    return tuple(not (part == "normal" and base in names) for base, _, part in (n.partition(".") for n in names))


def family_means(names: Sequence[str]) -> Float[Tensor, "vectors families"]:
    """The matrix mapping the squares of all vectors to each family's mean square."""
    families = torch.tensor(families_of(names))
    members = families[:, None] == torch.arange(int(families.max()) + 1)
    members = (members & torch.tensor(counted(names))[:, None]).float()
    return members / members.sum(dim=0)


def pairs_of(names: Sequence[str]) -> Int[Tensor, "2 pairs"]:
    """The pairs of vectors with scalar products as features.

    Pairs of whole vectors, pairs of a vector and its mean, and pairs of a part and the first part of its kind. Normal
    parts are parallel: a few products determine all, and the product with the vector itself is the square.
    """
    split = [name.partition(".")[::2] for name in names]
    kinds = [kind for _, kind in split]

    def seen(a: int, b: int) -> bool:
        (base_a, part_a), (base_b, part_b) = split[a], split[b]
        related = base_a == base_b and not (part_a and part_b) and "normal" not in (part_a, part_b)
        return part_a == part_b == "" or related or (part_a == part_b and kinds.index(part_a) in (a, b))

    count = len(names)
    chosen = [(a, b) for a in range(count) for b in range(a + 1, count) if seen(a, b)]
    return torch.tensor(chosen, dtype=torch.int64).reshape(-1, 2).T


def pairs_in(names: Sequence[str]) -> Pairs:
    """`pairs_of` as a tuple, for kernels."""
    return tuple((a, b) for a, b in pairs_of(names).T.tolist())


def counted_families(names: Sequence[str]) -> Families:
    """Family of each vector, and whether the vector counts in the family's mean square, for kernels."""
    return tuple(zip(families_of(names), counted(names), strict=True))


def in_rows(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[int, ...], Parts]:
    """Rows of the kernels' table for vectors of given names.

    Returns:
        The whole vectors, which are the first rows; the whole vectors with neighbour means as the last rows; for each
        name its row and whether the name is the normal part of the row.
    """
    split = [name.partition(".")[::2] for name in names]
    wholes = tuple(dict.fromkeys(base for base, _ in split))
    smoothed = tuple(wholes.index(base) for base, part in split if part == "smooth")

    def row_of(base: str, part: str) -> tuple[int, bool]:
        row = wholes.index(base)
        return (len(wholes) + smoothed.index(row), False) if part == "smooth" else (row, part == "normal")

    return wholes, smoothed, tuple(row_of(base, part) for base, part in split)


def clock_of(step: int) -> float:
    """The number of steps made, as a feature."""
    return math.log1p(step) - 1.5
