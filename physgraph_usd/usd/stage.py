"""Opens a stage: composition problems, units, axes and gravity."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from ..errors import LayerError, PhysGraphError, StageError, named_time
from .resolve import check_there
from .view import StageView

if TYPE_CHECKING:
    from ..solver.mesh.weld import Weld

_PARSER_RULE = re.compile(r"parse error matching \S.*?(?= at '| at line|$)")
"""The name of a rule of USD's own parser, of no use to a user."""
USD_ERRORS: tuple[type[Exception], ...] = (Tf.ErrorException, *filter(None, [getattr(Tf, "CppException", None)]))
"""Exceptions of pxr; the second exists since USD 24.11, for truncated files."""
MOST_REASONS, LONGEST_REASON = 4, 300
_NO_FORMAT = "Cannot determine file format"
NO_READER = "USD reads no files of this kind; import the file into Blender, Maya or Houdini and export USD"
_WARNED = re.compile(r"(?:In <([^>]*)>: )?(.*(?:sublayer|asset|ycle|prim).*)")
UP_AXIS = "upAxis of the stage"
"""Default source of gravity's direction."""
STANDARD_GRAVITY = 9.81
"""Magnitude of gravity without a physics scene's [m/s^2]."""
MOST_GRAVITY = 1e5
"""Largest plausible magnitude of gravity [m/s^2]."""
FALLBACK_METRES_PER_UNIT = 0.01
"""USD's meaning of an unauthored metersPerUnit [m]."""
_HUGE = 1e15
"""Upper limit of sizes and rates of a stage, and inverse of the lower limit: scaled values fit in single precision."""
_RATE = "rate; author one above 0, such as 24"
_TIME = "time code; author one or remove it"
_NUMBERS = {
    "metersPerUnit": ("length; author one above 0, such as 0.01 for centimetres", True),
    "kilogramsPerUnit": ("mass; author one above 0, such as 1", True),
    "timeCodesPerSecond": (_RATE, True),
    "framesPerSecond": (_RATE, True),
    "startTimeCode": (_TIME, False),
    "endTimeCode": (_TIME, False),
}
"""Numeric stage metadata: kind, advice for authoring, and whether the number must be above zero."""
TRAVERSAL = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
"""Active, loaded, defined prims, including prims inside instances."""


@dataclass(frozen=True)
class Notice:
    """A warning for the user about an issue that did not stop the work.

    Attributes:
        path: Prim path, or "" for the stage.
        time: Time code, or None for all times.
        message: The finding, and the remedy applied.
    """

    path: str
    time: float | None
    message: str

    def __str__(self) -> str:
        """Place, time and message in one line."""
        return f"{f'<{self.path}>' if self.path else 'stage'}{at_time(self.time)}: {self.message}"


def at_time(time: float | None) -> str:
    """Suffix of a place in messages: " at time code 3", or "" for None."""
    return "" if time is None else f" at time code {named_time(time)}"


def timecode(time: float | None) -> Usd.TimeCode:
    """USD's time code for a number; None is the default value."""
    return Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)


def value_at(attribute: Usd.Attribute, time: float | None) -> Any:
    """An attribute's value at a time code, None if blocked.

    At the default time, used for shots whose garments have no samples, the value may be the first sample.
    """
    value = attribute.Get(timecode(time))
    return first_value(attribute) if value is None and time is None else value


def first_value(attribute: Usd.Attribute) -> Any:
    """An attribute's first sample neither blocked nor empty, or the default without samples."""
    first = attribute.Get(Usd.TimeCode.EarliestTime())
    later_codes = attribute.GetTimeSamples()[1:] if first is None or np.size(first) == 0 else ()
    later = (attribute.Get(time) for time in later_codes)
    return next((value for value in later if value is not None and np.size(value)), first)


def indices_of(primvar: UsdGeom.Primvar, code: Usd.TimeCode) -> np.ndarray | None:
    """Indices of an indexed primvar, shape (N,), of any integer type; USD reads ``int[]`` alone. None without any."""
    value = primvar.GetIndicesAttr().Get(code) if primvar.IsIndexed() else None
    indices = np.asarray(value)
    return indices if value is not None and indices.ndim == 1 and indices.dtype.kind in "iu" else None


