"""`physgraph-paper`: steps of the paper's network, which sees the mesh's edges and past displacements and forces."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor

from ...solver.integrate.base import Carry, System
from ...solver.integrate.learned import level_of, limited, placed
from ...solver.level import Level
from .paper_network import DirectedEdges, PaperNetwork

_EDGES: WeakKeyDictionary[Level, DirectedEdges] = WeakKeyDictionary()
"""The edges of each level in both directions, found once."""


@dataclass(frozen=True, eq=False)
class _History:
    """Stiffness at the start [N/m], past forces [N] and past displacements [m], newest first."""

    stiffness: Tensor
    forces: tuple[Tensor, ...]
    moves: tuple[Tensor, ...] = ()


class LearnedPaper:
    """`physgraph-paper`: the paper's network, fed past displacements and forces along the edges of the mesh."""

    name = "physgraph-paper"

    def __init__(self, network: PaperNetwork) -> None:
        """Keep the network."""
        self._network = network

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x with an empty history."""
        self._network = placed(self._network, system, torch.float32)
        energy, force = system.energy_and_force(x)
        # A third of the trace of the Hessian's blocks, at the start: what the force is measured in.
        stiffness = system.diagonal(x).unsqueeze(1)
        return Carry(x, energy, force, None, self.name, _History(stiffness, (force,)))

    def step(self, system: System, carry: Carry) -> Carry:
        """A step of the network."""
        memory: _History = carry.memory
        move = self.propose(system, carry)
        x = carry.x + move
        energy, force = system.energy_and_force(x)
        length = self._network.config.history
        forces, moves = (force, *memory.forces)[:length], (move, *memory.moves)[:length]
        return Carry(x, energy, force, None, self.name, _History(memory.stiffness, forces, moves))

    def propose(self, system: System, carry: Carry) -> Float[Tensor, "vertices 3"]:
        """The displacement of the next step [m]."""
        memory: _History = carry.memory
        config, level = self._network.config, level_of(system.level)
        if level not in _EDGES:
            _EDGES[level] = DirectedEdges.of(level.edges, len(level.rest))
        edges = _EDGES[level]
        scaled = config.features == "scaled"
        length = system.spacing.unsqueeze(1)  # V 1
        unit, force_unit = (length, memory.stiffness * length) if scaled else (1.0, 1.0)
        none = [torch.zeros_like(carry.x)] * config.history
        moves = [-move / unit for move in (*memory.moves, *none)[: config.history]]
        forces = [force / force_unit for force in (*memory.forces, *none)[: config.history]]
        vertex = torch.cat([*moves, *forces], dim=1)  # V 6H
        sender, receiver = edges.sender, edges.receiver
        size = 0.5 * (length[sender] + length[receiver]) if scaled else 1.0
        spans = [(x[receiver] - x[sender]) / size for x in (carry.x, level.rest)]
        edge = torch.cat([part for s in spans for part in (s, s.norm(dim=1, keepdim=True))], dim=1)  # 2E 8
        fixed = (~system.free).to(torch.float32)
        with _fast_products(carry.x.is_cuda and not self._network.training):
            out = self._network(vertex.float(), edge.float(), fixed, edges=edges)
        return limited(out.to(carry.x) * length, system.spacing) * system.free


@contextmanager
def _fast_products(wanted: bool) -> Iterator[None]:
    """Let float32 products of matrices on CUDA use tensor cores, whose factors have 10 bits: enough for a proposal."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = wanted or before
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before
