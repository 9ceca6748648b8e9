"""Crease memory: hinges that stay bent shift their rest angle towards the bend, so worn cloth does not iron itself.

    c <- c + (1 - exp(-dt / tau)) (wrap(theta - theta0) - c),   a hinge rests at theta0 + s c

| symbol | here | meaning |
|---|---|---|
| c | ``bent`` | remembered bend of a hinge beyond the rest shape's angle [rad] |
| theta | `Level.angles` | angle in the frame used as start [rad] |
| dt | ``elapsed`` | time since the start frame [s] |
| tau | `Fabric.crease_time` | [s] |
| s | `SHARE` | fraction of the bend held by friction between yarns |

This is the standard linear solid in bending: a spring parallel to a spring and a dashpot in series. A held pose finally
bends against 1 - s of the stiffness, and a crease in unloaded cloth fades with tau / (1 - s). The memory stays within
the range of past angles, and is constant during a frame, so a frame's energy has the same bounds as without memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from .values import FrameInput, FrameState

SHARE = 0.5
"""Fraction of a bend remaining, a round number: flat-folded plain cotton opens by about half in tests of crease
recovery (ISO 2313), other fabrics by more."""
SET = 4.0
"""Crease times until cloth in a held pose rests: the memory is then within 2% of its target angle."""


@dataclass(frozen=True, eq=False)
class Creases:
    """Creases of the finest level in one frame.

    Attributes:
        bent: Remembered bends [rad], shape (H,).
        rest_angle: Resulting rest angles of the hinges [rad], shape (H,).
        pace: As for `start_of`: cloth rests once creases have set.
    """

    bent: Float[Tensor, " hinges"]
    rest_angle: Float[Tensor, " hinges"]
    pace: float

    def split(self, level: Level) -> tuple[Tensor | None, ...]:
        """The remembered bends of each garment of a level [rad]."""
        return torch.split(self.bent, _hinge_counts(level))


def keeps_creases(frame: FrameInput) -> bool:
    """Whether any fabric keeps creases."""
    return any(each.fabric.crease_time > 0 for each in frame.garments)


def creases_of(level: Level, frame: FrameInput, last: FrameState | None) -> Creases | None:
    """Creases of a frame, from the cloth's angles in the start frame; None if no fabric keeps creases.

    Args:
        level: The finest level.
        last: State left by the start frame, or None for a cold start.
    """
    if last is None or last.fine is None or not keeps_creases(frame):
        return None
    times = [each.fabric.crease_time for each in frame.garments]
    parts = zip(last.bent or [None] * len(times), _hinge_counts(level), strict=True)
    known = torch.cat([level.rest_angle.new_zeros(count) if each is None else each for each, count in parts])
    passed = frame.elapsed or [0.0] * len(times)
    rates = known.new_tensor([_rate(*each) for each in zip(times, passed, strict=True)])
    keeps, owner = known.new_tensor([float(each > 0) for each in times]), level.hinge_garment.long()
    before = (last.fine - last.fine.mean(dim=0)).to(known)
    angle = _wrapped(level.angles(before) - level.rest_angle)
    now = keeps[owner] * (known + rates[owner] * (angle - known))
    pace = max(0.0, *passed) / (SET * max(times))
    return Creases(now, level.rest_angle + SHARE * now, min(pace, 1.0))


def _rate(time: float, elapsed: float) -> float:
    """Relaxation of a memory towards its target angle, as a fraction."""
    return -math.expm1(-max(elapsed, 0.0) / time) if time > 0 else 0.0


def _wrapped(angle: Float[Tensor, " hinges"]) -> Float[Tensor, " hinges"]:
    """Angles minus whole turns, in [-pi, pi]."""
    return angle - 2.0 * math.pi * torch.round(angle / (2.0 * math.pi))


def _hinge_counts(level: Level) -> list[int]:
    """Number of hinges of each garment; hinges are sorted by garment."""
    return torch.bincount(level.hinge_garment.long(), minlength=len(level.spans)).tolist()
