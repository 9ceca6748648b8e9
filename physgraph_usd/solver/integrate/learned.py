"""The learned integrators: one force evaluation a step, no line search; the guard around them keeps them safe.

| symbol | here | meaning |
|---|---|---|
| H0^-1 F | ``preconditioned`` | displacement that a linear cloth of the rest shape would answer with [m] |
| v_i | ``vectors`` | what the network may combine, in local edge lengths |
| c_i | ``coefficients`` | what the network answers |
| D | ``move`` | sum_i c_i v_i, no longer than `LONGEST` edges at any vertex |

Both see a `System` and nothing else. Weights are read from safetensors files that carry their kind, their configuration
and a hash of the numbers.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TypeVar
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import SolveError
from .around import Around
from .base import Carry, Surface, System
from .fused import FusedPhysgraph, can_fuse, fused_physgraph
from .guard import Guard
from .network import Graph, Physgraph
from .paper_network import PaperNetwork, Ways
from .quasi_newton import QuasiNewton
from .recorded import FORCE, IMAGE, MOST_GARMENTS, SECANTS, Place, Recording
from .secants import Secant, secant_direction, secant_of

NetworkT = TypeVar("NetworkT", Physgraph, PaperNetwork)

LONGEST = 5.0
"""Most edge lengths that a vertex moves in a step."""
RECORDINGS = 6
"""Recordings kept: of the levels of a garment, or of two."""
WORTH = 6
"""Steps from which those of a system that is met only once are recorded: recording costs as much as four."""


@dataclass(frozen=True, eq=False)
class _Memory:
    """The last steps, newest first: H0^-1 F, displacements [m] and forces [N]; the secants; the number of steps."""

    images: tuple[Tensor, ...]
    forces: tuple[Tensor, ...]
    moves: tuple[Tensor, ...] = ()
    pairs: tuple[Secant, ...] = ()
    step: int = 0
    graph: Graph | None = field(default=None, repr=False)


class LearnedMetric:
    """`physgraph`: a network chooses, vertex by vertex, how a few vectors make the step."""

    name = "physgraph"

    def __init__(self, network: Physgraph, *, fuse: bool = True, record: bool = True) -> None:
        """Keep the network.

        Args:
            network: The network.
            fuse: Run it as one kernel where there is one for it and no gradient is asked for.
            record: On CUDA, record a step and replay it.
        """
        self._network = network
        trained = not any(parameter.requires_grad for parameter in network.parameters())
        self._fuse = fuse and trained and can_fuse(network.config, torch.float32)
        self._record = record and trained
        self._recordings: dict[System, Recording] = {}

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x with an empty memory; the network counts as precisely as the system does."""
        self._network = placed(self._network, system, x.dtype)
        energy, force = system.energy_and_force(x)
        image = system.apply_smooth_inverse(force)
        recording = self._recorded(system)
        if recording is not None:
            return recording.begin(x, energy, force, image)
        memory = _Memory((image,), (force,), graph=graph_of(system))
        return Carry(x, energy, force, image, self.name, memory)

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate the carry's positions under forces that changed a little; the last displacements are kept."""
        energy, force = system.energy_and_force(carry.x)
        image = system.apply_smooth_inverse(force)
        old = carry.memory
        if isinstance(old, Place):
            before, recording = old.recording, self._recorded(system)
            if recording is not None:
                if recording is not before:
                    recording.take_over(before)
                return recording.go_on(carry.x, energy, force, image)
            old = self._released(before, graph_of(system))
        memory = replace(old, images=(image, *old.images[1:]), forces=(force, *old.forces[1:]))
        return Carry(carry.x, energy, force, image, self.name, memory)

    def step(self, system: System, carry: Carry) -> Carry:
        """One step along the network's combination."""
        if isinstance(carry.memory, Place):
            return carry.memory.recording.advance(carry)
        move = self.propose(system, carry)
        x = carry.x + move
        energy, force = system.energy_and_force(x)
        image = system.apply_smooth_inverse(force)
        return Carry(x, energy, force, image, self.name, self._remember(carry, move, force, image=image))

    def follow(self, system: System, carry: Carry, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x [m] and remember the way there as a step of the network's."""
        energy, force = system.energy_and_force(x)
        image = system.apply_smooth_inverse(force)
        if isinstance(carry.memory, Place):
            return carry.memory.recording.follow(carry, x, energy, force, image)
        return Carry(x, energy, force, image, self.name, self._remember(carry, x - carry.x, force, image=image))

    def propose(self, system: System, carry: Carry) -> Float[Tensor, "vertices 3"]:
        """The displacement of the next step [m]."""
        memory: _Memory = carry.memory
        assert memory.graph is not None
        whole, fused = partial(self._vector, system=system, carry=carry), self._fused(system, memory.graph)
        return self._combined(system, carry.x, whole, step=memory.step, graph=memory.graph, fused=fused)

    def _fused(self, system: System, graph: Graph) -> FusedPhysgraph | None:
        """The network as one kernel for a system, where there is one."""
        if not self._fuse or system.spacing.dtype != torch.float32:
            return None
        threads = 1 if system.level is None else system.level.threads
        starts = (*(span.start for span in graph.spans), len(system.spacing))
        return fused_physgraph(self._network, starts, LONGEST, device=str(system.spacing.device), threads=threads)

    def _combined(
        self,
        system: System,
        x: Tensor,
        whole: Callable[[str], Tensor],
        *,
        step: int | Tensor,
        graph: Graph,
        fused: FusedPhysgraph | None,
    ) -> Float[Tensor, "vertices 3"]:
        """The network's combination of vectors [m]; ``whole`` gives those without a dot in their name."""
        names = self._network.config.vectors
        if fused is not None:
            around = cache(lambda: Around(_level(system), x))
            bases = vectors_of(fused.bases, whole, around=around)
            return fused(bases, system.spacing, system.reach, step, around=around)
        stacked = torch.stack(vectors_of(names, whole, around=cache(lambda: Around(_level(system), x))), dim=1)  # V N 3
        needed = self._network.config.strain or self._network.config.rounds > 0
        strain = edge_strain(system, x) if needed else None
        scaled = stacked / system.spacing.reshape(-1, 1, 1)  # V N 3
        coefficients = self._network(scaled, strain, step, graph=graph)  # V N
        move = (coefficients.unsqueeze(2) * stacked).sum(dim=1)  # V 3
        return limited(move, system.spacing) * system.free

    def records(self, system: System) -> bool:
        """Whether a system's steps are recorded: on CUDA, once trained, where it is met again or takes many."""
        few = system.level is None or len(system.level.spans) <= MOST_GARMENTS
        pays = system.lasting or system.expected >= WORTH
        return self._record and pays and system.spacing.is_cuda and few

    def _recorded(self, system: System) -> Recording | None:
        """The recording of a system's steps, where they are recorded.

        Those of the last few systems that are met again are kept, and the last of another.
        """
        if not self.records(system):
            return None
        known = self._recordings.pop(system, None)
        if known is None:
            graph = graph_of(system)
            # A recording keeps what its kernels write to: what is cached for all may be dropped.
            propose = partial(self._propose_recorded, graph=graph, fused=self._fused(system, graph))
            known = Recording(system, propose)
            for other in [each for each in self._recordings if not (each.lasting or system.lasting)]:
                del self._recordings[other]
        self._recordings[system] = known
        while len(self._recordings) > RECORDINGS:
            del self._recordings[next(iter(self._recordings))]
        return known

    def _released(self, recording: Recording, graph: Graph) -> _Memory:
        """What a recording knows, for steps that are not recorded: those of a system that is met only once."""
        rows, made, last = recording.rows.clone(), int(recording.step), SECANTS - 1
        before = tuple(recording.images.clone())
        pairs: tuple[Secant, ...] = ()
        if "secant" in self._network.config.vectors:
            first = max(SECANTS - made, 0)
            pairs = tuple(secant_of(*rows[k:FORCE:SECANTS], graph=graph) for k in range(first, SECANTS))
        return _Memory(
            images=(rows[IMAGE], *before[:made]),
            forces=(rows[FORCE], recording.force_before.clone())[: made + 1],
            moves=(rows[last], rows[last - 1])[:made],
            pairs=pairs,
            step=made,
            graph=graph,
        )

    def _propose_recorded(self, recording: Recording, *, graph: Graph, fused: FusedPhysgraph | None) -> Tensor:
        """The displacement of the next step [m] out of a recording's buffers."""
        system, rows = recording.system, recording.rows
        diagonal = system.rest_diagonal.unsqueeze(1)
        known = {
            "secant": recording.direction,
            "metric": lambda: rows[IMAGE],
            "metric1": lambda: recording.images[0],
            "metric2": lambda: recording.images[1],
            "move1": lambda: rows[SECANTS - 1],
            "move2": lambda: rows[SECANTS - 2],
            "diagonal": lambda: rows[FORCE] / diagonal,
            "diagonal1": lambda: recording.force_before / diagonal,
        }
        x, step = recording.x, recording.step
        return self._combined(system, x, lambda name: known[name](), step=step, graph=graph, fused=fused)

    def _vector(self, name: str, *, system: System, carry: Carry) -> Tensor:
        """One of `network.VECTORS` [m]; zero where the past does not reach so far."""
        memory: _Memory = carry.memory
        if name == "secant":
            assert memory.graph is not None
            return secant_direction(carry.force, memory.images[0], memory.pairs, graph=memory.graph)
        kind, age = name.rstrip("0123456789"), int(name[-1]) if name[-1].isdigit() else 0
        if kind == "move":
            known, age = memory.moves, age - 1
        else:
            known = memory.images if kind == "metric" else memory.forces
        if age >= len(known):
            return torch.zeros_like(carry.x)
        return known[age] / system.rest_diagonal.unsqueeze(1) if kind == "diagonal" else known[age]

    def _remember(self, carry: Carry, move: Tensor, force: Tensor, *, image: Tensor) -> _Memory:
        old: _Memory = carry.memory
        pairs = old.pairs
        if "secant" in self._network.config.vectors:
            assert old.graph is not None
            pair = secant_of(move, carry.force - force, old.images[0] - image, graph=old.graph)
            pairs = (*pairs, pair)[-SECANTS:]
        return replace(
            old,
            images=(image, *old.images[:2]),
            forces=(force, *old.forces[:1]),
            moves=(move, *old.moves[:1]),
            pairs=pairs,
            step=old.step + 1,
        )


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
        # A third of the trace of the Hessian's blocks, at the start: what the force is measured in (A7).
        stiffness = system.diagonal(x).unsqueeze(1)
        return Carry(x, energy, force, None, self.name, _Memory((stiffness,), (force,)))

    def step(self, system: System, carry: Carry) -> Carry:
        """One step of the network."""
        memory: _Memory = carry.memory
        move = self.propose(system, carry)
        x = carry.x + move
        energy, force = system.energy_and_force(x)
        keep = self._network.config.history
        forces, moves = (force, *memory.forces)[:keep], (move, *memory.moves)[:keep]
        return Carry(x, energy, force, None, self.name, replace(memory, forces=forces, moves=moves))

    def propose(self, system: System, carry: Carry) -> Float[Tensor, "vertices 3"]:
        """The displacement of the next step [m]."""
        memory: _Memory = carry.memory
        config, level = self._network.config, _level(system)
        ways = ways_of(level)
        scaled = config.features == "scaled"
        length = system.spacing.unsqueeze(1)  # V 1
        unit, force_unit = (length, memory.images[0] * length) if scaled else (1.0, 1.0)
        none = [torch.zeros_like(carry.x)] * config.history
        moves = [-move / unit for move in (*memory.moves, *none)[: config.history]]
        forces = [force / force_unit for force in (*memory.forces, *none)[: config.history]]
        vertex = torch.cat([*moves, *forces], dim=1)  # V 6H
        sender, receiver = ways.sender, ways.receiver
        size = 0.5 * (length[sender] + length[receiver]) if scaled else 1.0
        spans = [(x[receiver] - x[sender]) / size for x in (carry.x, level.rest)]
        edge = torch.cat([part for s in spans for part in (s, s.norm(dim=1, keepdim=True))], dim=1)  # 2E 8
        fixed = (~system.free).to(torch.float32)
        with fast_products(carry.x.is_cuda and not self._network.training):
            out = self._network(vertex.float(), edge.float(), fixed, ways=ways)
        return limited(out.to(carry.x) * length, system.spacing) * system.free


def placed(network: NetworkT, system: System, dtype: torch.dtype) -> NetworkT:
    """The network on the system's device and of a scalar type: itself, or a copy."""
    parameter, device = next(network.parameters()), system.spacing.device
    fits = (parameter.device, parameter.dtype) == (device, dtype)
    return network if fits else copy.deepcopy(network).to(device=device, dtype=dtype)


def integrator_of(network: Physgraph | PaperNetwork) -> LearnedMetric | LearnedPaper:
    """The integrator that uses a network."""
    return LearnedMetric(network) if isinstance(network, Physgraph) else LearnedPaper(network)


def guarded(network: Physgraph | PaperNetwork) -> Guard:
    """The integrator as it is used: guarded, our own with quasi-Newton to spare."""
    return Guard(integrator_of(network), spare=QuasiNewton() if isinstance(network, Physgraph) else None)


def limited(move: Float[Tensor, "vertices 3"], spacing: Float[Tensor, " vertices"]) -> Float[Tensor, "vertices 3"]:
    """The displacement, shortened to `LONGEST` local edge lengths at each vertex (STABILITY.md S12)."""
    size = move.square().sum(dim=1, keepdim=True).clamp_min(torch.finfo(move.dtype).tiny).sqrt()
    return move * (LONGEST * spacing.unsqueeze(1) / size).clamp_max(1.0)


def vectors_of(names: Sequence[str], whole: Callable[[str], Tensor], *, around: Callable[[], Around]) -> list[Tensor]:
    """The vectors of given names [m]; those with a dot are parts of whole ones (`around.PARTS`).

    Args:
        names: Names out of `network.VECTORS`.
        whole: Gives a vector without a dot in its name.
        around: Gives the surroundings of the vertices.
    """
    found: dict[str, Tensor] = {}
    for name in names:
        base, _, part = name.partition(".")
        if base not in found:
            found[base] = whole(base)
        if part:
            found[name] = around().part(found[base], part)
    return [found[name] for name in names]


def graph_of(system: System) -> Graph:
    """Garments and edges of a system; without a level, one garment without edges."""
    level = system.level
    if level is None:
        owner = torch.zeros(len(system.spacing), dtype=torch.int64, device=system.spacing.device)
        edges = owner.new_zeros((0, 2)).int()
        return Graph(owner, (slice(0, len(owner)),), edges, system.spacing, system.spacing.new_zeros(0))
    return Graph(level.vertex_garment.long(), level.spans, level.edges, system.spacing, level.rest_length)


_WAYS: WeakKeyDictionary[Surface, Ways] = WeakKeyDictionary()


def ways_of(level: Surface) -> Ways:
    """The edges of a level in both directions, found once."""
    if level not in _WAYS:
        _WAYS[level] = Ways.of(level.edges, len(level.rest))
    return _WAYS[level]


@contextmanager
def fast_products(wanted: bool) -> Iterator[None]:
    """Let float32 products of matrices on CUDA use tensor cores, whose factors have 10 bits: enough for a proposal."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = wanted or before
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


def edge_strain(system: System, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " edges"]:
    """Extension of each edge over its rest length."""
    level = _level(system)
    ends = level.edges.long()
    square = (x[ends[:, 1]] - x[ends[:, 0]]).square().sum(dim=1)
    return square.clamp_min(1e-30).sqrt() / level.rest_length - 1.0


def _level(system: System) -> Surface:
    if system.level is None:
        raise SolveError("this network needs a mesh, and the system has none")
    return system.level