def flattened(primvar: UsdGeom.Primvar, code: Usd.TimeCode) -> Any:
    """Values of a primvar with its indices applied, of any integer type; None for bad indices."""
    indices = indices_of(primvar, code)
    if indices is None or indices.dtype == np.int32:
        return None if indices is None and primvar.IsIndexed() else primvar.ComputeFlattened(code)
    values, size = np.asarray(primvar.Get(code)), max(primvar.GetElementSize(), 1)
    if values.ndim == 0 or len(values) % size or int(indices.max(initial=0)) * size >= len(values):
        return None
    return values.reshape(-1, size, *values.shape[1:])[indices].reshape(-1, *values.shape[1:])


def authored_topology(prim: Usd.Prim) -> tuple[np.ndarray, np.ndarray]:
    """Corners of each face of a mesh, shape (F,), and the vertices of all corners, shape (C,), at the first sample."""
    mesh = UsdGeom.Mesh(prim)
    counts, indices = mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()
    return np.asarray(first_value(counts)), np.asarray(first_value(indices))


@dataclass(frozen=True, eq=False)
class GarmentSource:
    """The source of a garment on the stage; same order as ``Scene.garments``.

    Attributes:
        kept_faces: Authored faces kept by the garment (no holes, three corners or more), order kept, int32.
        skinned: Whether the points came from baking UsdSkel skinning.
        instance_roots: Prims to author as ``instanceable = false`` in the output.
        times: Time codes in range at which the garment is solved; empty for a still garment without moving bodies.
        sources: Source of each value, by short name.
        animated: Short names of the values whose source has time samples.
        apart_from: Colliders and garments excluded from contact, by path, with the excluding target.
        left_out: The garment's time codes outside the range; the layer holds the garment still there.
        velocities: Whether the shot has velocities for the garment.
        absent: Time codes in range at which the garment has no shape, ascending; blocked in the layer.
        subsets: Faces of the cage in each GeomSubset, by name.
        fabrics: How the fabrics of subsets differ from the garment's, in words, by the subset's name.
        weld: The mesh as authored and as solved, without holes.
        words: Words in the names of the prim, its parent, its materials, and subsets covering most of the mesh.
        still: Whether the garment itself has no samples.
        shell: Thickness of the shell that is written in place of a sheet [m]; 0 for the sheet.
    """

    path: Sdf.Path
    kept_faces: np.ndarray
    weld: Weld
    skinned: bool
    instance_roots: tuple[Sdf.Path, ...]
    times: tuple[float, ...]
    sources: dict[str, str]
    animated: frozenset[str] = field(default=frozenset())
    apart_from: dict[str, str] = field(default_factory=dict)
    left_out: tuple[float, ...] = ()
    velocities: bool = False
    subsets: dict[str, np.ndarray] = field(default_factory=dict)
    fabrics: dict[str, str] = field(default_factory=dict)
    words: tuple[str, ...] = ()
    absent: tuple[float, ...] = ()
    shell: float = 0.0
    still: bool = False

    @property
    def left_out_words(self) -> str:
        """Number and range of samples outside the frame range; "" without any."""
        before, after = ([t for t in self.left_out if (t < self.times[0]) == early] for early in (True, False))
        ends = [dict.fromkeys([span[0], span[-1]]) for span in (before, after) if span]
        spans = " and ".join(" to ".join(map(named_time, span)) for span in ends)
        return f"{len(self.left_out)} of {len(self.left_out) + len(self.times)} samples, {spans}" if spans else ""


@contextlib.contextmanager
def pxr_errors(what: str, kind: type[PhysGraphError] = StageError) -> Iterator[None]:
    """Convert a USD error to ``kind``; the message is ``what``, the failed action, and USD's first reasons."""
    try:
        yield
    except USD_ERRORS as error:
        raise kind(f"{what}: {reason_of(error)}") from error
    except UnicodeDecodeError as error:  # Names in a damaged crate file are not valid text.
        raise kind(f"{what}: a name in the file is no text; the file is damaged") from error


