"""Writes refined garments into one new layer, frame after frame.

The layer holds overs only (and, in sibling mode, the refined siblings). Topology-dependent properties are authored
once, when the writer opens; points, normals, extent and velocities per time code. `stream` makes the write atomic.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import LayerError
from ...solver.mesh.subdivide import Refinement
from ...solver.scene import GarmentResult, Result
from .. import provenance
from ..check.validate import check_layer
from ..files import check_targets, files_of
from ..lookup import check_known
from ..mesh.shell import Shell
from ..read.absence import named_times
from ..read.reader import Shot
from ..stage import GarmentSource, Notice, at_time, authored_topology, pxr_errors, value_at
from ..times import within
from . import overs
from .attribute_rules import notes_of
from .normals import VertexNormals
from .overs import author_used_values
from .primvars import FineMap, carry_primvars, carry_subsets
from .stream import LayerStream
from .target_tracks import TargetTracks
from .track import BoundsAbove, HeatTrack, PointTrack
from .twins import keep_twins

MODES = ("over", "sibling")
SCHEMES = ("keep", "none")
"""Subdivision scheme of the fine meshes: that of the cage, or none."""


class LayerWriter:
    """One refined layer; a context manager. After an error no file is left under the final name.

    Attributes:
        notices: Properties hidden, emptied or changed, with the reason.
        notes: Attributes that a render takes from elsewhere.
    """

    def __init__(
        self,
        shot: Shot,
        refinements: Sequence[Sequence[Refinement]],
        out: Path | None,
        *,
        mode: str = "over",
        scheme: str = "keep",
        velocities: bool = False,
        provenance: Mapping[str, Any] | None = None,
        overwrite: bool = False,
        times: Sequence[float] | None = None,
    ) -> None:
        """Start the layer and author all static opinions.

        Args:
            shot: The opened shot; never edited.
            refinements: Per garment, coarse to fine; empty to keep the cage.
            out: Layer to write, ``.usdc``, ``.usda`` or ``.usd``; None for an in-memory layer.
            mode: ``over`` replaces the garment; ``sibling`` adds ``<name>_refined`` and makes the garment its proxy.
            scheme: ``keep`` the cage's subdivision scheme, creases and corners, or ``none``: polygons with normals.
            velocities: Whether to author velocities, by finite differences, even for garments without velocities.
            provenance: Further entries of the record in ``customLayerData["physgraph"]``.
            overwrite: Whether an existing file may be replaced.
            times: Time codes to be written, if not all of the shot; garments without a sample at any of the time codes
                are left out of the layer.

        Raises:
            UsageError: The mode or scheme is unknown, or the file exists or belongs to the shot.
            LayerError: The layer cannot be written.
        """
        check_known("mode", mode, MODES)
        check_known("scheme", scheme, SCHEMES)
        if len(refinements) != len(shot.scene.garments):
            raise LayerError(f"{len(refinements)} refinements for {len(shot.scene.garments)} garments")
        if out is not None:
            check_targets([("the layer", out)], files_of(shot.path))
        self._shot, self._mode, self._time = shot, mode, -np.inf
        self._velocities, self._keep_scheme, self._open = velocities, scheme == "keep", True
        self._record = {"mode": mode} | dict(provenance or {})
        self._times, self._meshes, self._bound = times, dict[int, _RefinedMesh](), dict[int, TargetTracks]()
        self.notices: list[Notice] = []
        self.notes: list[Notice] = []
        with ExitStack() as stack:
            self._stream = stack.enter_context(LayerStream(out, overwrite=overwrite))
            self._author_still(refinements)
            self._cleanup = stack.pop_all()

    def _author_still(self, refinements: Sequence[Sequence[Refinement]]) -> None:
        """Author metadata and the topology-dependent opinions of each garment."""
        times = self._times or self._shot.scene.times
        span = (times[0], times[-1]) if times else None
        writes_all = self._times is None and not any(source.left_out for source in self._shot.sources)
        provenance.copy_stage_metadata(self._shot.stage, self._stream.layer, span=span, whole=writes_all)
        stream, shot = self._stream, self._shot
        options, velocities = {"sibling": self._mode == "sibling", "keep": self._keep_scheme}, self._velocities
        with pxr_errors(f"cannot read {self._shot.path}"):
            for index in _garments_in(self._shot, self._times):
                steps, (absent, outside) = refinements[index], self._absent_and_outside(self._shot.sources[index])
                mesh = _RefinedMesh(
                    stream, shot, index, steps=steps, absent=absent, outside=outside, velocities=velocities, **options
                )
                bound = TargetTracks(
                    stream, shot, index, steps=steps, absent=absent, outside=outside, velocities=velocities
                )
                self._meshes[index] = mesh
                self._bound[index] = bound
                self.notices += [*mesh.notices, *bound.notices]
                self.notes += mesh.notes

    def _absent_and_outside(self, source: GarmentSource) -> tuple[Sequence[float], Sequence[float]]:
        """Time codes of a blocked garment, and time codes outside the layer's range, ascending."""
        span = None if self._times is None else (self._times[0], self._times[-1])
        outside = {*source.times, *source.left_out}.difference(within(source.times, span))
        return within(source.absent, span), sorted(outside)

    def write(self, result: Result, *, cuts: Collection[int] = ()) -> None:
        """Write one time code; garments without points have no sample there.

        Args:
            result: The result at a time code later than the last; of time None once, for a shot without samples.
            cuts: Numbers of the garments whose cloth jumps here from the previous sample.

        Raises:
            LayerError: A point is not finite, counts do not match, times do not ascend, or the disk is full.
        """
        if not self._open:
            raise LayerError(f"{self._stream.target} is closed; nothing more can be written to it")
        time = result.time
        if self._time == np.inf or (time is not None and time <= self._time):
            raise LayerError(f"time code {time} does not come after {self._time:g}; write times in ascending order")
        if len(result.garments) != len(self._shot.sources):
            raise LayerError(f"results of {len(result.garments)} garments for {len(self._shot.sources)} garments")
        for index, mesh in self._meshes.items():
            mesh.check(result.garments[index], time)
        if self._time == -np.inf:
            frame = self._shot.frame(time)
            for index in self._meshes:
                source, garment = self._shot.sources[index], self._shot.scene.garments[index]
                author_used_values(self._stream, source, garment, frame.garments[index])
        for index, mesh in self._meshes.items():
            mesh.write(time, result.garments[index], cut=index in cuts)
            self._bound[index].write(time, result.garments[index], cut=index in cuts)
        self._time = np.inf if time is None else time

    @property
    def targets(self) -> list[Sdf.Path]:
        """Path of each garment's fine mesh."""
        return [mesh.target for mesh in self._meshes.values()]

    def close(self, *, lacking: Mapping[str, Any] | None = None) -> Path | None:
        """Finish, validate and move the layer to its final path; returns the path, or None for an in-memory layer.

        Args:
            lacking: Entries of the record about missing or unsettled frames.

        Raises:
            LayerError: The layer is invalid or cannot be written.
        """
        if self._time == -np.inf:
            raise LayerError(f"no time code was written to {self._stream.target}")
        for mesh in self._meshes.values():
            self.notices += mesh.finish()
        for bound in self._bound.values():
            bound.finish()
        self._keep_twins()
        sources = {str(mesh.target): self._shot.sources[index] for index, mesh in self._meshes.items()}
        facts = _facts(self._shot, sources, self._stream.target)
        facts["bound"] = [str(path) for bound in self._bound.values() for path in bound.paths] or None
        if self._times is not None:
            count = len(self._shot.scene.times)
            remainder = f"{count - len(self._times)} of the shot's {count} frames"
            facts["left_out"] = {str(path): remainder for path in self.targets}
        provenance.author_record(self._stream.layer, facts | self._record | dict(lacking or {}))
        self._stream.flush()
        self._check_written()
        path = self._stream.commit()
        self._open = False
        self._cleanup.close()
        return path

    def _keep_twins(self) -> None:
        """Keep meshes that are composed from refined prims, and not refined themselves, as they are in the shot."""
        followed = [path for bound in self._bound.values() for path in bound.paths]
        coarse = [self._shot.sources[index].path for index in self._meshes]
        with pxr_errors(f"cannot read {self._shot.path}"):
            for path in (*coarse, *followed):
                self.notes += keep_twins(self._stream, self._shot, path)

    def _check_written(self) -> None:
        """Validate the first, middle and last sample."""
        with pxr_errors(f"cannot read {self._shot.path} under the layer written", LayerError):
            problems = check_layer(self._stream.layer, self._shot.view, samples=3)
        errors = [problem for problem in problems if problem.severity == "error"]
        if errors:
            raise LayerError(f"the layer written is invalid ({len(errors)} problems); first: {errors[0]}")

    @property
    def layer(self) -> Sdf.Layer:
        """The layer being written or in memory; LayerError for a closed file."""
        return self._stream.layer

    def __enter__(self) -> LayerWriter:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close after success; after an error remove the written parts."""
        try:
            if error is None and self._open:
                self.close()
        finally:
            self._open = False
            self._cleanup.close()


class _RefinedMesh:
    """The refined mesh of one garment during writing.

    Attributes:
        target: Prim path of the fine mesh.
        notices: Properties hidden, emptied or changed, with the reason.
        notes: Attributes that a render takes from elsewhere.
    """

    def __init__(
        self,
        stream: LayerStream,
        shot: Shot,
        index: int,
        *,
        steps: Sequence[Refinement],
        absent: Sequence[float],
        outside: Sequence[float],
        sibling: bool,
        keep: bool,
        velocities: bool,
    ) -> None:
        """Author the defaults of a garment, by number and refinements, coarse to fine, and start its tracks.

        The garment is blocked at the absent time codes and held at those outside. With ``keep`` the fine mesh has the
        cage's subdivision scheme.
        """
        source, times = shot.sources[index], shot.scene.times
        prim, span = shot.stage.GetPrimAtPath(source.path), (times[0], times[-1]) if times else None
        counts, indices = authored_topology(prim)
        steps, self._weld = source.weld.subdivided(len(steps))
        sheet, sides = steps[-1].mesh if steps else source.weld.apart, self._weld.sides
        self._shell = Shell.of(sheet, self._weld.number) if source.shell and self._weld.across is None else None
        fine = FineMap(source.weld.apart, steps, counts, source.kept_faces, indices=indices, shell=self._shell)
        self.notices = overs.open_instances(stream, source.path, source.instance_roots)
        self.target = target = overs.make_sibling(stream, prim) if sibling else source.path
        scheme = overs.scheme_of(prim, fine.fine, keep=keep)
        polygonal = scheme == UsdGeom.Tokens.none
        garment = shot.scene.garments[index]
        sharp = source.weld.sharp_edges(garment.rest, garment.closed)
        overs.author_topology(stream, target, prim, fine, scheme=scheme, sharp=(sharp, source.weld.torn))
        self.notes = notes_of(prim, None if polygonal else fine.levels)
        overs.author_unskinned(stream, target, prim, skinned=source.skinned)
        self.notices += carry_primvars(stream, target, prim, fine, span=span)
        self.notices += carry_subsets(stream, target, prim, fine, span=span)
        self.notices += overs.author_rest_points(stream, target, prim, fine)
        is_left_handed = UsdGeom.Mesh(prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        still = source.still or self._shell is not None
        rest = None if still else fine.vectors(shot.default_points(source.path))
        self._sheet_normals = VertexNormals(sheet, left_handed=is_left_handed, welded=sides)
        normals, self._middle_normals = self._sheet_normals, VertexNormals(self._weld.mesh)
        if self._shell is not None:
            normals = VertexNormals(
                fine.fine, left_handed=is_left_handed, welded=np.concatenate([sides, sides + len(sides)])
            )
        rate = shot.stage.GetTimeCodesPerSecond() if velocities or source.velocities else None
        self.notices += overs.speed_notices(prim, written=rate is not None)
        own, drawn = partial(_own_velocities, prim, fine), normals if polygonal else None
        self._track = PointTrack(
            stream, target, drawn, rest=rest, still=source.still, rate=rate, own=own, absent=absent, outside=outside
        )
        self._heat = HeatTrack(stream, target, self._weld.mesh.vertex_count, still=source.still)
        purpose = "render" if sibling else UsdGeom.Imageable(prim).ComputePurpose()
        self._bounds = BoundsAbove(stream, shot.stage, source.path, purpose=purpose)
        self._shot, self._index = shot, index

    def write(self, time: float | None, garment: GarmentResult, *, cut: bool) -> None:
        """Write the garment's result at one time code, if it has points; ``cut`` as in `PointTrack.write`."""
        if (points := garment.points) is None:
            return
        weld, to_world = self._weld, self._shot.to_metres(self._index, time)
        across = 0.0 if weld.across is None else weld.across[:, None] * weld.split(self._middle_normals(points))
        points = weld.split(points) + across
        maps = {name: self._weld.split(values) for name, values in garment.heat.items()}
        if self._shell is not None:
            thickness = self._shot.sources[self._index].shell * np.sign(np.linalg.det(to_world[:3, :3]))
            points = self._shell.thickened(points, self._sheet_normals(points), thickness)
            maps = {name: values[self._shell.vertex] for name, values in maps.items()}
        self._track.write(time, points, to_world, changed=not garment.reused, cut=cut)
        self._bounds.write(time, self._track.box)
        self._heat.write(time, maps)

    def check(self, garment: GarmentResult, time: float | None) -> None:
        """Refuse points and heat maps of the wrong shape."""
        points, count = garment.points, self._weld.mesh.vertex_count
        if points is not None and points.shape != (count, 3):
            location = f"<{self.target}>" + at_time(time)
            raise LayerError(f"{location}: points have shape {points.shape}; the fine mesh has {count} vertices")
        self._heat.check(garment.heat, time)

    def finish(self) -> list[Notice]:
        """Author pending samples at the end; a notice of samples between cuts for which no velocity is known."""
        self._track.finish()
        self._bounds.finish()
        if not self._track.unknown:
            return []
        message = f"its velocities are blocked at {named_times(self._track.unknown)}: it has no sample beside that one"
        return [Notice(str(self.target), None, f"{message} without a cut, and the shot has no velocities there")]


