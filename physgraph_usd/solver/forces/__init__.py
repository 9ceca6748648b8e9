"""Forces: one file per term of the potential.

A new term needs one file and one line here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..fabric import Fabric
from ..folds import carried_bend
from ..level import Level
from .base import Force
from .bending import Bending
from .gravity import Gravity
from .membrane import in_plane_terms


def elastic_terms(
    level: Level, fabrics: Sequence[Fabric], *, raised: Sequence[bool] | None = None
) -> tuple[Force, ...]:
    """The elastic terms of the cloth; arguments are those of `bending_term`."""
    return (*in_plane_terms(level, fabrics), bending_term(level, fabrics, raised=raised))


def bending_term(level: Level, fabrics: Sequence[Fabric], *, raised: Sequence[bool] | None = None) -> Force:
    """The bending of the cloth.

    Args:
        raised: For each garment, whether bending stiffness is raised at edges too long for the garment's folds; None
            for no garment.
    """
    weft = None
    if any(fabric.weft_bend is not None for fabric in fabrics):
        weft = [fabric.bend if fabric.weft_bend is None else fabric.weft_bend for fabric in fabrics]
    least = None if raised is None else _carried(level, fabrics, raised)
    return Bending(level, _each(level, [fabric.bend for fabric in fabrics]), weft=weft, least=least)


def body_terms(level: Level, fabrics: Sequence[Fabric], *, gravity: np.ndarray) -> tuple[Force, ...]:
    """The terms proportional to the cloth's mass.

    Args:
        gravity: [m/s^2], shape (3,).
    """
    return (Gravity(level, _each(level, [fabric.density for fabric in fabrics]), gravity),)


def _carried(level: Level, fabrics: Sequence[Fabric], raised: Sequence[bool]) -> Tensor:
    """Least bending stiffness of the hinges of raised garments [N m], shape (H,); 0 for no bound."""
    owner, painted = level.hinge_garment.long(), level.spring_scale[level.hinge_spring.long()]
    edge = level.spacing[level.hinges[:, :2].long()].mean(dim=1)
    least = torch.zeros_like(edge)
    for index, (fabric, wanted) in enumerate(zip(fabrics, raised, strict=True)):
        if wanted and fabric.bend > 0:
            least = torch.where(owner == index, carried_bend(fabric, edge) * painted, least)
    return least


def _each(level: Level, values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=level.dtype, device=level.device)