def reason_of(error: Exception) -> str:
    """The first reasons inside a USD error, without C++ locations and calls."""
    try:
        text = str(error)
    except UnicodeDecodeError:
        return "the file has bytes that are no text; it is damaged"
    if not isinstance(error, Tf.ErrorException):
        return f"the file is damaged or was cut short while it was read: {in_brief(text.partition(' - ')[0])}"
    reasons = [part.split(" : ", 1)[-1].strip().strip("'").strip() for part in text.split("\n\tError in ")]
    reasons = [NO_READER if reason.startswith(_NO_FORMAT) else in_brief(reason) for reason in reasons if reason]
    reasons = list(dict.fromkeys(reasons))
    return "; ".join(reasons[:MOST_REASONS]) + _others(max(len(reasons) - MOST_REASONS, 0)) or "USD gave no reason"


def in_brief(value: object) -> str:
    """A USD message or a value on one line of bounded length, without USD's parser rules."""
    text = _PARSER_RULE.sub("parse error", " ".join(str(value).split()))
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]} ..."


def root_metadata(stage: Usd.Stage, key: str) -> object | None:
    """Stage metadata as authored, of any type; None when unauthored."""
    for layer in (stage.GetSessionLayer(), stage.GetRootLayer()):
        if layer is not None and layer.pseudoRoot.HasInfo(key):
            return layer.pseudoRoot.GetInfo(key)
    return None


def check_metadata(stage: Usd.Stage) -> None:
    """Refuse (StageError) invalid units and time range, because the refined layer copies the metadata."""
    for key, (kind, positive) in _NUMBERS.items():
        value = root_metadata(stage, key)
        number = float(value) if isinstance(value, int | float) else math.nan
        if value is not None and not (1.0 / _HUGE < number < _HUGE if positive else math.isfinite(number)):
            raise StageError(f"{key} of the stage is {in_brief(value)}, which is no {kind}, in its root layer")


def bad_rate(stage: Usd.Stage) -> str:
    """An invalid timeCodesPerSecond among a stage's layers, or ""; USD may loop for ever on such a rate."""
    for layer in sorted(stage.GetUsedLayers(), key=lambda layer: layer.anonymous):
        if not 1.0 / _HUGE < layer.timeCodesPerSecond < _HUGE:
            name, rate = layer.GetDisplayName(), layer.timeCodesPerSecond
            return f"timeCodesPerSecond of @{name}@ is {rate:g}; author the shot's rate, such as 24"
    return ""


def metres_per_unit(stage: Usd.Stage) -> tuple[float, list[Notice]]:
    """Length of one stage unit [m], and notices; never raises."""
    authored = root_metadata(stage, "metersPerUnit")
    if authored is None:
        return FALLBACK_METRES_PER_UNIT, [Notice("", None, "metersPerUnit is not authored; 0.01 (centimetres) assumed")]
    value = float(authored) if isinstance(authored, int | float) else math.nan
    if not (math.isfinite(value) and value > 0):
        message = f"metersPerUnit is {authored!r}, which is no length; 0.01 (centimetres) assumed"
        return FALLBACK_METRES_PER_UNIT, [Notice("", None, message)]
    return float(f"{value:.7g}"), []


@dataclass(frozen=True, eq=False)
class Units:
    """Units, up axis and gravity of a stage.

    Attributes:
        kilograms: Mass of one stage unit [kg].
        up: Upward unit vector, against gravity if present, shape (3,).
        gravity: Gravity [m/s^2], shape (3,).
        gravity_source: Source of gravity's direction, in words.
    """

    metres: float
    kilograms: float
    up: np.ndarray
    gravity: np.ndarray
    gravity_source: str = UP_AXIS

    def pulled(self, axis: str, source: str) -> Units:
        """The units with gravity of equal strength along an axis, one of `AXES`, with the given source."""
        down = (-1.0 if axis.startswith("-") else 1.0) * np.eye(3)["XYZ".index(axis[-1])]
        strength = float(np.linalg.norm(self.gravity))
        return replace(self, up=-down, gravity=strength * down, gravity_source=source)


