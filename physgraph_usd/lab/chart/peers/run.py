"""Solvers outside: a frame's problem goes to a peer's own Python, and its results become rows of the chart."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch

from ....errors import SolveError, UsageError
from ....solver.forces.base import ForceModule
from ....solver.forces.bending import Bending
from ....solver.forces.guide import Guide
from ....solver.forces.stretch import Stretch
from ....solver.frame.group import Group
from ....solver.level import Level
from ....solver.scene import Frame
from ..measure import CurveBench, budgets_of
from ..options import Plan
from ..problem import Problem

HERE = Path(__file__).parent
MOST_STEPS = 1024
"""Largest budget of a solver outside."""


@dataclass(frozen=True)
class Peer:
    """A solver outside.

    Attributes:
        name: Name in the chart.
        adapter: The script run by the solver's Python, with options.
        note: How much of the problem it is given, in words.
        follows: Whether the solver computes on our device; otherwise on the CPU.
    """

    name: str
    adapter: str
    note: str
    options: tuple[str, ...] = ()
    follows: bool = False


OURS = "our springs, hinges, guide and gravity; no bodies; 3 iterations a step"
PEERS = {
    "newton": Peer("Newton VBD", "newton_adapter.py", OURS, ("--solver", "vbd"), follows=True),
    "newton-xpbd": Peer("Newton XPBD", "newton_adapter.py", OURS, ("--solver", "xpbd"), follows=True),
    "blender": Peer(
        "Blender cloth (own energy)",
        "blender_adapter.py",
        "an energy of its own, made from our springs, hinges, gravity and rest shape, with a goal at each vertex in "
        "place of the guide; no bodies; its gap is by our potential and tells how far the two energies are apart, too: "
        "compare its strain and its shape",
    ),
}
"""Peers by the name for ``--peer``."""


def parse_peers(values: Sequence[str]) -> list[tuple[Peer, str]]:
    """Peers with the Python of each, from ``NAME=PYTHON``.

    Raises:
        UsageError: A name is unknown or the Python does not exist.
    """
    peers = []
    for value in values:
        name, _, python = value.partition("=")
        if name not in PEERS or not python:
            raise UsageError(f"peer '{value}': write NAME=PYTHON; known names: {', '.join(PEERS)}")
        if not Path(python).is_file():
            raise UsageError(f"peer '{value}': {python} is no program; give the Python that has {name}")
        peers.append((PEERS[name], python))
    return peers


def measure_peers(bench: CurveBench, peers: Sequence[tuple[Peer, str]], *, clock_name: str) -> None:
    """Measure peers, each with its Python, on the frames of a bench by a clock that is "wall" or "cpu"."""
    for (peer, python), frame in product(peers, bench.frames):
        if any(bench.journal.one(kind, method=peer.name, frame=frame.time) for kind in ("point", "failed")):
            continue
        bench.clock.say(peer.name)
        try:
            results = _run(peer, python, bench.timed, frame, plan=bench.plan, clock_name=clock_name)
        except SolveError as error:
            bench.journal.add("failed", steps=0, error=str(error), method=peer.name, frame=frame.time)
            continue
        for nested, steps, points, times in results:
            judged = bench.judged(frame, points)
            for repeat, ms in enumerate(times):
                bench.journal.add(
                    "point",
                    method=f"{peer.name}, nested" if nested else peer.name,
                    frame=frame.time,
                    steps=steps,
                    repeat=repeat,
                    ms=ms,
                    integrator=peer.name,
                    nested=nested,
                    note=peer.note,
                    made=steps,
                    **({} if repeat else judged),
                )


def _run(
    peer: Peer, python: str, problem: Problem, frame: Frame, *, plan: Plan, clock_name: str
) -> list[tuple[bool, int, tuple[np.ndarray, ...], list[float]]]:
    """Results of one frame: nested or flat, steps, positions [m] and times [ms]."""
    parts = problem.refiner.parts_of(frame)
    if len(parts) != 1:
        raise SolveError(f"{peer.name} solves garments that touch as one; the frame has {len(parts)} groups apart")
    [part] = parts
    steps = [count for count in budgets_of(plan.growth) if count <= MOST_STEPS]
    group = problem.refiner.group_of(part)
    with tempfile.TemporaryDirectory() as folder:
        handed, result = Path(folder) / "problem.npz", Path(folder) / "result.npz"
        np.savez(handed, **dict(_problem(problem, frame, part)))
        line = [python, str(HERE / peer.adapter), str(handed), str(result)]
        line += ["--steps", ",".join(map(str, steps)), "--repeats", str(plan.repeats)]
        line += ["--most-ms", str(plan.most_ms), "--clock", clock_name, *peer.options]
        if peer.follows:
            line += ["--device", str(group.levels[-1].device)]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.strip() or done.stdout.strip() or "no word").splitlines()[-1]
            raise SolveError(f"{peer.name} ended with code {done.returncode}: {last}")
        with np.load(result) as data:
            return list(_results(data, group, frame, part))


def _results(
    data: Any, group: Group, frame: Frame, part: tuple[int, ...]
) -> Iterator[tuple[bool, int, tuple[np.ndarray, ...], list[float]]]:
    origin = np.concatenate([frame.garments[index].points for index in part]).mean(axis=0)
    for name in data.files:
        kind, nested, steps = name.split("_")
        if kind == "x":
            world = data[name] + origin
            points = tuple(world[span] for span in group.levels[-1].spans)
            yield nested == "1", int(steps), points, data[f"ms_{nested}_{steps}"].tolist()


def _problem(problem: Problem, frame: Frame, part: tuple[int, ...]) -> Iterator[tuple[str, Any]]:
    """The arrays of every level, under names ending in the level's number."""
    group, chains = problem.refiner.group_of(part), [problem.refiner.refinements[index] for index in part]
    modules, coarse = group.modules([frame.garments[index] for index in part])
    yield "levels", np.array(len(group.levels))
    for index, (level, module) in enumerate(zip(group.levels, modules, strict=True)):
        yield from _level(index, level, module, level.base.apply(coarse))
        if index:
            maps = [
                chain[index - 1].linear if index <= len(chain) else sp.identity(span.stop - span.start, format="csr")
                for chain, span in zip(chains, level.spans, strict=True)
            ]
            yield from _sparse("map_", index, sp.csr_matrix(sp.block_diag(maps)))


