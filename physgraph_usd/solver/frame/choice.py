"""What ``auto``, refine's default, decides frame by frame: the levels of a cold frame, and the integrator.

Coarse levels are cheap and carry folds far, but each has a start of its own. Under one subdivision lies one coarse
level, a quarter of the finest, and more steps at the finest alone get as far in less time. Not where cloth lies near
cloth: who lies above whom is settled at the cage. `python -m benchmarks.front` measures it; docs/notes/chart.md has
the table. What starts from the last frame's detail starts at the finest level in any case.

On CUDA a coarse level's steps take as long as the finest's, so a cold frame goes there only where the cage is far from
rest: folded, or pressed on by bodies, it is what coarse levels carry far (`--device cuda`).

On CUDA the network's step costs less than quasi-Newton's and goes further (docs/notes/learned.md, `python -m
benchmarks.learned --device cuda`). On the CPU it costs more, and pays where a cold frame goes through two coarse levels
or more and the cage does not cross itself. Elsewhere, where cloth presses on cloth, the guard rejects most of its
steps, and quasi-Newton makes them.
"""

from __future__ import annotations

from dataclasses import dataclass

from .problem import Problem

LONGER, LONGER_CUDA = 4, 8
"""Steps of the finest level alone over those that it takes after coarse ones, on the CPU and on CUDA."""
CROWDED = 0.1
"""Part of the vertices with cloth near them from which a cold frame goes through the levels."""
DEEP = 2
"""Subdivisions from which the network makes the steps of a cold frame that goes through the levels, on the CPU too."""
RESTING = 0.05
"""Remaining move of the cage, in its edge lengths, under which it is nearly at rest."""
FAR = 0.4
"""The same from which it is far from rest: under it a cold frame on CUDA is solved at the finest level alone."""


@dataclass(frozen=True)
class Choice:
    """How a cold frame is solved.

    Attributes:
        nested: Coarse levels first; otherwise the finest level only.
        steps: Steps at the finest level, over those that were asked for.
        reason: Why, or "" where nothing was left to choose.
        learned: Whether the network makes the steps, not quasi-Newton.
    """

    nested: bool
    steps: int = 1
    reason: str = ""
    learned: bool = False


def choose(problem: Problem, nested: bool | None) -> Choice:
    """Choose for one frame.

    Args:
        problem: The frame; how crowded the cage is and how far from rest are found only where they matter.
        nested: What the method asks for; None leaves it open.
    """
    warm, subdivisions = problem.warm, problem.finest
    if nested is not None:
        return Choice(nested and not warm)
    cuda = problem.device != "cpu"
    alone = not warm and subdivisions > 0 and (subdivisions == 1 or problem.remaining < (FAR if cuda else RESTING))
    many = not warm and subdivisions >= DEEP and not problem.crossed
    crowding = problem.crowding if alone or (cuda and not many) else 0.0
    crowded = alone and crowding > CROWDED
    deep = many and (crowded or not alone)
    learned = deep or (cuda and (not crowding or (alone and not crowded)))
    who = f"; physgraph, the quicker one {'there' if deep else 'on CUDA'}" if learned else ""
    if warm:
        return Choice(False, reason=who.removeprefix("; "), learned=learned)
    if crowded:
        reason = f"level by level: cloth crosses cloth, or much of it lies near some{who}"
        return Choice(True, reason=reason, learned=learned)
    if not alone:
        return Choice(True, reason=f"level by level: {subdivisions} subdivisions{who}", learned=learned)
    why = "one subdivision" if subdivisions == 1 else f"the cage is {'not far from' if cuda else 'nearly at'} rest"
    near = "little" if crowding else "no"
    reason = f"the finest level alone: {why}, and {near} cloth lies near cloth{who}"
    return Choice(False, LONGER_CUDA if cuda else LONGER, reason, learned)
