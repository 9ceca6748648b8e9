"""Where cloth may touch cloth: patches round the cage's vertices, their boxes and their normals.

Two patches that are no near neighbours can only touch where their boxes meet. Near neighbours can only touch where the
cloth turns over (`Clusters`). Everywhere else nothing is asked.
"""

# Warp's arrays are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.cluster_kernels import clusters_meet
from ..collide.clusters import Clusters
from ..level import Level


class Regions:
    """The patches of one level."""

    def __init__(self, cage: Level, level: Level, meets: np.ndarray) -> None:
        """Give each vertex to the cage vertex that weighs most in it.

        Args:
            cage: The cage.
            level: The level.
            meets: Which garments feel which, symmetric, shape (G, G), bool.
        """
        patch = np.asarray(level.from_coarse.argmax(axis=1)).ravel().astype(np.int64)
        self._patches = Clusters(level, patch, cage.vertex_count, meets=meets)

    def busy(self, x: Float[Tensor, "vertices 3"], reach: float) -> Bool[Tensor, " vertices"]:
        """Which vertices are in patches that may touch something.

        Args:
            x: Positions [m].
            reach: Distance under which two parts count as touching [m].
        """
        self._patches.move(x.to(torch.float32).contiguous())
        out = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        self._patches.run(clusters_meet, [wp.float32(reach), *self._patches.faces[:2], wp.from_torch(out)])
        return out
