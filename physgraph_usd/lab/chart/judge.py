"""One ruler for every method: energy, strain and contact of fine positions, whoever computed them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ...solver.forces.base import ForceModule
from ...solver.frame.group import Group
from ...solver.frame.refiner import Refiner
from ...solver.resolution import edge_strain
from ...solver.scene import Frame


@dataclass(frozen=True)
class Judgement:
    """What fine positions are worth.

    Attributes:
        energies: Energy of each term [J].
        strain: Largest over the garments of the edges' 99th percentile.
        inside: Vertices inside closed bodies.
        percent: Their share of all vertices.
        deepest_mm: Depth of the deepest [mm].
        crossings: Edges of cloth through faces of bodies and the other way round.
        tangles: Edges of cloth through faces of cloth.
    """

    energies: dict[str, float]
    strain: float
    inside: int
    percent: float
    deepest_mm: float
    crossings: int
    tangles: int

    @property
    def energy(self) -> float:
        """The potential [J]."""
        return sum(self.energies.values())


def judge(refiner: Refiner, frame: Frame, points: Sequence[np.ndarray]) -> Judgement:
    """Judge a result by the full potential.

    Args:
        refiner: The solver, whose precision and whose settings of contact are the ruler's.
        frame: The frame.
        points: Fine world positions [m] of each garment.
    """
    energies: defaultdict[str, float] = defaultdict(float)
    strains, bodies, tangles, count = [0.0], list[dict[str, Any]](), 0, 0
    for part in refiner.parts_of(frame):
        group = refiner.group_of(part)
        own, strain, contact = _part(group, refiner, frame, part=part, points=[points[index] for index in part])
        for name, value in own.items():
            energies[name] += value
        strains.append(strain)
        bodies += [body["after"] for body in contact.get("bodies", {}).values()]
        tangles += contact.get("cloth", {}).get("after", {}).get("crossings", 0)
        count += group.levels[-1].vertex_count
    inside = sum(body["inside"] for body in bodies)
    return Judgement(
        energies=dict(energies),
        strain=max(strains),
        inside=inside,
        percent=100.0 * inside / max(count, 1),
        deepest_mm=max((body["deepest_mm"] for body in bodies), default=0.0),
        crossings=sum(body["crossings"] for body in bodies),
        tangles=tangles,
    )


def _part(
    group: Group, refiner: Refiner, frame: Frame, *, part: tuple[int, ...], points: Sequence[np.ndarray]
) -> tuple[dict[str, float], float, dict[str, Any]]:
    """Energies [J], strain and contact of garments that are solved together."""
    frames = [frame.garments[index] for index in part]
    module, contact, origin = group.potential(frames, refiner.touching(part, frame))
    finest = group.levels[-1]
    x = torch.as_tensor(np.concatenate(points) - origin, dtype=finest.dtype, device=finest.device)
    touched = () if contact is None else contact.at(finest).terms(x)[1]
    energies = ForceModule((*module.forces, *touched)).energies(x)
    return energies, edge_strain(finest, x)["p99"], {} if contact is None else contact.measure(x)[0]