def read_units(stage: Usd.Stage) -> tuple[Units, list[Notice]]:
    """Units, up axis and gravity of a stage, and notices; never raises."""
    metres, notices = metres_per_unit(stage)
    mass = root_metadata(stage, "kilogramsPerUnit")
    kilograms = float(mass) if isinstance(mass, int | float) and math.isfinite(mass) and mass > 0 else 1.0
    up, up_notices = _up_vector(stage)
    pull, source, odd_pull = gravity(stage, up, metres)
    strength = float(np.linalg.norm(pull))
    return Units(metres, kilograms, -pull / strength if strength else up, pull, source), notices + up_notices + odd_pull


def _up_vector(stage: Usd.Stage) -> tuple[np.ndarray, list[Notice]]:
    """Upward unit vector, shape (3,), and notices; never raises."""
    authored = root_metadata(stage, "upAxis") or UsdGeom.GetFallbackUpAxis()
    if authored in {"Y", "Z"}:
        return np.array([0.0, 0.0, 1.0] if authored == "Z" else [0.0, 1.0, 0.0]), []
    return np.array([0.0, 1.0, 0.0]), [Notice("", None, f"upAxis is {authored!r}; USD knows Y and Z; Y assumed")]


def gravity(stage: Usd.Stage, up: np.ndarray, metres: float) -> tuple[np.ndarray, str, list[Notice]]:
    """Gravity of the first physics scene, or 9.81 m/s^2 against the up axis.

    UsdPhysics: a zero direction means down, a negative infinite magnitude means earth's; units are stage lengths.

    Returns:
        Gravity [m/s^2], shape (3,), the source of the direction in words, and notices.
    """
    direction, magnitude, source, notices = -up, STANDARD_GRAVITY, UP_AXIS, []
    scenes = (UsdPhysics.Scene(prim) for prim in Usd.PrimRange.Stage(stage, TRAVERSAL))
    physics = next((scene for scene in scenes if scene), None)
    if physics is not None:
        towards, strength = physics.GetGravityDirectionAttr().Get(), physics.GetGravityMagnitudeAttr().Get()
        length = float(np.linalg.norm(np.array(towards, float))) if isinstance(towards, Gf.Vec3f) else math.nan
        number = strength if isinstance(strength, int | float) else math.nan
        if 0 < length < math.inf:
            direction, source = np.array(towards, dtype=np.float64) / length, f"<{physics.GetPath()}>"
        magnitude = number * metres if 0 <= number * metres <= MOST_GRAVITY else magnitude
        invalid = {"Direction": (towards, length < math.inf), "Magnitude": (strength, number * metres <= MOST_GRAVITY)}
        notices = [
            Notice(str(physics.GetPath()), None, f"physics:gravity{name} is {in_brief(value)}; the earth's is assumed")
            for name, (value, usable) in invalid.items()
            if not usable and value is not None
        ]
    return direction * magnitude, source, notices


def list_meshes(stage: Usd.Stage) -> tuple[str, ...]:
    """Paths of all meshes on the stage, including meshes inside instances."""
    return tuple(str(prim.GetPath()) for prim in Usd.PrimRange.Stage(stage, TRAVERSAL) if UsdGeom.Mesh(prim))


