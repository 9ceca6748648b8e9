"""Terms of one level for one set of materials, and the metric of the terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..fabric import Fabric
from ..forces import bending_term, body_terms
from ..forces.base import Assembly, Force, ForceModule, assembly_of
from ..forces.guide import Guide, GuideMap
from ..forces.membrane import in_plane_terms
from ..forces.tether import Tether
from ..integrate.base import ForceField, Preconditioner, System
from ..integrate.metric import Metric, laplacian
from ..integrate.saddle import facets
from ..level import Level
from ..mesh.recorded import Recordings
from ..mesh.stencil import Stencil, three_columns
from ..scene import Garment, GarmentFrame


@dataclass(frozen=True, eq=False)
class ElasticTerms:
    """Elastic terms of fabrics.

    Attributes:
        fabrics: The fabrics, with values of no effect on the terms set to constants.
        level: The level, with the rest lengths of these fabrics.
    """

    fabrics: tuple[Fabric, ...]
    level: Level
    terms: tuple[Force, ...]

    @cached_property
    def stiffness(self) -> Float[Tensor, " vertices"]:
        """Diagonal of the Hessian at rest [N/m]."""
        return ForceModule(self.terms).diagonal(self.level.rest)


@dataclass(frozen=True, eq=False)
class Lent:
    """Metric and elastic terms of the previous materials, for use with new materials.

    Attributes:
        metric: Rest Hessian.
        stiffness: Diagonal of the Hessian at rest [N/m], shape (V,).
        in_plane, bending: Elastic terms.
    """

    metric: Metric
    stiffness: Float[Tensor, " vertices"]
    in_plane: ElasticTerms
    bending: ElasticTerms


@dataclass(frozen=True, eq=False)
class LevelForces:
    """Terms acting on one level's cloth, frame after frame; each is built on first use.

    Attributes:
        plain: The level, with the rest lengths of its rest shape.
        guide_map: Averaging operator of the level.
        frames: Values of the garments at one time code.
        gravity: [m/s^2], shape (3,).
        lent: Metric of previous materials for `rough_metric`, and terms to reuse for equal fabrics; or None.
    """

    plain: Level
    guide_map: GuideMap
    garments: Sequence[Garment]
    frames: Sequence[GarmentFrame]
    gravity: np.ndarray
    lent: Lent | None = None

    @property
    def level(self) -> Level:
        """The level, with the cloth's rest lengths."""
        return self._in_plane.level

    @cached_property
    def terms(self) -> tuple[Force, ...]:
        """Stretch, membrane, bending and gravity."""
        body = body_terms(self.level, self._fabrics, gravity=self.gravity)
        return (*self._in_plane.terms, *self._bending.terms, *body)

    @cached_property
    def _in_plane(self) -> ElasticTerms:
        fabrics = tuple(replace(fabric, bend=0.0, weft_bend=None) for fabric in self._elastic)
        if self.lent is not None and self.lent.in_plane.fabrics == fabrics:
            return self.lent.in_plane
        level = self.plain.eased(fabrics)
        return ElasticTerms(fabrics, level, in_plane_terms(level, fabrics))

    @cached_property
    def _bending(self) -> ElasticTerms:
        fabrics = self._elastic
        if self.lent is not None and self.lent.bending.fabrics == fabrics:
            return self.lent.bending
        raised = [garment.raises_bending for garment in self.garments]
        return ElasticTerms(fabrics, self.plain, (bending_term(self.plain, fabrics, raised=raised),))

    @property
    def stretch(self) -> Float[Tensor, " vertices"]:
        """Diagonal of the Hessian of the terms in the plane at rest [N/m]."""
        return self._in_plane.stiffness

    @cached_property
    def guide(self) -> Guide:
        """The guide, without a target."""
        pairs = zip(self.frames, self.garments, strict=True)
        stiffness = np.concatenate([frame.guide * garment.guide_scale for frame, garment in pairs])
        return Guide(self.level, self.guide_map, torch.as_tensor(stiffness))

    @cached_property
    def metric(self) -> Metric:
        """The rest Hessian of all terms."""
        matrix = laplacian(self.plain.springs.cpu().numpy(), *self._module.rest_springs())
        last = None if self.lent is None else self.lent.metric
        return Metric(matrix, free=self.plain.free, dtype=self.plain.dtype, ups=self.plain.ups, last=last)

    @cached_property
    def rough_metric(self) -> Metric:
        """The lent metric, scaled to the new diagonal; `metric` without a lent one."""
        if self.lent is None or self._is_exact:
            return self.metric
        return self.lent.metric.scaled(self._stiffness / self.lent.stiffness)

    @cached_property
    def density(self) -> Float[Tensor, " garments"]:
        """Areal density of each garment [kg/m^2]."""
        density = [fabric.density for fabric in self._fabrics]
        return torch.tensor(density, dtype=self.level.dtype, device=self.level.device)

    @property
    def bends(self) -> bool:
        """Whether any cloth resists bending."""
        return any(fabric.bend > 0 for fabric in self._fabrics)

    @property
    def _fabrics(self) -> list[Fabric]:
        return [frame.fabric for frame in self.frames]

    @property
    def _elastic(self) -> tuple[Fabric, ...]:
        """The fabrics without the values that no elastic term depends on."""
        return tuple(replace(fabric, density=0.0, thickness=0.0) for fabric in self._fabrics)

    @cached_property
    def _stiffness(self) -> Float[Tensor, " vertices"]:
        """Diagonal of the Hessian at rest [N/m], positive."""
        tiny = torch.finfo(self.level.dtype).tiny
        remaining = [term for term in self._module.forces if term not in (*self._in_plane.terms, *self._bending.terms)]
        parts = [self._in_plane.stiffness, self._bending.stiffness, ForceModule(remaining).diagonal(self.level.rest)]
        return torch.stack(parts).sum(dim=0).clamp_min(tiny)

    @property
    def _module(self) -> ForceModule:
        """All terms, the guide without a target."""
        return ForceModule((*self.terms, self.guide))

    @property
    def _is_exact(self) -> bool:
        """Whether `metric` is known."""
        return "metric" in self.__dict__

    def lends(self) -> Lent | None:
        """Metric and terms for the next materials; the lent metric again, if none was built here."""
        if self._is_exact:
            return Lent(self.metric, self._stiffness, self._in_plane, self._bending)
        return None if self.lent is None else replace(self.lent, in_plane=self._in_plane, bending=self._bending)

    def without_facets(
        self, x: Float[Tensor, "vertices 3"], below: Float[Tensor, "coarse 3"], smooth: Stencil
    ) -> Float[Tensor, "vertices 3"]:
        """The move to remove a coarser mesh's facets from x, as in `facets` [m]; zero if nothing resists bending."""
        return facets(self.level, x, below, smooth.apply) if self.bends else torch.zeros_like(x)

    def module(self, coarse: Float[Tensor, "coarse 3"], frames: Sequence[GarmentFrame] = ()) -> ForceModule:
        """All terms of one frame.

        Args:
            coarse: The recentred coarse positions [m].
            frames: The garments in that frame, with the loads of inertia and air; () for none.
        """
        guide = self.guide.retarget(coarse, self._push(frames))
        return ForceModule((*self.terms, guide), self._recordings, self._assembly)

    def _push(self, frames: Sequence[GarmentFrame]) -> Float[Tensor, "coarse 3"] | None:
        """Load of the air, minus the acceleration that cloth feels times its density, at each cage vertex [N/m^2]."""
        if all(frame.acceleration is None and frame.load is None for frame in frames):
            return None
        loads = [np.zeros_like(frame.points) if frame.load is None else frame.load for frame in frames]
        accelerations = [
            np.zeros_like(frame.points) if frame.acceleration is None else frame.acceleration for frame in frames
        ]
        density = self._coarse_density
        load, acceleration = (torch.as_tensor(np.concatenate(fields)).to(density) for fields in (loads, accelerations))
        return load - density * acceleration

    @cached_property
    def _coarse_density(self) -> Float[Tensor, "coarse 3"]:
        """Areal density around each cage vertex [kg/m^2], in each of three columns."""
        density = self.density[self.level.vertex_garment.long()] * self.level.density_scale
        return self.guide_map.average.apply(three_columns(density))

    def system(
        self,
        module: ForceModule,
        tie: tuple[float, Float[Tensor, "vertices 3"]] | None = None,
        *,
        rough: bool = False,
    ) -> System:
        """The system of a frame without contact.

        Args:
            tie: Stiffness [1/s^2] and predicted positions [m] of a tether, or None.
            rough: Whether to use `rough_metric`.
        """
        metric = self.rough_metric if rough else self.metric
        return self.system_in(module if tie is None else module.joined_by([self.tether(*tie)]), metric)

    @cached_property
    def _assembly(self) -> Assembly | None:
        """The joint sum of the elastic elements."""
        return assembly_of(self.terms, self.level)

    @cached_property
    def _recordings(self) -> Recordings:
        """Sums of the terms, recorded on a card."""
        return Recordings()

    def system_in(self, field: ForceField, metric: Preconditioner | None = None) -> System:
        """The system of the level in any field, with the level's metric by default."""
        level, metric = self.level, self.metric if metric is None else metric
        return System(field, metric, free=level.free, spacing=level.spacing, level=level)

    def tether(self, stiffness: float, predicted: Float[Tensor, "vertices 3"]) -> Tether:
        """The tie to predicted positions [m], of stiffness [1/s^2]."""
        if stiffness not in self._tethers:
            self._tethers.clear()
            self._tethers[stiffness] = Tether(self.level, self.density, stiffness, predicted)
        return self._tethers[stiffness].towards(predicted)

    @cached_property
    def _tethers(self) -> dict[float, Tether]:
        """The last frame's tether by stiffness [1/s^2], whose weights are used again."""
        return {}


def blame(
    garments: Sequence[Garment],
    lasting: LevelForces,
    coarse: Float[Tensor, "coarse 3"],
    *,
    error: Exception,
    at: float | None,
) -> str:
    """Name prims, time code and the terms not finite at the upsampled cage."""
    energies = lasting.module(coarse).energies(lasting.level.base.apply(coarse))
    broken = [name for name, value in energies.items() if not np.isfinite(value)] or ["none at the input"]
    return f"{named(garments, at)}: {error}; terms that are not finite: {', '.join(broken)}"


def named(garments: Sequence[Garment], at: float | None) -> str:
    """Prims and time code, for errors."""
    return ", ".join(f"<{garment.path}>" for garment in garments) + ("" if at is None else f" at time code {at:g}")
