"""Forces: one file a term of the potential.

A new term is one file and one line here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..fabric import Fabric
from ..level import Level
from .base import Force
from .bending import Bending
from .gravity import Gravity
from .membrane import in_plane_terms


def elastic_terms(level: Level, fabrics: Sequence[Fabric], *, potential: str) -> tuple[Force, ...]:
    """The terms of the cloth itself.

    Args:
        level: The level.
        fabrics: Fabric of each garment.
        potential: "continuum" or "paper".
    """
    weft = None
    if any(fabric.weft_bend is not None for fabric in fabrics):
        weft = [fabric.bend if fabric.weft_bend is None else fabric.weft_bend for fabric in fabrics]
    bending = Bending(level, _each(level, [fabric.bend for fabric in fabrics]), weft=weft, potential=potential)
    return (*in_plane_terms(level, fabrics, potential=potential), bending)


def body_terms(level: Level, fabrics: Sequence[Fabric], *, gravity: np.ndarray, potential: str) -> tuple[Force, ...]:
    """The terms that act on the cloth's mass.

    Args:
        level: The level.
        fabrics: Fabric of each garment.
        gravity: [m/s^2], shape (3,).
        potential: "continuum" or "paper".
    """
    return (Gravity(level, _each(level, [fabric.density for fabric in fabrics]), gravity, potential=potential),)


def _each(level: Level, values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=level.dtype, device=level.device)
