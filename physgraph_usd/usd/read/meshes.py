"""Reads meshes of any stage as drawn: world positions, triangles and colours; and points of refined layers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel
from scipy import sparse

from ...errors import LayerError, StageError
from ...solver.mesh.subdivide import smooth, subdivide
from ...solver.mesh.topology import PolygonMesh, TriangleSplit
from ..mesh.drawn import DrawnSurface, to_limit
from ..provenance import read_record, recorded_shot
from ..schema import AXES
from ..stage import bad_rate, flattened, list_meshes, open_layer, paths_in, pxr_errors, quiet, read_units, timecode
from ..times import merge, motion_of, within
from ..view import root_over
from .bodies import DRAWN_WITHIN, surface_of
from .find import has_schema, traverse, with_gravity
from .placement import place
from .reader import Shot
from .skinning import Bake

NEUTRAL = (0.55, 0.54, 0.52)
"""Linear colour of a mesh without colour."""


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A visible mesh at a time code.

    Polygons are drawn as renderers draw them, and as the solver solves refined cloth: as fans from the first corner.

    Attributes:
        points: World positions [m], Y up, shape (V, 3).
        mesh: The polygons, counter-clockwise seen from outside, starting at the authored first corner.
        face_colors: Linear RGB per polygon, shape (F, 3).
        authored: Number of authored points.
    """

    path: str
    points: np.ndarray
    mesh: PolygonMesh
    face_colors: np.ndarray
    authored: int

    @cached_property
    def _split(self) -> TriangleSplit:
        return self.mesh.triangulate()

    @property
    def triangles(self) -> np.ndarray:
        """Corners of the triangles, shape (T, 3)."""
        return self._split.triangles

    @property
    def colors(self) -> np.ndarray:
        """Linear RGB per triangle, shape (T, 3)."""
        return self.face_colors[self._split.face]

    def subdivided(self, faces: int) -> DrawnMesh:
        """Smooth subdivision into at least ``faces`` polygons; coincident vertices are merged."""
        positions, label = np.unique(self.points, axis=0, return_inverse=True)
        mesh = PolygonMesh(self.mesh.counts, label.reshape(-1)[self.mesh.indices], len(positions))
        merged = replace(self, points=positions, mesh=mesh)
        while 0 < merged.mesh.face_count < faces:
            step = subdivide(merged.mesh)
            points = smooth(merged.mesh, step) @ merged.points
            merged = replace(merged, points=points, mesh=step.mesh, face_colors=merged.face_colors[step.parent_face])
        return merged


