"""Opening a stage: what was found wrong, units, axes and gravity.

Nothing here is written to disk, and no pxr exception leaves this package.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics

from ..errors import StageError

STANDARD_GRAVITY = 9.81
"""Magnitude of gravity when no physics scene gives one [m/s^2]."""
FALLBACK_METRES_PER_UNIT = 0.01
"""What USD says an unauthored metersPerUnit means [m]."""
TRAVERSAL = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
"""Active, loaded, defined prims, those inside instances included."""


@dataclass(frozen=True)
class Notice:
    """Something that the user should know and that did not stop the work.

    Attributes:
        path: Prim path, or "" for the stage.
        time: Time code, or None when it holds at all times.
        message: What was found and what was done about it.
    """

    path: str
    time: float | None
    message: str

    def __str__(self) -> str:
        """Place, time and message in one line."""
        place = f"<{self.path}>" if self.path else "stage"
        return (
            f"{place}: {self.message}" if self.time is None else f"{place} at time code {self.time:g}: {self.message}"
        )


@dataclass(frozen=True, eq=False)
class GarmentSource:
    """How one garment sits on its stage; same order as ``Scene.garments``.

    Attributes:
        path: Prim path.
        kept_faces: Authored faces that the garment keeps (no holes, three corners or more), order kept, int32.
        skinned: Whether the points came from baking UsdSkel skinning.
        instance_roots: Prims that must become ``instanceable = false`` in the output.
        times: The garment's own authored times in range; empty for a still one.
        sources: Which source won, by short name of the value.
        animated: Short names of the values whose source has time samples.
    """

    path: Sdf.Path
    kept_faces: np.ndarray
    skinned: bool
    instance_roots: tuple[Sdf.Path, ...]
    times: tuple[float, ...]
    sources: dict[str, str]
    animated: frozenset[str] = field(default=frozenset())


@contextlib.contextmanager
def pxr_errors(what: str) -> Iterator[None]:
    """Turn an error that USD raises into a StageError.

    Args:
        what: What was being done, as the message's beginning.

    Raises:
        StageError: When pxr raised; its text is the first reason USD gave.
    """
    try:
        yield
    except Tf.ErrorException as error:
        raise StageError(f"{what}: {reason_of(error)}") from error


def reason_of(error: Tf.ErrorException) -> str:
    """Give the reasons inside a USD error, without its C++ places."""
    reasons = [part.split(" : ", 1)[-1].strip().strip("'").strip() for part in str(error).split("\n\tError in ")]
    kept = dict.fromkeys(" ".join(reason.split()) for reason in reasons if reason)
    return "; ".join(kept) or "USD gave no reason"


def root_metadata(stage: Usd.Stage, key: str) -> object | None:
    """Read stage metadata as authored, whatever its type; None when unauthored."""
    for layer in (stage.GetSessionLayer(), stage.GetRootLayer()):
        if layer is not None and layer.pseudoRoot.HasInfo(key):
            return layer.pseudoRoot.GetInfo(key)
    return None


def metres_per_unit(stage: Usd.Stage) -> tuple[float, list[Notice]]:
    """Length of one stage unit [m], and what is odd about it; never raises."""
    authored = root_metadata(stage, "metersPerUnit")
    if authored is None:
        return FALLBACK_METRES_PER_UNIT, [Notice("", None, "metersPerUnit is not authored; 0.01 (centimetres) assumed")]
    value = float(authored) if isinstance(authored, int | float) else math.nan
    if not (math.isfinite(value) and value > 0):
        said = f"metersPerUnit is {authored!r}, which is no length; 0.01 (centimetres) assumed"
        return FALLBACK_METRES_PER_UNIT, [Notice("", None, said)]
    return float(f"{value:.7g}"), []


def up_vector(stage: Usd.Stage) -> tuple[np.ndarray, list[Notice]]:
    """Unit vector that points up, shape (3,), and what is odd about it; never raises."""
    authored = root_metadata(stage, "upAxis")
    if authored in {None, "Y", "Z"}:
        return np.array([0.0, 0.0, 1.0] if authored == "Z" else [0.0, 1.0, 0.0]), []
    return np.array([0.0, 1.0, 0.0]), [Notice("", None, f"upAxis is {authored!r}; USD knows Y and Z; Y assumed")]


def gravity(stage: Usd.Stage, up: np.ndarray, metres: float) -> np.ndarray:
    """Gravity of the first physics scene, or 9.81 m/s^2 against the up axis [m/s^2], shape (3,).

    UsdPhysics: a zero direction means down, a negative infinite magnitude means earth's; units are stage lengths.
    """
    direction, magnitude = -up, STANDARD_GRAVITY
    scene = next((prim for prim in Usd.PrimRange.Stage(stage, TRAVERSAL) if prim.IsA(UsdPhysics.Scene)), None)
    if scene is not None:
        physics = UsdPhysics.Scene(scene)
        authored = np.array(physics.GetGravityDirectionAttr().Get() or Gf.Vec3f(0.0), dtype=np.float64)
        length = float(np.linalg.norm(authored))
        direction = authored / length if math.isfinite(length) and length > 0 else direction
        strength = physics.GetGravityMagnitudeAttr().Get()
        magnitude = strength * metres if strength is not None and strength >= 0 else magnitude
    return direction * magnitude


def list_meshes(stage: Usd.Stage) -> tuple[str, ...]:
    """Paths of all meshes on the stage, those inside instances included."""
    return tuple(str(prim.GetPath()) for prim in Usd.PrimRange.Stage(stage, TRAVERSAL) if prim.IsA(UsdGeom.Mesh))


def open_stage(path: str) -> Usd.Stage:
    """Open a stage with all payloads, for reading.

    Raises:
        StageError: When the file cannot be opened.
    """
    with pxr_errors(f"cannot open {path}"):
        stage = Usd.Stage.Open(path, Usd.Stage.LoadAll)
    if not stage:
        raise StageError(f"cannot open {path}")
    return stage
