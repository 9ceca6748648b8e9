"""A shot, opened for reading: scene, frames, and the places of the garments on the stage.

    with contextlib.closing(open_shot("shot.usda")) as shot:
        for time in shot.scene.times:
            frame = shot.frame(time)

All results are in metres and world space with the stage's own axes. A shot without samples has no times; its only frame
is ``shot.frame(None)``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import AbsentError, SchemaError, StageError, UsageError, named_time
from ...interrupts import leave_if_asked
from ...solver.colliders.orient import choose_side
from ...solver.scene import Frame, Scene, refuse_falling, refuse_far
from ..instances import instanced_gprims, instancer_above, mover
from ..lookup import check_limits, check_overrides, is_on, parse_overrides
from ..provenance import mute_refined, refuse_refined, selections, unsaved_layers
from ..schema import GARMENT
from ..stage import (
    GarmentSource,
    Notice,
    at_time,
    check_metadata,
    open_stage,
    pxr_errors,
    quiet,
    read_units,
    refuse_missing_arcs,
    root_metadata,
    shot_name,
)
from ..times import FrameGrid, Motion, merge, none_within, snap, solve_times, within
from ..view import StageView
from .authored import authored_faults
from .bodies import ColliderReader, Polygons, read_collider
from .face_numbers import face_number_notices
from .find import (
    colliders_of,
    disabled_colliders,
    felt_by,
    find_colliders,
    find_garments,
    instance_roots,
    purpose_notices,
    read_apart,
    traverse,
    with_gravity,
)
from .garment import GarmentReader, Request, is_visible, read_garment, samples_of, seam_tolerance, worn_notices
from .materials import find_values
from .placement import place, to_metres
from .rest import AUTO
from .seams import sewn_garments
from .skinning import Bake
from .targets import Bound, Target, find_bound, points_attribute, read_targets
from .timing import timing_notices

_MARK = "physgraph:refined"
"""Attribute authored temporarily on a garment, to find the prims sharing the garment's opinions."""


