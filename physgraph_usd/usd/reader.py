"""A shot, opened for reading: scene, frames, and how garments sit on the stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Usd, UsdGeom

from ..errors import GarmentError
from ..fabric import Fabric
from ..mesh.topology import PolygonMesh
from ..scene import Frame, Garment, GarmentFrame, Scene
from .find import find_garments
from .stage import GarmentSource, Notice, gravity, metres_per_unit, open_stage, up_vector


class Shot:
    """An opened stage, ready to be asked for frames.

    Attributes:
        stage: The composed stage; never edited on disk.
        path: The shot file.
        scene: What stays the same over the shot.
        sources: How each garment sits on the stage.
        colliders: Paths of the collider prims found.
        warnings: What the user should know.
        metres_per_unit: Length of one stage unit [m].
    """

    def __init__(self, stage: Usd.Stage, path: str, scene: Scene, sources: tuple[GarmentSource, ...]) -> None:
        """Keep the parts that ``open_shot`` read."""
        self.stage, self.path, self.scene, self.sources = stage, path, scene, sources
        self.colliders: tuple[str, ...] = ()
        self.warnings: list[Notice] = []
        self.metres_per_unit = metres_per_unit(stage)[0]

    def to_metres(self, index: int, time: float | None) -> np.ndarray:
        """Matrix from a garment's local space to world metres, shape (4, 4), for column vectors."""
        prim = self.stage.GetPrimAtPath(self.sources[index].path)
        cache = UsdGeom.XformCache(timecode(time))
        matrix = np.array(cache.GetLocalToWorldTransform(prim), dtype=np.float64).T
        matrix[:3] *= self.metres_per_unit
        return matrix

    def frame(self, time: float | None) -> Frame:
        """Read one time code; None reads the default values."""
        return Frame(time, tuple(self._garment(index, time) for index in range(len(self.sources))))

    def close(self) -> None:
        """Let go of the stage."""
        self.stage = None  # type: ignore[assignment]

    def _garment(self, index: int, time: float | None) -> GarmentFrame:
        prim = self.stage.GetPrimAtPath(self.sources[index].path)
        local = read_points(prim, time)
        matrix = self.to_metres(index, time)
        return GarmentFrame(local @ matrix[:3, :3].T + matrix[:3, 3], Fabric())


def timecode(time: float | None) -> Usd.TimeCode:
    """USD's time code for ours: None is the default value."""
    return Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)


def read_points(prim: Usd.Prim, time: float | None) -> np.ndarray:
    """Local points, shape (V, 3), float64."""
    value = UsdGeom.Mesh(prim).GetPointsAttr().Get(timecode(time))
    if value is None:
        value = UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime())
    if value is None:
        raise GarmentError(str(prim.GetPath()), "has no points", time=time)
    return np.asarray(value, dtype=np.float64)


def open_shot(
    path: str,
    *,
    garments: Sequence[str] = (),
    colliders: Sequence[str] = (),
    frames: tuple[float, float] | None = None,
    level: int | None = None,
    overrides: Sequence[str] = (),
    rest_frame: float | None = None,
    skip_invisible: bool = False,
) -> Shot:
    """Open a shot for refining."""
    stage = open_stage(str(path))
    metres, notices = metres_per_unit(stage)
    up, more = up_vector(stage)
    parts = [_read_garment(prim, metres, level) for prim in find_garments(stage, garments)]
    times = sorted({time for _, source in parts for time in source.times})
    if frames is not None:
        times = [time for time in times if frames[0] <= time <= frames[1]]
    scene = Scene(tuple(garment for garment, _ in parts), gravity(stage, up, metres), tuple(times))
    shot = Shot(stage, str(path), scene, tuple(source for _, source in parts))
    shot.warnings.extend(notices + more)
    return shot


def _read_garment(prim: Usd.Prim, metres: float, level: int | None) -> tuple[Garment, GarmentSource]:
    mesh = UsdGeom.Mesh(prim)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(Usd.TimeCode.EarliestTime()), dtype=np.int32)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(Usd.TimeCode.EarliestTime()), dtype=np.int32)
    rest = read_points(prim, None)
    times = tuple(mesh.GetPointsAttr().GetTimeSamples())
    size = len(rest)
    ones = np.ones(size)
    matrix = np.array(UsdGeom.XformCache(timecode(times[0] if times else None)).GetLocalToWorldTransform(prim)).T
    flipped = (mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded) != (np.linalg.det(matrix[:3, :3]) < 0)
    garment = Garment(
        path=str(prim.GetPath()),
        mesh=PolygonMesh(counts, indices, size),
        rest=(rest @ matrix[:3, :3].T + matrix[:3, 3]) * metres,
        level=2 if level is None else level,
        flipped=bool(flipped),
        bent_rest=False,
        stretch_scale=ones,
        bend_scale=ones,
        guide_scale=ones,
        detail_scale=ones,
        pin=np.zeros(size),
    )
    return garment, GarmentSource(prim.GetPath(), np.arange(len(counts), dtype=np.int32), False, (), times, {})