class DrawnStage:
    """A shot, alone or under a layer, composed in an anonymous root.

    Args:
        shot: The shot's file, the source of units, axis and rates.
        over: A layer put over the shot, or None.
        beside: A stage drawn beside this one, to share rotation of the world and subdivided surfaces; None turns
            gravity of the shot, or of the layer, downwards.

    Raises:
        StageError: When a file cannot be opened, or its rate is invalid.
    """

    def __init__(self, shot: Path, over: Path | None = None, *, beside: DrawnStage | None = None) -> None:
        """Compose and open."""
        base = open_layer(shot, StageError)
        layers = [open_layer(path, StageError) for path in (over, shot) if path is not None]
        self._fine = () if over is None else refined_in(over)
        self._refined = merge(*(layers[0].ListTimeSamplesForPath(f"{path}.points") for path in self._fine))
        self._root = root_over(base, [layer.identifier for layer in layers])
        with pxr_errors(f"cannot open {shot}"), quiet():
            self.stage = Usd.Stage.Open(self._root)
        if message := bad_rate(self.stage):
            raise StageError(f"cannot draw {shot}: {message}")
        self.rate = float(self.stage.GetTimeCodesPerSecond())
        with pxr_errors(f"cannot open {shot}"), quiet():
            meshes = [prim for prim in traverse(self.stage) if UsdGeom.Mesh(prim)]
            units = with_gravity(read_units(self.stage)[0], meshes, _gravity_of(layers[0]))
        self._scale, self.turn = units.metres, upright(units.up) if beside is None else beside.turn
        self._surfaces: dict[str, tuple[PolygonMesh, DrawnSurface]] = {} if beside is None else beside._surfaces

    def times(self, paths: tuple[str, ...]) -> tuple[float, ...]:
        """Time codes at which prims, or all meshes when none are named, have points, transforms or skeletons.

        Under a refined layer, only time codes from its first to its last sample: outside, the layer holds still.
        """
        times: list[Iterable[float]] = []
        for prim in traverse(self.stage):
            if (UsdGeom.Mesh(prim) and not paths) or str(prim.GetPath()) in paths:
                times.append(motion_of(prim).times)
            elif animation := UsdSkel.Animation(prim):
                for attribute in (animation.GetRotationsAttr(), animation.GetTranslationsAttr()):
                    times.append(attribute.GetTimeSamples())
        return within(merge(*times), (self._refined[0], self._refined[-1]) if self._refined else None)

    def bake(self, times: tuple[float, ...]) -> None:
        """Skin the skinned meshes at the given times, in an anonymous layer of the session."""
        with quiet():
            self._skinning = Bake(self.stage)
            self._skinning.bind([Sdf.Path(path) for path in self.paths()])
            self._skinning.bake(times)

    def paths(self) -> tuple[str, ...]:
        """Return the paths of all meshes, drawn or not."""
        return list_meshes(self.stage)

    def garments(self) -> tuple[str, ...]:
        """Return the paths of meshes with the garment schema applied, registered or not."""
        applied = [prim for prim in traverse(self.stage) if has_schema(prim, "PhysGraphGarmentAPI")]
        return tuple(str(prim.GetPath()) for prim in applied if UsdGeom.Mesh(prim))

    def meshes(self, time: float | None, *, cages: Collection[str] | None = None) -> list[DrawnMesh]:
        """All visible meshes of purpose default or render at a time code, in stage order, if not empty.

        Args:
            cages: Paths of the meshes drawn by their authored polygons; None for all meshes. The others are drawn by
                their subdivision's limit surface: meshes of the layer with one more subdivision, the others as bodies
                are in contact.
        """
        code = timecode(time)
        transforms = UsdGeom.XformCache(code)
        drawn = []
        for prim in traverse(self.stage):
            mesh = UsdGeom.Mesh(prim)
            if not mesh or mesh.ComputePurpose() not in {"default", "render"}:
                continue
            if mesh.ComputeVisibility(code) == UsdGeom.Tokens.invisible:
                continue
            matrix = np.array(transforms.GetLocalToWorldTransform(prim))
            smooth = cages is not None and str(prim.GetPath()) not in cages
            read = _read(mesh, code, matrix, self._surface if smooth else None)
            if read is not None:
                points = self._scale * (read.points @ matrix[:3, :3] + matrix[3, :3]) @ self.turn.T
                drawn.append(replace(read, points=points))
        return drawn

    def _surface(self, mesh: UsdGeom.Mesh, polygons: PolygonMesh, points: np.ndarray, scale: float) -> DrawnSurface:
        """A mesh's faces as drawn; cached while the topology stays the same."""
        path = str(mesh.GetPath())
        cached = self._surfaces.get(path)
        if cached is None or not (
            np.array_equal(cached[0].counts, polygons.counts) and np.array_equal(cached[0].indices, polygons.indices)
        ):
            holes = np.asarray(mesh.GetHoleIndicesAttr().Get() or [], np.int64)
            within, levels = DRAWN_WITHIN / (scale * self._scale), 1 if path in self._fine else None
            surface = surface_of(mesh.GetPrim(), polygons, points, holes=holes, within=within, levels=levels)
            cached = self._surfaces[path] = polygons, surface
        return cached[1]


def upright(up: np.ndarray) -> np.ndarray:
    """Smallest rotation from a unit vector, shape (3,), to Y, shape (3, 3)."""
    x, y, z = up
    if y <= -1.0 + 1e-9:  # The rotation by 180 degrees is not unique; choose the axis Z.
        return np.diag([-1.0, -1.0, 1.0])
    cross = np.array([[0.0, x, 0.0], [-x, 0.0, -z], [0.0, z, 0.0]])
    return np.eye(3) - cross + cross @ cross / (1.0 + y)


def limit_of(shot: Shot, index: int, levels: int) -> sparse.csr_matrix | None:
    """The matrix from the positions of a garment's refined cloth to the surface that a renderer draws, shape (V, V).

    None for cloth that is drawn by its polygons. Levels are the subdivisions between the cage and the refined cloth.
    """
    source, garment = shot.sources[index], shot.scene.garments[index]
    mesh = UsdGeom.Mesh(shot.stage.GetPrimAtPath(source.path))
    if mesh.GetSubdivisionSchemeAttr().Get(Usd.TimeCode.EarliestTime()) in (
        UsdGeom.Tokens.none,
        UsdGeom.Tokens.bilinear,
    ):
        return None
    cage = garment.control
    for _ in range(levels):
        cage = cage.subdivided(subdivide(cage.mesh))[1]
    return to_limit(cage)


def _gravity_of(layer: Sdf.Layer) -> str | None:
    """The gravity axis in a refined layer's recorded options; None if not set."""
    options = (read_record(layer) or {}).get("options")
    recorded = options.get("gravity") if isinstance(options, dict) else None
    return recorded if recorded in AXES else None


def shot_of(layer: Path) -> Path | None:
    """The shot recorded in a refined layer; None if not recorded."""
    shot = recorded_shot(open_layer(layer, StageError))
    return Path(shot) if shot else None


def refined_in(layer: Path) -> tuple[str, ...]:
    """Paths of the prims with points authored in a layer."""
    paths = paths_in(open_layer(layer, StageError))
    return tuple(sorted(str(path.GetPrimPath()) for path in paths if path.IsPropertyPath() and path.name == "points"))