class Shot:
    """An opened stage, ready to read frames.

    Attributes:
        stage: The composed stage, with skinning baked in an anonymous session layer; never edited on disk.
        path: The shot file, or the name of an in-memory stage.
        view: The stage's view before baking and muting.
        unsaved: Names of the stage's layers with unsaved content.
        scene: Constant data of the shot.
        readers: Readers of the garments, in the scene's order, each with the garment and its source.
        sources: Place of each garment on the stage, in the scene's order.
        colliders: Paths of the collider prims found.
        selections: Active variant selections the garments depend on, as paths `/World/coat{fit=loose}`.
        bound: Prims following the garments, read by `targets`.
        warnings: Warnings for the user; grows as frames are read.
        metres_per_unit: Length of one stage unit [m].
        gravity_source: Source of gravity's direction, in words.
    """

    def __init__(
        self,
        path: str,
        stage: Usd.Stage,
        view: StageView,
        *,
        request: Request,
        readers: Sequence[GarmentReader],
        bodies: Sequence[ColliderReader],
    ) -> None:
        """Combine the parts read by ``open_shot``."""
        self.path, self.stage, self.view = path, stage, view
        self.colliders: tuple[str, ...] = ()
        self.selections: tuple[str, ...] = ()
        self.unsaved: tuple[str, ...] = ()
        self.bound: tuple[Bound, ...] = ()
        self.warnings: list[Notice] = []
        self.metres_per_unit, self.gravity_source = request.units.metres, request.units.gravity_source
        times = tuple(sorted({time for reader in readers for time in reader.source.times}))
        colliders = tuple(body.collider for body in bodies)
        seconds, gravity = 1.0 / stage.GetTimeCodesPerSecond(), request.units.gravity
        self.scene = Scene(tuple(reader.garment for reader in readers), gravity, times, colliders, seconds)
        self.readers, self._bodies, self._request = tuple(readers), tuple(bodies), request
        self.sources: tuple[GarmentSource, ...] = tuple(reader.source for reader in readers)

    def to_metres(self, index: int, time: float | None) -> np.ndarray:
        """Matrix from a garment's local space to world metres, by number, (4, 4), float64: ``world = M @ [local; 1]``.

        Raises:
            GarmentError: When the matrix is not invertible.
        """
        return to_metres(self.stage.GetPrimAtPath(self.sources[index].path), self.metres_per_unit, time)

    def local(self, index: int, time: float | None) -> np.ndarray:
        """A garment's coarse points in local space and units at a time code, by number, shape (V, 3), float64.

        Raises:
            GarmentError: The points are broken.
        """
        reader = self.readers[index]
        return reader.weld.joined(reader.points.read(time)[0])

    def cage(self, index: int, time: float | None) -> np.ndarray:
        """A garment's coarse points [m] in world space at a time code, by number, shape (V, 3), float64.

        Raises:
            GarmentError: The points are broken.
        """
        return place(self.local(index, time), self.to_metres(index, time))

    def default_points(self, path: Sdf.Path) -> Any:
        """Points or positions of a garment or target at the default time in local space, skinned; None without any."""
        baked = self._request.bake.defaults
        return baked[path] if path in baked else points_attribute(self.stage.GetPrimAtPath(path)).Get()

    def composed_from(self, path: Sdf.Path) -> list[Usd.Prim]:
        """Other meshes that get the opinions at a prim's path, by references, payloads, inherits or specializes."""
        layer = self._request.bake.layer
        is_new = layer.GetPrimAtPath(path) is None
        spec = Sdf.CreatePrimInLayer(layer, path)
        mark = Sdf.AttributeSpec(spec, _MARK, Sdf.ValueTypeNames.Bool)
        meshes = (prim for prim in traverse(self.stage) if prim.GetPath() != path and UsdGeom.Mesh(prim))
        paths = [prim.GetPath() for prim in meshes if prim.HasAttribute(_MARK)]
        spec.RemoveProperty(mark)
        if is_new:
            edit = Sdf.BatchNamespaceEdit()
            edit.Add(path, Sdf.Path.emptyPath)
            layer.Apply(edit)
        return [self.stage.GetPrimAtPath(path) for path in paths]

    @cached_property
    def targets(self) -> list[Target]:
        """Prims following the garments, in the bind pose, each after the followed prim.

        Raises:
            GarmentError: A target lies too far from its garment, changes its topology, or cannot be placed.
            SchemaError: An attribute is invalid.
        """
        # The first sample of the whole shot: the pose must not depend on the frame range.
        garments = [
            (
                reader.source.path,
                reader.garment.mesh,
                min((*reader.source.times, *reader.source.left_out), default=None),
            )
            for reader in self.readers
        ]
        with pxr_errors(f"cannot read {self.path}"):
            return read_targets(
                self.stage,
                self.bound,
                garments,
                cage=self.cage,
                metres=self.metres_per_unit,
                skinned=[*self._request.bake.skinned],
            )

    def times_until(self, last: float) -> list[float]:
        """Time codes with a sample of any garment, including outside the frame range, up to ``last``, in order."""
        return [time for time in self.every_time if time < last] + [last]

    @property
    def every_time(self) -> tuple[float, ...]:
        """Time codes with a sample of any garment, including outside the frame range."""
        return _every_time(self.sources)

    def frame(self, time: float | None) -> Frame:
        """Read one time code; None reads the default values.

        Raises:
            GarmentError: When a garment is broken or out of bounds at this time.
            SchemaError: When an animated value is invalid.
            StageError: When USD can no longer read the files.
        """
        leave_if_asked()
        garments, notices = [], []
        with pxr_errors(f"cannot read {self.path}" + at_time(time)):
            for reader in self.readers:
                prim = self.stage.GetPrimAtPath(reader.source.path)
                garment, new_notices = reader.frame(prim, self.metres_per_unit, time)
                garments.append(garment)
                notices += new_notices
            poses = []
            for body in self._bodies:
                pose, new_notices = body.pose(time)
                poses.append(pose)
                notices += new_notices
        earlier = set(self.warnings) if notices else set()
        self.warnings.extend(notice for notice in dict.fromkeys(notices) if notice not in earlier)
        frame = Frame(time, tuple(garments), tuple(poses))
        refuse_far(self.scene, frame)
        refuse_falling(self.scene, frame)
        return frame

    @property
    def is_skinned(self) -> bool:
        """Whether UsdSkel deforms a garment."""
        return any(source.path in self._request.bake.skinned for source in self.sources)

    def posed_frame(self, time: float | None, part: float) -> Frame:
        """Read a time code with skinned cloth and bodies part of the way from the bind pose (0) to their pose then (1).

        Everything else, and joints without a parent, is as at the time code.

        Raises:
            GarmentError, SchemaError, StageError: As `frame`.
        """
        with self._request.bake.posed(time, part):
            return self.frame(time)

    def polygons(self, time: float | None) -> list[Polygons | None]:
        """Authored polygons of each collider at a time code; None for one that is drawn as authored.

        Raises:
            StageError: When USD can no longer read the files.
        """
        with pxr_errors(f"cannot read {self.path}" + at_time(time)):
            return [body.polygons(time) for body in self._bodies]

    def offset(self, index: int, time: float | None) -> float:
        """Distance kept from colliders by a garment, by number, at a time code [m]."""
        return self.readers[index].contact_distance("contact:offset", time)

    def with_values(self, overrides: Sequence[str]) -> Shot:
        """A copy of the shot with other ``--set`` values in its frames; values read only on opening are kept.

        Raises:
            UsageError: When a text is invalid, or has no matching garment.
        """
        parsed = parse_overrides(overrides)
        check_overrides(parsed, [source.path for source in self.sources], [Sdf.Path(path) for path in self.colliders])
        changed = copy(self)
        readers = []
        for reader in self.readers:
            source = reader.source
            values = find_values(self.stage.GetPrimAtPath(source.path), self._request.units, parsed)
            source = replace(source, sources=source.sources | values.sources, animated=values.animated)
            readers.append(replace(reader, values=values, source=source))
        changed.readers, changed.sources = tuple(readers), tuple(reader.source for reader in readers)
        return changed

    def close(self) -> None:
        """Release the stage; nothing can be read afterwards."""
        self.readers, self._bodies = (), ()
        del self.stage, self.view, self._request


