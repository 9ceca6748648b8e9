"""How far frames end from rest: the angle by which the surface would still turn if each frame were solved on.

The default makes few steps a frame, which is most of the way down in energy, but the eye sees what is left: folds turn
in the last steps. The unit is the angle between vertex normals at the frame's end and at its rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..solver.deadline import ends_after, is_over
from ..solver.frame.problem import LevelProblem
from ..solver.frame.solve import solve_one_level
from ..solver.integrate.stop import Budget
from ..solver.level import Placed
from ..solver.seen import normal_angles

STEPS, SECONDS = 200, 30.0
"""Most steps and most time [s] of the solve of a frame to its rest. A warm frame of the dancer turns by 9.3 degrees in
100 further steps, by 11.7 in 400 and by 11.9 in 1,500."""
TOLERANCE = 2e-4
"""Remaining move that counts as rest [local edge lengths]: a tenth of the default's tolerance."""


class FromRest:
    """Angles by which frames would still turn. `note` is for `SolveSettings.ended`; `measure` follows each frame.

    The solves go on from where a frame ended, with contact found anew as the cloth moves. What the next frame starts
    from does not change.
    """

    def __init__(self) -> None:
        """Start without frames."""
        self._ended: dict[int, tuple[LevelProblem, Placed]] = {}
        self._angles: list[np.ndarray] = []
        self._frames, self._late = 0, False

    def note(self, problem: LevelProblem, x: Placed) -> None:
        """Note where the solve of a finest level ended [m]; a second solve in a frame replaces the first."""
        self._ended[id(problem.level)] = problem, x

    def measure(self) -> None:
        """Continue the solve of the noted levels to rest, record the angles, and drop the levels."""
        ended, self._ended = self._ended, {}
        self._frames += 1
        with ends_after(SECONDS):
            for problem, x in ended.values():
                self._angles.append(angles_to_rest(problem, x))
            self._late = self._late or is_over()

    def plain(self) -> dict[str, Any]:
        """Degrees within which half and nine tenths of the cloth end, and in words; empty without a solve."""
        if not self._angles:
            return {}
        half, most = (float(f"{angle:.2g}") for angle in np.percentile(np.concatenate(self._angles), (50.0, 90.0)))
        so_far = ", so far as they were followed" if self._late else ""
        return {
            "degrees_half": half,
            "degrees_nine_tenths": most,
            "frames": self._frames,
            "words": f"the folds are within {half:g} degrees of where they would end on half of the cloth, "
            f"within {most:g} on nine tenths{so_far}",
        }


def angles_to_rest(problem: LevelProblem, x: Placed) -> np.ndarray:
    """Angles by which the surface turns if a level is solved on from where it ended [degrees], shape (V,).

    Args:
        problem: The finest level of a frame.
        x: Positions at the end of its solve [m].
    """
    triangles = problem.level.triangles.cpu().numpy()
    before = x.double().cpu().numpy().copy()
    longer = replace(problem, budget=Budget(STEPS, TOLERANCE), show=None)
    rest, *_ = solve_one_level(longer, x, None)
    return normal_angles(before, rest.double().cpu().numpy(), triangles)
