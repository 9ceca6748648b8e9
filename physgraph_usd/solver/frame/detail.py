"""Carries the detail of one frame to the next in the moving frames of the coarse surface, and tells when not to.

Detail is x - S x_c, with S the smooth map from the cage. Each cage vertex has an orthonormal frame made of its normal
and of a tangent that is a fixed linear combination of the triangles' edges, so frames turn with the surface. What
interpolates to the fine vertices is how frames have turned: tangents of neighbours may point anywhere, also against one
another, and have no mean.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..mesh.stencil import Stencil, add_at
from ..mesh.tangents import mean_edge, orthonormal, tangent_operator
from .values import State


class MovingFrames:
    """The frames of a cage and the way from them to the fine vertices.

    Attributes:
        edge: Mean edge of the cage [m].
    """

    def __init__(self, cage: Level, finest: Level) -> None:
        """Fix each cage vertex's tangent in the rest shape."""
        self._level, self._triangles = finest, cage.triangles.long()
        triangles, rest = cage.triangles.cpu().numpy(), cage.rest.double().cpu().numpy()
        self._tangent = Stencil(tangent_operator(triangles, rest), dtype=finest.dtype, device=finest.device)
        self.edge = mean_edge(triangles, rest)

    def frames(self, coarse: Float[Tensor, "coarse 3"]) -> Float[Tensor, "coarse 3 3"]:
        """Orthonormal frames at the cage vertices; columns are tangent, bitangent, normal."""
        corner = coarse[self._triangles]
        area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal = add_at(torch.zeros_like(coarse), self._triangles.T.reshape(-1), area.repeat(3, 1))
        return orthonormal(normal, self._tangent.apply(coarse))

    def store(self, coarse: Float[Tensor, "coarse 3"], fine: Float[Tensor, "vertices 3"]) -> State:
        """Keep a solved frame's detail."""
        return State(coarse, fine - self._level.smooth_base.apply(coarse), self.frames(coarse))

    def predict(
        self, kept: State, coarse: Float[Tensor, "coarse 3"]
    ) -> tuple[Float[Tensor, "vertices 3"], float, float]:
        """Carry detail to new cage positions.

        Returns:
            Predicted fine positions [m], the RMS motion of the cage in mean cage edges, and its RMS turn [rad].
        """
        frames = self.frames(coarse)
        moved = torch.einsum("vij,vj->vi", self._turned(kept.frames, frames), kept.detail)
        motion = float((coarse - kept.coarse).square().sum(dim=1).mean().sqrt()) / self.edge
        cosine = (torch.einsum("cij,cij->c", frames, kept.frames) - 1.0) / 2.0
        turn = float(torch.arccos(cosine.clamp(-1.0, 1.0)).square().mean().sqrt())
        return self._level.smooth_base.apply(coarse) + moved, motion, turn

    def scaled(
        self, coarse: Float[Tensor, "coarse 3"], fine: Float[Tensor, "vertices 3"], gain: np.ndarray
    ) -> Float[Tensor, "vertices 3"]:
        """Scale the detail of free vertices by a gain at each cage vertex, shape (C,); 1 everywhere changes nothing."""
        if np.all(gain == 1.0):
            return fine
        more = torch.as_tensor(self._level.from_coarse @ gain).to(fine).unsqueeze(1)
        smooth = self._level.smooth_base.apply(coarse)
        return torch.where(self._level.free, smooth + more * (fine - smooth), fine)

    def _turned(
        self, before: Float[Tensor, "coarse 3 3"], after: Float[Tensor, "coarse 3 3"]
    ) -> Float[Tensor, "vertices 3 3"]:
        """How cage frames have turned, interpolated to the fine vertices; not at all where either is no frame."""
        turned = torch.einsum("cij,ckj->cik", after, before)
        whole = (torch.linalg.det(turned) > 0.5).unsqueeze(1).unsqueeze(2)
        turned = torch.where(whole, turned, torch.eye(3, dtype=turned.dtype, device=turned.device))
        first, last = (self._level.base.apply(turned[:, :, column].contiguous()) for column in (0, 2))
        return orthonormal(last, first)