def open_shot(
    shot: str | os.PathLike[str] | Usd.Stage,
    *,
    garments: Sequence[str] = (),
    colliders: Sequence[str] = (),
    frames: tuple[float, float] | None = None,
    level: int | None = None,
    overrides: Sequence[str] = (),
    rest_frame: float | str | None = None,
    gravity: str | None = None,
    bind: Sequence[str] = (),
    skip_invisible: bool = False,
) -> Shot:
    """Open a shot for refining.

    Args:
        shot: The shot file, in any format known to USD; or an open stage, read in its current state and not changed.
        garments: Prim paths, prim names, globs over paths or collections (``/Prim.collection:name``); empty: the meshes
            with PhysGraphGarmentAPI.
        colliders: Likewise for colliders; empty: the colliders named by the garments, else every prim with
            PhysGraphColliderAPI or UsdPhysics' CollisionAPI.
        frames: First and last time code in composed stage time; None: every authored time code.
        level: Number of subdivisions, -1 for auto; None: each garment's own.
        overrides: ``</prim>.attribute=value`` texts; without a prim, for every garment.
        rest_frame: Time code whose points are the rest shape of every garment, or "auto" for a shape fitted to the
            whole shot; both override authored rest shapes. None: the authored shape, or else a fitted shape.
        gravity: Axis of the stage along which gravity pulls, one of `AXES`; None: the stage's gravity.
        bind: Meshes, curves and points that follow the nearest garment, named as garments are; beside those that
            garments name.
        skip_invisible: Leave out garments invisible at all their time codes.

    Returns:
        The shot; its ``warnings`` name everything assumed, left out or repaired.

    Raises:
        UsageError: When an option is invalid.
        StageError: When the stage cannot be read, or has no such garment or collider.
        GarmentError: When a garment is broken.
        SchemaError: When an attribute is invalid.
    """
    parsed = parse_overrides(overrides)
    _check_options(frames, level, rest_frame)
    source = shot if isinstance(shot, Usd.Stage) else os.fspath(shot)
    path = shot_name(source)
    stage, notices = open_stage(source)
    view = StageView.of(stage)
    notices += [Notice("", None, f"{layer} holds refined cloth and is left out") for layer in mute_refined(stage)]
    with pxr_errors(f"cannot read {path}"), quiet():
        unsaved = unsaved_layers(stage)
        refuse_refined(stage)
        check_metadata(stage)
        prims = _find(stage, garments, notices)
        refuse_refined(stage, [prim.GetPath() for prim in prims])
        bound = find_bound(stage, prims, bind)
        bodies = find_colliders(stage, prims, colliders, without=[target.path for target in bound], overrides=parsed)
        disabled = disabled_colliders(stage, prims, colliders, overrides=parsed)
        check_overrides(parsed, *([prim.GetPath() for prim in group] for group in (prims, [*bodies, *disabled])))
        for prim in (*prims, *bodies):
            refuse_missing_arcs(prim, notices)
        notices += _of_prims(prims, bodies, disabled, named=[garments, [*colliders] or colliders_of(prims)])
        units, unit_notices = read_units(stage)
        units = with_gravity(units, prims, gravity)
        assumed = root_metadata(stage, "metersPerUnit") is None
        request = Request(units, Bake(stage), frames, level, parsed, rest_frame, assumed)
        body_paths = [prim.GetPath() for prim in bodies]
        moved = [*body_paths, *_instanced(bodies), *(target.path for target in bound)]
        contacts = _contacts(stage, prims, colliders, request, notices=notices)
        readers = _read(stage, moved, contacts, request=request, notices=notices, skip_invisible=skip_invisible)
        readers, solids = _link(stage, readers, body_paths, request=request, contacts=contacts, notices=notices)
        opened = Shot(path, stage, view, request=request, readers=readers, bodies=_with_sides(stage, readers, solids))
        opened.bound = tuple(bound)
        notices += [*_timing(stage, readers, solids, bake=request.bake), *face_number_notices(stage, readers)]
        read = [*(source.path for source in opened.sources), *moved, *request.bake.prims()]
        opened.selections = selections(map(stage.GetPrimAtPath, read))
    opened.unsaved, opened.colliders = unsaved, tuple(map(str, body_paths))
    read_notices = [notice for reader in readers for notice in reader.notices]
    opened.warnings.extend(dict.fromkeys([*notices, *unit_notices, *read_notices]))
    return opened


