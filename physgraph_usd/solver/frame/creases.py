"""Crease memory: hinges that stay bent come to rest where they are bent, so that worn cloth does not iron itself.

    c <- c + (1 - exp(-dt / tau)) (wrap(theta - theta0) - c),   a hinge rests at theta0 + s c

| symbol | here | meaning |
|---|---|---|
| c | ``bent`` | remembered bend of a hinge beyond its rest shape's [rad] |
| theta | `Level.angles` | its angle in the frame that this one starts from [rad] |
| dt | ``elapsed`` | time since that frame [s] |
| tau | `Fabric.crease_time` | [s] |
| s | `SHARE` | part of the bend that friction between yarns holds |

This is the standard linear solid in bending: a spring beside a spring and a dashpot in series. A pose that is held
bends against 1 - s of the stiffness in the end, and a crease in cloth that nothing pulls fades with tau / (1 - s). The
memory stays between the angles that the hinge has had, and is the same throughout a frame, so a frame's energy has the
bounds that it has without.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from .start import SLOWER, SLOWEST
from .values import FrameInput, State

SHARE = 0.5
"""Part of a bend that stays, a round number: plain cotton that was folded flat opens by about half in tests of crease
recovery (ISO 2313), other cloth by more."""
SET = 4.0
"""Crease times after which cloth in a held pose rests: a memory is then within 2% of the angle that it follows."""


@dataclass(frozen=True, eq=False)
class Creases:
    """Creases of the finest level in one frame.

    Attributes:
        bent: Remembered bends [rad], shape (H,).
        rest_angle: Angles at which hinges rest therefore [rad], shape (H,).
        pace: Part of its usual pace at which cloth in a held pose slows down, so that it rests when creases have set.
    """

    bent: Float[Tensor, " hinges"]
    rest_angle: Float[Tensor, " hinges"]
    pace: float

    def split(self, level: Level) -> tuple[Tensor | None, ...]:
        """The remembered bends of each garment of a level [rad]."""
        return torch.split(self.bent, _hinge_counts(level))


def keeps_creases(frame: FrameInput) -> bool:
    """Whether some fabric keeps creases."""
    return any(each.fabric.crease_time > 0 for each in frame.garments)


def creases_of(level: Level, frame: FrameInput, last: State | None) -> Creases | None:
    """Creases of a frame, by where the cloth was in the one that it starts from; None where no fabric keeps any.

    Args:
        level: The finest level.
        frame: The frame.
        last: What the frame that it starts from left, or None for a cold start.
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
    pace = math.log(SLOWEST, SLOWER) * max(0.0, *passed) / (SET * max(times))
    return Creases(now, level.rest_angle + SHARE * now, min(pace, 1.0))


def _rate(time: float, elapsed: float) -> float:
    """Part of the way to its angle that a memory goes."""
    return -math.expm1(-max(elapsed, 0.0) / time) if time > 0 else 0.0


def _wrapped(angle: Float[Tensor, " hinges"]) -> Float[Tensor, " hinges"]:
    """Angles less whole turns, in [-pi, pi]."""
    return angle - 2.0 * math.pi * torch.round(angle / (2.0 * math.pi))


def _hinge_counts(level: Level) -> list[int]:
    """Number of hinges of each garment, in whose order they lie."""
    return torch.bincount(level.hinge_garment.long(), minlength=len(level.spans)).tolist()
