"""Patches that are stepped as one: garments of one group, with the starts and the least energies of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...solver.frame.group import Group
from ...solver.frame.settings import SolveSettings
from ...solver.integrate import METHODS
from ...solver.level import refine_garments
from .bodies import with_bodies
from .patches import Patch
from .unroll import JointSystem


class Bundle:
    """Patches of equally many levels under the same gravity, on one device.

    Attributes:
        patches: The patches.
        levels: Number of levels, the cage's included.
        least: Least energy known of each patch at each level [J], shape (levels, patches), float64.
    """

    def __init__(self, patches: Sequence[Patch], *, device: str, through_forces: bool) -> None:
        """Build the group.

        Args:
            patches: The patches; all have the same number of levels and the same gravity.
            device: "cpu" or a CUDA device.
            through_forces: As in `JointSystem`.
        """
        self.patches = tuple(patches)
        garments, count = [patch.garment for patch in patches], patches[0].garment.level
        settings = SolveSettings(METHODS["quasi-newton"])
        chains = refine_garments(garments, [count] * len(garments))
        group = Group.of(garments, chains, patches[0].gravity, settings, dtype=torch.float32, device=device)
        plain, coarse = group.systems([patch.frame for patch in patches])
        systems = with_bodies(plain, group.levels, coarse, [patch.body for patch in patches])
        self.systems = [JointSystem(system, through_forces=through_forces) for system in systems]
        self.levels = len(systems)
        self._from_below = [level.from_below for level in group.levels]
        self._raw, self._solved = (
            [
                torch.as_tensor(np.concatenate([getattr(p, name)[k] for p in patches]), device=device)
                for k in range(self.levels)
            ]
            for name in ("raw", "solved")
        )
        self.least = torch.tensor([p.least for p in patches], dtype=torch.float64, device=device).T.contiguous()
        self._kept = [x.clone() for x in self._raw]
        self._known = torch.zeros((self.levels, len(patches)), dtype=torch.bool, device=device)

    def begin(self, index: int, dice: Callable[[], Float[Tensor, " patches"]], *, shares: Any) -> Tensor:
        """A start of each patch at a level [m]: the upsampled cage, a solved level below, or an earlier end.

        Args:
            index: The level.
            dice: Gives a number between 0 and 1 for each patch.
            shares: A `TrainConfig`, for its ``raw``, ``middle`` and ``own``.
        """
        owner = self.systems[index].owner
        first, second = dice(), dice()
        x = self._raw[index]
        below = self._from_below[index]
        if below is not None:
            mine = (self._known[index - 1] & (second < shares.own))[self.systems[index - 1].owner]
            lower = torch.where(mine.unsqueeze(1), self._kept[index - 1], self._solved[index - 1])
            x = torch.where((first >= shares.raw)[owner].unsqueeze(1), below.apply(lower), x)
        again = (first > 1.0 - shares.middle) & self._known[index]
        return torch.where(again[owner].unsqueeze(1), self._kept[index], x)

    def learn(self, index: int, energies: Float[Tensor, "steps patches"]) -> None:
        """Note energies that lie below the least known ones."""
        reached = torch.nan_to_num(energies.double(), nan=torch.inf).amin(dim=0)
        self.least[index] = torch.minimum(self.least[index], reached)

    def keep(self, index: int, x: Float[Tensor, "vertices 3"], better: Bool[Tensor, " patches"]) -> None:
        """Keep where patches that went downhill came to, as a start for later."""
        owner = self.systems[index].owner
        self._kept[index] = torch.where(better[owner].unsqueeze(1), x, self._kept[index])
        self._known[index] |= better

    def state(self) -> dict[str, Any]:
        """What training changed, for a checkpoint."""
        return {"kept": self._kept, "known": self._known, "least": self.least}

    def restore(self, state: dict[str, Any]) -> None:
        """Take back what `state` gave."""
        self._kept, self._known, self.least = state["kept"], state["known"], state["least"]


def deal(patches: Sequence[Patch], size: int) -> list[list[Patch]]:
    """Batches of at most so many patches that can be one `Bundle`, in the patches' order."""
    piles: dict[tuple[int, bool], list[Patch]] = {}
    for patch in patches:
        piles.setdefault((patch.garment.level, bool(patch.gravity.any())), []).append(patch)
    return [pile[k : k + size] for pile in piles.values() for k in range(0, len(pile), size)]