def _instanced(prims: Iterable[Usd.Prim]) -> list[Sdf.Path]:
    """Paths of the gprims drawn by the point instancers among some prims."""
    return [gprim.GetPath() for prim in prims if UsdGeom.PointInstancer(prim) for gprim in instanced_gprims(prim)]


def _of_prims(
    prims: Sequence[Usd.Prim],
    colliders: Sequence[Usd.Prim],
    disabled: Mapping[Usd.Prim, Notice],
    *,
    named: Sequence[Sequence[str]],
) -> list[Notice]:
    """Notices of garments and colliders; named are the garments and the colliders named."""
    notices = [*(disabled.values() if named[1] else ())]
    notices += purpose_notices([*prims, *colliders], [name for names in named for name in names])
    return notices + authored_faults(prims, colliders)


def _check_options(frames: tuple[float, float] | None, level: int | None, rest_frame: float | str | None) -> None:
    if frames is not None and not (all(map(math.isfinite, frames)) and frames[0] <= frames[1]):
        raise UsageError(f"frames {':'.join(map(named_time, frames))} are no range; give FIRST:LAST")
    if level is not None:
        try:
            check_limits(GARMENT["refine:level"], level, "--level")
        except SchemaError as error:
            raise UsageError(str(error)) from error
    if not (rest_frame in (None, AUTO) or (isinstance(rest_frame, int | float) and math.isfinite(rest_frame))):
        raise UsageError(f"rest frame {rest_frame!r} is neither a time code nor '{AUTO}'")


def _find(stage: Usd.Stage, garments: Sequence[str], notices: Sequence[Notice]) -> list[Usd.Prim]:
    """Find the garments; an error also lists the stage's missing files."""
    try:
        return find_garments(stage, garments)
    except StageError as error:
        if not notices:
            raise
        kind = AbsentError if isinstance(error, AbsentError) else StageError
        raise kind(f"{error}; missing: {'; '.join(notice.message for notice in notices)}") from error


@dataclass(frozen=True)
class _Contact:
    """Bodies of a garment: all gprims named or marked, and those excluded from contact, with the excluding target."""

    near: frozenset[Sdf.Path]
    excluded: Mapping[Sdf.Path, str]

    @property
    def felt(self) -> frozenset[Sdf.Path]:
        """Gprims that may push the garment."""
        return self.near - self.excluded.keys()


def _contacts(
    stage: Usd.Stage, prims: Sequence[Usd.Prim], wanted: Sequence[str], request: Request, *, notices: list[Notice]
) -> dict[Sdf.Path, _Contact]:
    """The bodies of each enabled garment, by its path; adds notices of the others and of missing targets."""
    on = [prim for prim in prims if is_on(prim, GARMENT["enabled"], request.overrides)]
    near, (excluded, new_notices) = felt_by(stage, on, wanted, overrides=request.overrides), read_apart(stage, on)
    notices += [*(_left_out(prim, "is disabled") for prim in prims if prim not in on), *new_notices]
    return {path: _Contact(near[path], excluded[path]) for path in near}