def _facts(shot: Shot, sources: Mapping[str, GarmentSource], out: Path | None) -> dict[str, Any]:
    """Entries of the record about the garments, by path of the fine mesh, and their shot."""
    return {
        "shot": None if shot.view.root.anonymous else provenance.asset_path(shot.path, out and out.parent),
        "garments": list(sources),
        "left_out": {path: source.left_out_words for path, source in sources.items() if source.left_out} or None,
        "variants": shot.selections or None,
    }


def _garments_in(shot: Shot, times: Sequence[float] | None) -> list[int]:
    """Numbers of the garments with a sample at a given time code; a garment without samples has the shot's first."""
    every = range(len(shot.sources))
    if times is None:
        return [*every]
    first = shot.scene.times[0]
    return [index for index in every if not {*(shot.sources[index].times or (first,))}.isdisjoint(times)]


def _own_velocities(prim: Usd.Prim, fine: FineMap, time: float | None) -> np.ndarray | None:
    """Velocities of the coarse mesh at a time code between its first and last sample, refined linearly [units/s]."""
    attribute = UsdGeom.Mesh(prim).GetVelocitiesAttr()
    samples, value = attribute.GetTimeSamples(), value_at(attribute, time)
    if time is not None and samples and not within([time], (samples[0], samples[-1])):
        return None
    return fine.vectors(value)
