"""Outcome of a frame's solve: the visible cloth, the state for the next frame, and the report's entries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import SolveError
from ..colliders.pose import extent
from ..forces.base import ForceModule
from ..integrate.descend import LevelReport
from ..level import Placed, unhindered
from ..resolution import edge_strain, sharp_folds
from ..scene import FARTHEST
from .level_forces import named
from .no_worse import no_worse
from .problem import Problem
from .state import Curvature, State


def refuse_swallowed(problem: Problem) -> None:
    """Refuse cloth wholly in a body, deeper than its own size: pushed out, the cloth would be far from its cage.

    Raises:
        SolveError: Some cloth is wholly in a body.
    """
    swallowed = [] if problem.contact is None else problem.contact.swallowed
    for garment, frame, (deep, body) in zip(problem.group.garments, problem.frames, swallowed, strict=False):
        size = float(np.linalg.norm(extent(frame.points))) if deep else 0.0
        if deep > size:
            fault = f"it is {1e3 * deep:.4g} mm deep in <{body}>, and only {1e3 * size:.4g} mm large"
            raise SolveError(f"{named([garment], problem.at)}: {fault}; mend the one or the other there")


def scaled(problem: Problem, x: Placed) -> Placed:
    """The cloth with scaled detail [m], within bounds, as far as possible without new crossings.

    Raises:
        SolveError: The cloth is not finite or out of bounds.
    """
    group, view = problem.group, problem.view(problem.finest)
    pairs = zip(problem.frames, group.garments, strict=True)
    gain = np.concatenate([frame.detail * garment.detail_scale for frame, garment in pairs])
    result = group.moving_frames.scaled(problem.aim, x, gain)
    if not bool((result.abs() <= FARTHEST).all()):
        fault = f"the refined cloth is not finite or beyond {FARTHEST:g} m; lower physgraph:refine:detail"
        raise SolveError(f"{named(group.garments, problem.at)}: {fault} or detailScale")
    return x if result is x else unhindered(result) if view is None else view.moved(x, result)


def limited(problem: Problem, x: Placed) -> Placed:
    """The cloth within its limits [m], where possible without new crossings; `patched` is to follow."""
    limit, view = problem.limit(problem.finest), problem.view(problem.finest)
    wanted = x if limit is None else limit.scaled(limit.in_front(x))
    if limit is None or wanted is x or view is None:
        return x if wanted is x else unhindered(wanted)
    if view.look(wanted := view.closed(wanted)).is_clean:
        return unhindered(wanted)
    x = view.moved(x, wanted)
    return x if (held := limit.held(x)) is x else unhindered(view.closed(held))


def patched(problem: Problem, x: Placed) -> tuple[Placed, Tensor, dict[str, int]]:
    """The cloth with no patch worse than the subdivided cage, and more, as returned by `no_worse`."""
    view, level = problem.view(problem.finest), problem.forces[-1].level
    none = torch.zeros_like(problem.cage.points[:, 0], dtype=torch.int64)
    before = none if problem.last is None else problem.last.following
    if view is None:
        return x, before, {}
    return no_worse(view, x, problem.subdivided, from_coarse=level.from_coarse, before=before)


def next_state(
    problem: Problem, x: Placed, visible: Placed, memory: Any, *, following: Tensor, crossing: np.ndarray
) -> State:
    """The cloth after the frame.

    Args:
        x: The solved cloth [m], from which the next frame starts.
        visible: The result [m]: its detail scaled, and more.
        memory: The integrator's memory, or None.
        following: As in `State`.
        crossing: As in `State`.
    """
    view, cage = problem.view(problem.finest), problem.cage
    fine = x.double() + torch.as_tensor(cage.origin).to(x.device)
    given_up = None if problem.contact is None else problem.contact.given_up
    state = None if view is None else view.look(x)
    exempt = None if state is None else state.exempt
    return State(
        points=problem.placed(visible),
        crossing=crossing,
        coarse=torch.as_tensor(cage.world),
        fine=fine,
        inside=torch.zeros_like(x[:, 0], dtype=torch.bool) if exempt is None else exempt[: len(x)],
        given_up=torch.zeros_like(cage.points[:, 0], dtype=torch.bool) if given_up is None else given_up,
        following=following,
        still_frames=problem.start.still_frames,
        clean=given_up is None and state is not None and state.is_clean,
        curvature=None if memory is None else Curvature(memory, len(x)),
    )


def telemetry_of(
    problem: Problem, x: Tensor, module: ForceModule, *, solved: Tensor, reports: Sequence[LevelReport]
) -> dict[str, Any]:
    """Telemetry of a frame's solve and result, as plain values.

    Args:
        x: The result [m].
        solved: The result before it was moved into its limits, for the energies [m].
        module: The terms at the finest level.
    """
    finest = problem.forces[-1].level
    base = finest.base.apply(problem.cage.points)
    return {
        "levels": [asdict(report) for report in reports],
        "energy_joules": {"input": module.energies(base), "output": module.energies(solved)},
        "sharp_folds": sharp_folds(finest, x),
        "strain": edge_strain(finest, x),
        "remaining_mm": round(1e3 * problem.group.spacings[-1] * reports[-1].remaining_move, 4) if reports else 0.0,
        "start": problem.start.reason,
    }


def measured(problem: Problem, x: Tensor) -> tuple[dict[str, object], np.ndarray]:
    """Measures of contact: near parts and crossings, including contact switched off but measured.

    Args:
        x: The result [m].

    Returns:
        Plain values, and whether each vertex belongs to crossing cloth, shape (V,), bool.
    """
    group, settings = problem.group, problem.group.settings.contact.to_measure()
    judge = (
        problem.contact
        if settings is None
        else group.contact(problem.frames, problem.cage, touching=problem.touching, settings=settings)
    )
    if judge is None:
        return {}, np.zeros(len(x), bool)
    values, crossing = judge.measure(x)
    return values, crossing.cpu().numpy()