def _link(
    stage: Usd.Stage,
    readers: Sequence[GarmentReader],
    paths: Sequence[Sdf.Path],
    *,
    request: Request,
    contacts: Mapping[Sdf.Path, _Contact],
    notices: list[Notice],
) -> tuple[list[GarmentReader], list[ColliderReader]]:
    """Readers of the sewn garments, each with the indices of the garment's colliders, and readers of the colliders."""
    readers = _sewn(stage, readers, request, notices)
    cloth = dict.fromkeys(reader.source.path for reader in readers)
    offset = min(reader.contact_distance("contact:offset", next(iter(reader.source.times), None)) for reader in readers)
    near = _swept(stage, readers, paths, request)
    bodies = []
    for path in paths:
        by = next((garment_path for garment_path in cloth if path in contacts[garment_path].felt), None)
        if by is not None:
            beside = stage.GetPrimAtPath(by)
            body, new_notices = read_collider(
                stage.GetPrimAtPath(path),
                request.units.metres,
                beside=beside,
                overrides=request.overrides,
                offset=offset,
                near=near,
            )
            notices += new_notices
            bodies += [body] if body is not None else []
    numbers = {body.prim.GetPath(): number for number, body in enumerate(bodies)}
    linked = []
    for reader in readers:
        contact = contacts[reader.source.path]
        apart = {str(path): target for path, target in contact.excluded.items() if path in contact.near | cloth.keys()}
        excluded = tuple(str(path) for path in contact.excluded if path in cloth)
        colliders = tuple(sorted(numbers[path] for path in contact.felt & numbers.keys()))
        garment = replace(reader.garment, colliders=colliders, apart_from=excluded)
        linked.append(replace(reader, garment=garment, source=replace(reader.source, apart_from=apart)))
        notices += [*worn_notices(garment, request.units.metres), *linked[-1].contact_notices()]
    return linked, bodies


def _swept(
    stage: Usd.Stage, readers: Sequence[GarmentReader], paths: Sequence[Sdf.Path], request: Request
) -> np.ndarray | None:
    """Bounds of the garments over the shot [m], half as large again, shape (2, 3); None without instancers to read."""
    prims = map(stage.GetPrimAtPath, paths)
    if not any(UsdGeom.PointInstancer(prim) or instancer_above(prim) for prim in prims):
        return None
    ends = []
    for time in _every_time(reader.source for reader in readers) or (None,):
        with suppress(StageError):
            cages = [cage for cage in _cages(stage, readers, request.units.metres, time) if len(cage)]
            ends += [point for cage in cages for point in (cage.min(axis=0), cage.max(axis=0))]
    if not ends:
        return None
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    margin = 0.25 * float(np.linalg.norm(high - low))
    return np.stack([low - margin, high + margin])


def _sewn(
    stage: Usd.Stage, readers: Sequence[GarmentReader], request: Request, notices: list[Notice]
) -> list[GarmentReader]:
    """Garments with their seams; adds notices of adjacent borders not sewn."""
    prims = [stage.GetPrimAtPath(reader.source.path) for reader in readers]
    every = _every_time(reader.source for reader in readers)

    def poses(most: int) -> Iterator[list[np.ndarray | None]]:
        picks = np.linspace(0, len(every) - 1, min(most, len(every))).round().astype(int)
        for time in [every[pick] for pick in picks] or [None]:
            with suppress(StageError):
                cages = _cages(stage, readers, request.units.metres, time)
                yield [points if np.ptp(points, axis=0).any() else None for points in cages]

    tolerances = [seam_tolerance(prim, request.overrides) for prim in prims]
    garments, seam_notices = sewn_garments([reader.garment for reader in readers], tolerances, poses)
    notices += seam_notices
    return [replace(reader, garment=garment) for reader, garment in zip(readers, garments, strict=True)]


def _every_time(sources: Iterable[GarmentSource]) -> tuple[float, ...]:
    return tuple(sorted({time for source in sources for time in (*source.times, *source.left_out)}))


def _cages(stage: Usd.Stage, readers: Sequence[GarmentReader], metres: float, time: float | None) -> list[np.ndarray]:
    """The cage of each garment at a time code [m]."""
    return [reader.frame(stage.GetPrimAtPath(reader.source.path), metres, time)[0].points for reader in readers]