def _read(
    mesh: UsdGeom.Mesh, code: Usd.TimeCode, matrix: np.ndarray, surface: Callable[..., DrawnSurface] | None
) -> DrawnMesh | None:
    """One mesh in local space and units, on the surface that is drawn if asked for; None if not drawable."""
    points, counts, indices = (
        attribute.Get(code)
        for attribute in (mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    )
    if not points or not counts or not indices:
        return None
    positions = np.asarray(points, dtype=np.float64)
    counts, indices = np.asarray(counts), np.asarray(indices)
    usable = (
        counts.min() >= 0 and counts.sum() == len(indices) and indices.min() >= 0 and indices.max() < len(positions)
    )
    if not usable or not np.isfinite(positions).all():
        return None
    polygons, colors = PolygonMesh(counts, indices, len(positions)), _colors(mesh, code, len(counts))
    if surface is not None and matrix[:3, :3].any():
        drawn = surface(mesh, polygons, positions, float(np.linalg.norm(matrix[:3, :3], 2)))
        polygons, positions, colors = drawn.mesh, drawn.place(positions), colors[drawn.parents]
    is_left_handed = mesh.GetOrientationAttr().Get(code) == "leftHanded"
    # Use the determinant's sign only: the cube of a scale can overflow.
    if is_left_handed != (np.linalg.slogdet(matrix[:3, :3])[0] < 0):
        polygons = replace(polygons, indices=polygons.indices[polygons.mirrored_corners])
    return DrawnMesh(str(mesh.GetPath()), positions, polygons, colors, len(points))


def color_of(stage: Usd.Stage, path: str) -> np.ndarray | None:
    """Mean linear colour of a mesh's faces, shape (3,); None for a mesh without colour and for other prims."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    if not mesh:
        return None
    faces = len(mesh.GetFaceVertexCountsAttr().Get(Usd.TimeCode.EarliestTime()) or [])
    colors = _colors(mesh, Usd.TimeCode.EarliestTime(), faces)
    return colors.mean(axis=0) if faces and (colors != NEUTRAL).any() else None


def _colors(mesh: UsdGeom.Mesh, code: Usd.TimeCode, faces: int) -> np.ndarray:
    """Linear colour of each authored face, shape (F, 3): its subset's or mesh's material, displayColor, or neutral."""
    colors = np.tile(np.array(NEUTRAL), (faces, 1))
    display = flattened(mesh.GetDisplayColorPrimvar(), code)
    if display:
        values = np.asarray(display, dtype=float)
        colors[:] = values if len(values) == faces else values.mean(axis=0)
    material_color = _material_color(mesh.GetPrim())
    if material_color is not None:
        colors[:] = material_color
    for subset in UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets():
        color = _material_color(subset.GetPrim())
        members = np.asarray(subset.GetIndicesAttr().Get(code) or [], dtype=int)
        if color is not None:
            colors[members[members < faces]] = color
    return colors


def _material_color(prim: Usd.Prim) -> np.ndarray | None:
    """Diffuse colour of the preview surface bound to a prim, or None without colour or with a texture."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    if not material:
        return None
    shader = material.ComputeSurfaceSource()[0]
    diffuse = shader.GetInput("diffuseColor") if shader else None
    if not diffuse or diffuse.HasConnectedSource():
        return None
    value = diffuse.Get()
    return None if value is None else np.array(value, dtype=float)


class RefinedLayer:
    """A refined layer, read back.

    Attributes:
        targets: Path of each garment's fine mesh, in the scene's order.
    """

    def __init__(self, path: Path) -> None:
        """Open the layer; LayerError for a layer without record."""
        layer = Sdf.Layer.FindOrOpen(str(path))
        record = None if layer is None else read_record(layer)
        if layer is None or record is None:
            raise LayerError(f"{path} is no refined layer")
        self._layer = layer
        self.targets = tuple(str(path) for path in record.get("garments", ()))

    def target(self, shot: Shot, index: int) -> str | None:
        """Path of a garment's fine mesh by number; None if the layer does not contain the garment."""
        coarse = str(shot.sources[index].path)
        return next((target for target in self.targets if target in (coarse, f"{coarse}_refined")), None)

    def points(self, shot: Shot, index: int, time: float | None) -> np.ndarray | None:
        """World positions [m] of a garment's fine mesh by number, shape (V, 3), or None without a sample."""
        target = self.target(shot, index)
        if target is None:
            return None
        path = Sdf.Path(target).AppendProperty("points")
        if time is None:
            attribute = self._layer.GetAttributeAtPath(path)
            local = None if attribute is None else attribute.default
        else:
            local = self._layer.QueryTimeSample(path, time)
        if local is None or isinstance(local, Sdf.ValueBlock):
            return None
        return place(np.asarray(local, dtype=np.float64), shot.to_metres(index, time))
