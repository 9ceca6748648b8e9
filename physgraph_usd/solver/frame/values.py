"""Input, state and result of a frame's solve: immutable values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..contact.bodies import Touching
from ..level import Placed
from ..rigid import AT_REST, Rigid
from ..scene import GarmentFrame


@dataclass(frozen=True, eq=False)
class FrameInput:
    """Input of a group for one frame.

    Attributes:
        garments: The garments at this time code.
        at: The time code, for errors.
        touching: Surfaces within reach of the garments.
        moved: Largest motion of the surfaces since the last frame [m]; infinite if more than poses changed.
        walked: World positions of cages advanced from an earlier frame [m], shape (C, 3), for a cold start; or None.
        elapsed: Time since the start frame [s]; 0 for a cold start.
        given_up: As `FrameState.given_up`, for a start from the cage.
    """

    garments: Sequence[GarmentFrame]
    at: float | None = None
    touching: Sequence[Touching] = ()
    moved: float = np.inf
    walked: np.ndarray | None = None
    elapsed: float = 0.0
    given_up: Bool[Tensor, " coarse"] | None = None

    @property
    def rate(self) -> float:
        """Samples per second since the start frame; 24 where no time is known."""
        return 1.0 / (self.elapsed or 1.0 / 24.0)


@dataclass(frozen=True, eq=False)
class Cage:
    """Positions of a group's cages.

    Attributes:
        world: World positions [m], shape (C, 3), float64.
        origin: Mean of the world positions [m], shape (3,).
        points: Positions relative to the origin [m], in the scalar type of the solve.
    """

    world: np.ndarray
    origin: np.ndarray
    points: Float[Tensor, "coarse 3"]


@dataclass(frozen=True, eq=False)
class FrameState:
    """State passed from frame to frame.

    Attributes:
        coarse: Cage positions [m], world space.
        detail: Fine positions minus the smooth base [m], shape (V, 3).
        frames: Cage frames, columns are tangent, bitangent, normal, shape (C, 3, 3).
        held: Number of frames of a held pose.
        fine: Fine positions [m], world space, float64, to continue from; None before the first solve.
        clean: Whether nothing crosses and is given up, neither garments solved together nor bodies.
        inside: Mask of the vertices inside a body, shape (V,); None if none is.
        given_up: Mask of the pieces of the cage that are given up, shape (C,), bool; None for none.
        failures: Consecutive starts from the cage that did not cure an unsound result.
        wait: Frames until the next start from the cage.
    """

    coarse: Float[Tensor, "coarse 3"]
    detail: Float[Tensor, "vertices 3"]
    frames: Float[Tensor, "coarse 3 3"]
    held: int = 0
    fine: Float[Tensor, "vertices 3"] | None = None
    clean: bool = False
    inside: Bool[Tensor, " vertices"] | None = None
    given_up: Bool[Tensor, " coarse"] | None = None
    failures: int = 0
    wait: int = 0

    def carried(self, motion: Rigid) -> FrameState:
        """This state after a rigid motion."""
        if motion is AT_REST:
            return self
        turn = torch.as_tensor(motion.turn)

        def placed(x: Tensor) -> Tensor:
            return torch.as_tensor(motion(x.double().cpu().numpy())).to(x)

        return replace(
            self,
            coarse=placed(self.coarse),
            fine=None if self.fine is None else placed(self.fine),
            detail=self.detail @ turn.T.to(self.detail),
            frames=turn.to(self.frames) @ self.frames,
        )

    def about(self, origin: np.ndarray) -> Placed | None:
        """Fine positions relative to an origin [m], float64, or None before the first solve."""
        return None if self.fine is None else Placed(self.fine - torch.as_tensor(origin).to(self.fine))


@dataclass(frozen=True, eq=False)
class Solved:
    """One frame of a group.

    Attributes:
        points: World positions of each garment [m].
        state: FrameState for the next frame.
        telemetry: Plain values.
        crossing: For each garment, whether each vertex belongs to cloth that crosses cloth, shape (V,), bool.
    """

    points: list[np.ndarray]
    state: FrameState
    telemetry: dict[str, Any]
    crossing: list[np.ndarray]


def join(parts: Sequence[FrameState]) -> FrameState:
    """Join the states of several garments."""
    whole = (torch.cat([getattr(part, name) for part in parts]) for name in ("coarse", "detail", "frames"))
    fine = [part.fine for part in parts if part.fine is not None]
    walked = torch.cat(fine) if len(fine) == len(parts) else None
    clean = all(part.clean for part in parts)
    inside = None
    if any(part.inside is not None for part in parts):
        masks = [(part, torch.zeros(len(part.detail), dtype=torch.bool, device=part.detail.device)) for part in parts]
        inside = torch.cat([none if part.inside is None else part.inside for part, none in masks])
    failures, wait = (max(getattr(part, name) for part in parts) for name in ("failures", "wait"))
    lost = [torch.zeros(len(p.coarse), dtype=torch.bool) if p.given_up is None else p.given_up.cpu() for p in parts]
    given_up = torch.cat(lost).to(parts[0].coarse.device) if any(p.given_up is not None for p in parts) else None
    kept = {"fine": walked, "clean": clean, "failures": failures, "wait": wait}
    return FrameState(*whole, held=min(part.held for part in parts), inside=inside, given_up=given_up, **kept)


def split(state: FrameState, coarse: Sequence[slice], fine: Sequence[slice]) -> list[FrameState]:
    """The state of each garment of a group.

    Args:
        coarse: Cage vertices of each garment.
        fine: Fine vertices of each garment.
    """
    return [
        replace(
            state,
            coarse=state.coarse[c],
            given_up=None if state.given_up is None else state.given_up[c],
            detail=state.detail[f],
            frames=state.frames[c],
            fine=None if state.fine is None else state.fine[f],
            inside=None if state.inside is None else state.inside[f],
        )
        for c, f in zip(coarse, fine, strict=True)
    ]
