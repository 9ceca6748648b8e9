"""Folds that a mesh can carry: the least bending stiffness whose folds its edges resolve.

A sheet of stretch stiffness Y and bending stiffness D, compressed by e, gains Y e a^2 k^2 / 4 an area by a fold of
amplitude a and wavenumber k, pays D a^2 k^4 / 4 for bending it and K a^2 / 4 to a foundation K [N/m^3], as the guide is
to folds longer than the cage's edges. Two wavelengths follow.

- Settled: a fold takes up a given length, a^2 k^2 constant, so D k^2 + K / k^2 is least: 2 pi (D / K)^(1/4). With the
  guide of 2,000 N/m^3 that is 44 mm in jersey, 36 in silk, 75 in denim: five edges at one or two subdivisions. And
  folds shorter than the cage's edges feel no guide: they would grow longer still.
- Beginning: what gains at all has D k^2 < Y e, and waves of 2 pi sqrt(D / (Y e)) and longer grow. At e = 0.1% these
  have five edges of 6 mm in silk, 8 in denim, 16 in jersey; at 1% of 2, 2.5 and 5 mm.

The second governs what a mesh shows: a few steps from a cage leave the folds about as they began, and stiff cloth
(denim) begins in shorter ones than soft (jersey), though settled in 300 steps it has the smoother folds. So D is raised
to Y e (5 h / 2 pi)^2 on edges of h. The strain e is the least at which a start lets cloth buckle at all: it asks for
the least stiffness, so that coarse levels keep the folds of settled cloth.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

from jaxtyping import Float

from .fabric import Fabric

if TYPE_CHECKING:
    from torch import Tensor

EDGES_PER_WAVE = 5.0
FOLDING = 1e-3
"""Compression at which cloth begins to fold; smaller compressions stay in its plane."""
Edge = TypeVar("Edge", float, "Float[Tensor, ' hinges']")


def carried_bend(fabric: Fabric, edge: Edge) -> Edge:
    """The least bending stiffness [N m] whose folds begin at five edges, Y e (5 h / 2 pi)^2.

    Args:
        fabric: The fabric; Y is the stiffer of its warp's and weft's.
        edge: Edge lengths h [m].
    """
    stiffest = max(fabric.stretch, fabric.weft_stretch or 0.0)
    return stiffest * FOLDING * (edge * EDGES_PER_WAVE / (2.0 * math.pi)) ** 2


def raised_by(fabric: Fabric, edge: float) -> float:
    """Factor of the bending stiffness on edges of a length [m]; 1 on edges short enough for the fabric's folds."""
    return max(1.0, carried_bend(fabric, edge) / fabric.bend) if fabric.bend > 0 else 1.0