@contextlib.contextmanager
def quiet() -> Iterator[UsdUtils.CoalescingDiagnosticDelegate]:
    """Keep USD's own warnings off the terminal; relevant warnings become notices."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield delegate
    finally:
        delegate.TakeUncoalescedDiagnostics()


def is_sound(layer: Sdf.Layer) -> bool:
    """Whether a layer has a spec for every listed prim; USD crashes on a listed prim without a spec."""
    paths = paths_in(layer)
    return all(not path.isEmpty and (not path.IsPrimPath() or layer.GetPrimAtPath(path)) for path in paths)


def paths_in(layer: Sdf.Layer) -> list[Sdf.Path]:
    """Paths of all specs in a layer."""
    paths: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda path: paths.append(Sdf.Path(path)))
    return paths


def open_layer(path: str | Path, kind: type[PhysGraphError] = LayerError) -> Sdf.Layer:
    """Open a layer.

    Raises:
        AbsentError: The file does not exist.
        PhysGraphError: Of type ``kind``, when the layer cannot be read.
    """
    check_there(path)
    with pxr_errors(f"cannot read {path}", kind), quiet():
        layer = Sdf.Layer.FindOrOpen(str(path))
    if not layer:
        raise kind(f"cannot read {path}: it is no USD file")
    return layer


def shot_name(shot: str | Usd.Stage) -> str:
    """A shot's file, or the name of the root layer for an in-memory stage."""
    if isinstance(shot, str):
        return shot
    root = shot.GetRootLayer()
    return root.realPath or root.GetDisplayName() or "the stage in memory"


def open_stage(shot: str | Usd.Stage) -> tuple[Usd.Stage, list[Notice]]:
    """Open a separate stage, for reading.

    Args:
        shot: The shot file, opened with all payloads; or an open stage, reproduced and not changed.

    Returns:
        The stage, and a notice for each missing layer, reference or payload.

    Raises:
        StageError: When the file or a required layer cannot be read, or references run in a circle.
    """
    path = shot_name(shot)
    if isinstance(shot, str):
        check_there(shot)
    with pxr_errors(f"cannot open {path}"), quiet() as diagnostics:
        root = Sdf.Layer.FindOrOpen(shot) if isinstance(shot, str) else shot.GetRootLayer()
        if root is not None and not is_sound(root):
            raise StageError(f"cannot open {path}: it lists prims that it does not hold; the file is damaged")
        stage = Usd.Stage.Open(shot, Usd.Stage.LoadAll) if isinstance(shot, str) else StageView.of(shot).open()
        if not stage:
            raise StageError(f"cannot open {path}")
        problems = composition_problems(stage, [item.commentary for item in diagnostics.TakeUncoalescedDiagnostics()])
    if message := bad_rate(stage):
        raise StageError(f"cannot read {path}: {message}")
    broken = [notice.message for notice, missing in problems if not missing]
    if broken:
        raise StageError(f"cannot compose {path}: {broken[0]}" + _others(len(broken) - 1))
    return stage, [notice for notice, _ in problems]


def composition_problems(stage: Usd.Stage, warnings: Sequence[str]) -> list[tuple[Notice, bool]]:
    """Arcs not followed by USD, each with a flag: True for a missing file or prim, False for a circle or damage.

    Args:
        warnings: USD's diagnostics during opening, used if USD is too old to list composition errors.
    """
    errors = getattr(stage, "GetCompositionErrors", None)
    if errors is None:
        texts = [match.groups() for text in warnings if (match := _WARNED.match(" ".join(text.split())))]
    else:
        texts = [(str(error.rootSite.path) if error.rootSite else "/", str(error)) for error in errors()]
    notice_of = {}
    for path, text in texts:
        message = " ".join(text.split()).removesuffix(" .")
        asset = re.search(r"(?:load sublayer|open asset) @([^@]+)@", message)
        exists = asset is not None and bool(Ar.GetResolver().Resolve(asset.group(1)))
        location = "" if path == "/" else path or ""
        notice_of[message] = Notice(location, None, in_brief(message)), not (exists or "ycle" in message)
    return list(notice_of.values())


def refuse_missing_arcs(prim: Usd.Prim, notices: Sequence[Notice]) -> None:
    """Refuse a prim affected by a missing payload or reference; ``notices`` as returned by `open_stage`."""
    for notice in notices:
        if notice.path and prim.GetPath().HasPrefix(Sdf.Path(notice.path)):
            raise StageError(f"<{prim.GetPath()}> is incomplete: {notice.message}")


def _others(count: int) -> str:
    return f" (and {count} more)" if count else ""