def _level(index: int, level: Level, module: ForceModule, base: torch.Tensor) -> Iterator[tuple[str, Any]]:
    """Springs, hinges and the linear rest of one level.

    A hinge at a quad is handed over as hinges of four corners, one for each corner opposite to the edge, with its part
    of the weight: for small bends of a planar quad at rest their mean angle is that of the hinge.
    """
    springs = next((term for term in module.forces if isinstance(term, Stretch)), None)
    hinges = next(term for term in module.forces if isinstance(term, Bending))
    guide = next(term for term in module.forces if isinstance(term, Guide))
    further = [term for term in module.forces if term not in (springs, hinges)]
    if springs is None or len(further) != 2:
        raise SolveError("the peer has no membrane of triangles, which this garment asks for")
    load = torch.zeros_like(base)
    for term in further:
        term.add_force(base, load)
    ends = level.hinges.long()
    pairs = torch.stack([ends[:, [0, 1, k, fourth]] for k in (2, 3) for fourth in (4, 5)], dim=1)
    owner = torch.arange(len(ends), device=ends.device).repeat_interleave(4)
    corners, count = torch.unique(torch.cat([owner[:, None], pairs.reshape(-1, 4)], dim=1), dim=0, return_counts=True)
    values = {
        "base": base,
        "rest": level.rest,
        "triangles": level.triangles,
        "load": load,
        "free": level.free[:, 0],
        "springs": level.springs,
        "rest_length": level.spring_length,
        "spring": springs.stiffness,
        "hinges": corners[:, 1:],
        "rest_angle": level.rest_angle[corners[:, 0]],
        "hinge": hinges.weight[corners[:, 0]] * count / 4.0,
    }
    for name, value in values.items():
        yield f"{name}{index}", value.double().cpu().numpy() if value.is_floating_point() else value.cpu().numpy()
    yield f"bound{index}", guide.rest_springs()[1]
    values = springs.stiffness.double().cpu().numpy().repeat(2)
    yield f"diagonal{index}", np.bincount(level.springs.cpu().numpy().ravel(), values, level.vertex_count)
    yield from _sparse("", index, guide.hessian())


def _sparse(prefix: str, index: int, matrix: sp.csr_matrix) -> Iterator[tuple[str, Any]]:
    yield f"{prefix}values{index}", matrix.data
    yield f"{prefix}columns{index}", matrix.indices
    yield f"{prefix}starts{index}", matrix.indptr
