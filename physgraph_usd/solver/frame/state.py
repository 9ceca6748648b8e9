"""The state of refined cloth after a frame: an immutable value, from which the next frame starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..level import Placed
from ..rigid import AT_REST, Rigid


@dataclass(frozen=True, eq=False)
class Curvature:
    """Curvature information of a frame's descent, for the next frame.

    Attributes:
        memory: The integrator's memory, for all garments solved together.
        vertices: Fine vertices of these garments.
        turn: Rigid rotation of the cloth since the descent, shape (3, 3).
    """

    memory: Any
    vertices: int
    turn: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True, eq=False)
class State:
    """Refined cloth after a frame, of one garment or of several solved together.

    Attributes:
        points: The visible result, world positions [m], shape (V, 3), with vertices that the solve does not move.
        crossing: Whether each vertex belongs to cloth that crosses cloth, shape (V,).
        coarse: Cage positions [m], world space, float64, shape (C, 3).
        fine: Fine positions [m], world space, float64, shape (V, 3).
        inside: Mask of the vertices inside a body, shape (V,), bool.
        given_up: Mask of the pieces of the cage that are given up, shape (C,), bool.
        following: Frames for which each cage vertex's cloth still follows the subdivided cage, as in `no_worse`.
        still_frames: Number of frames of a held pose.
        clean: Whether nothing crosses and is given up, neither garments solved together nor bodies.
        failures: Consecutive starts from the cage that did not cure an unsound result.
        wait: Frames until the next start from the cage.
        curvature: Of the last frame's descent, the same object for all garments solved together; None without.
    """

    points: Float[np.ndarray, "vertices 3"]
    crossing: Bool[np.ndarray, " vertices"]
    coarse: Float[Tensor, "coarse 3"]
    fine: Float[Tensor, "vertices 3"]
    inside: Bool[Tensor, " vertices"]
    given_up: Bool[Tensor, " coarse"]
    following: Int[Tensor, " coarse"]
    still_frames: int = 0
    clean: bool = False
    failures: int = 0
    wait: int = 0
    curvature: Curvature | None = None

    def carried(self, motion: Rigid) -> State:
        """This state after a rigid motion of everything but the visible result."""
        if motion is AT_REST:
            return self
        coarse, fine = (torch.as_tensor(motion(x.cpu().numpy())).to(x) for x in (self.coarse, self.fine))
        curvature = self.curvature
        turned = None if curvature is None else replace(curvature, turn=motion.turn @ curvature.turn)
        return replace(self, coarse=coarse, fine=fine, curvature=turned)

    def about(self, origin: np.ndarray) -> tuple[Float[Tensor, "coarse 3"], Placed]:
        """Cage and fine positions relative to an origin [m], float64."""
        coarse, fine = (x - torch.as_tensor(origin).to(x) for x in (self.coarse, self.fine))
        return coarse, Placed(fine)


_COARSE, _FINE = ("coarse", "given_up", "following"), ("fine", "inside", "points", "crossing")
"""Fields of `State` with a row for each vertex of the cage, and of the finest level."""


def _together(fields: Sequence[Any]) -> Any:
    return np.concatenate(fields) if isinstance(fields[0], np.ndarray) else torch.cat(list(fields))


def join(parts: Sequence[State]) -> State:
    """Join the states of several garments."""
    if len(parts) == 1:
        return parts[0]
    curvature = parts[0].curvature if all(part.curvature is parts[0].curvature for part in parts) else None
    return State(
        **{name: _together([getattr(part, name) for part in parts]) for name in (*_COARSE, *_FINE)},
        still_frames=min(part.still_frames for part in parts),
        clean=all(part.clean for part in parts),
        failures=max(part.failures for part in parts),
        wait=max(part.wait for part in parts),
        curvature=curvature,
    )


def split(state: State, coarse: Sequence[slice], fine: Sequence[slice]) -> list[State]:
    """The state of each garment of a group.

    Args:
        coarse: Cage vertices of each garment.
        fine: Fine vertices of each garment.
    """
    return [
        replace(
            state,
            **{name: getattr(state, name)[c] for name in _COARSE},
            **{name: getattr(state, name)[f] for name in _FINE},
        )
        for c, f in zip(coarse, fine, strict=True)
    ]