def _with_sides(
    stage: Usd.Stage, readers: Sequence[GarmentReader], bodies: Sequence[ColliderReader]
) -> list[ColliderReader]:
    """Colliders, with sides chosen for open meshes on "auto" from the cloth's position in the shot's first frame."""
    automatic = [body for body in bodies if (body.collider.kind, body.collider.side) == ("mesh", "auto")]
    time, cages = _first_cages(stage, readers, automatic[0].metres) if automatic else (None, [])
    sided = [*bodies]
    for number, body in enumerate(bodies):
        if body in automatic:
            front = body.on_side("front")  # On side "front", faces are wound as seen in world space.
            pose, _ = front.pose(time)
            cages_touching = [
                cage for reader, cage in zip(readers, cages, strict=True) if number in reader.garment.colliders
            ]
            side = choose_side(pose.points, pose.triangles, cages_touching) if pose is not None else "auto"
            sided[number] = front.on_side(side)
    return sided


def _first_cages(
    stage: Usd.Stage, readers: Sequence[GarmentReader], metres: float
) -> tuple[float | None, list[np.ndarray]]:
    """The first time code with all cages readable, and the cages [m]; None and empty cages if there is none."""
    for time in _every_time(reader.source for reader in readers) or (None,):
        with suppress(StageError):
            return time, _cages(stage, readers, metres, time)
    return None, [np.zeros((0, 3))] * len(readers)


def _timing(
    stage: Usd.Stage, readers: Sequence[GarmentReader], bodies: Sequence[ColliderReader], *, bake: Bake
) -> list[Notice]:
    """Notices of samples of garments and their bodies with mismatched timing."""
    garments = [(stage.GetPrimAtPath(reader.source.path), reader.source) for reader in readers]
    colliding = [
        (body, [number for number, reader in enumerate(readers) if index in reader.garment.colliders])
        for index, body in enumerate(bodies)
    ]
    return timing_notices(garments, colliding, bake)


def _read(
    stage: Usd.Stage,
    moved: Sequence[Sdf.Path],
    contacts: Mapping[Sdf.Path, _Contact],
    *,
    request: Request,
    notices: list[Notice],
    skip_invisible: bool,
) -> list[GarmentReader]:
    """Bake the skinning of garments, bodies and bound prims, and read every garment."""
    roots = {path: instance_roots(stage.GetPrimAtPath(path)) for path in contacts}
    notices += request.bake.bind([*roots, *moved])
    garment_times, solved = _times(stage, contacts, moved, bake=request.bake)
    # Bake the whole shot: the chosen level and the plan must not depend on the frame range.
    notices += request.bake.bake(every_time := merge(*solved.values()))
    readers, every = [], []
    for path, instances in roots.items():
        prim = stage.GetPrimAtPath(path)
        samples = samples_of(prim, snap(garment_times[path], every_time), snap(solved[path], every_time))
        times = samples.times
        every += times
        if samples.own and not within(times, request.frames):
            reason = "is invisible" if within(samples.hidden, request.frames) else "has no sample"
            span = f"its time codes run from {named_time(times[0])} to {named_time(times[-1])}"
            notices.append(_left_out(prim, f"{reason} in the frame range; {span}; give --frames that hold one"))
        elif skip_invisible and not is_visible(prim, within(times, request.frames)):
            notices.append(_left_out(prim, "is invisible"))
        else:
            readers.append(read_garment(prim, instances, samples, request))
    if request.frames and every and not within(every, request.frames):
        raise none_within(sorted({*every}), request.frames)
    if not readers:
        reasons = "; ".join(str(notice) for notice in notices if "left out" in notice.message)
        raise StageError(f"no garment is left to refine: {reasons}")
    return readers


def _times(
    stage: Usd.Stage, contacts: Mapping[Sdf.Path, _Contact], bodies: Sequence[Sdf.Path], *, bake: Bake
) -> tuple[dict[Sdf.Path, tuple[float, ...]], dict[Sdf.Path, tuple[float, ...]]]:
    """Sample time codes and solved time codes of each garment, by path."""
    frames, body_paths = FrameGrid.of(stage), {*bodies}

    @cache
    def motion(path: Sdf.Path) -> Motion:
        return bake.motion(stage.GetPrimAtPath(path))

    bodies_of = {
        path: [motion(mover(stage, body, path).GetPath()) for body in sorted(contact.felt & body_paths)]
        for path, contact in contacts.items()
    }
    solved = {path: solve_times(motion(path), bodies, frames) for path, bodies in bodies_of.items()}
    return {path: motion(path).times for path in contacts}, solved


def _left_out(prim: Usd.Prim, reason: str) -> Notice:
    return Notice(str(prim.GetPath()), None, f"left out: it {reason}")
