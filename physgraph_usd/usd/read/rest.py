"""Reads or fits a garment's rest shape in metres, and its source.

The first available of: the points at the time code of ``--rest``, ``physics:restShapePoints``, NVIDIA's
``omniphysics:restShapePoints``, ``primvars:rest``, ``primvars:Pref``, the points' default value, a shape fitted to the
median length of each edge over the shot.
``--rest auto`` requests the fitted shape even if a shape is authored. Authored shapes are placed in the world like the
garment at its first time code, or by a skinned garment's bind transform. Of a frame of animated points, as ``--rest``
or as default points, only the edge lengths count: its folds are not those at rest.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from pxr import Sdf, Usd, UsdGeom
from scipy import sparse
from scipy.sparse.linalg import splu

from ...errors import GarmentError, named_time
from ...solver.mesh.elements import elastic_elements, hinge_geometry
from ...solver.mesh.topology import PolygonMesh, adjacency, find_edges
from ...solver.mesh.weld import Weld
from ...solver.scene import out_of_bounds
from ...solver.strain import COLLAPSED
from ..lookup import nearest, source_name
from ..stage import Notice, first_value, flattened
from .cage import as_points, gather_unused, repair

AUTO = "auto"
"""Value of ``--rest`` to request the fitted rest shape even if a shape is authored."""
FITTED = "fitted to the shot"
"""First words of the source of a fitted rest shape."""
MOST_FITTED = 50
"""Most time codes used to fit a rest shape, spread over the shot. On five real shots, medians of 25 time codes are
within 0.2 to 1.3% of the medians of all 24 to 60, medians of 9 within 0.6 to 4.3%."""
STEPS = 100
"""Steps of a fit. On eleven garments lengths are then within 0.1 to 0.8% of their medians (root mean square)."""
SMOOTHNESS, SMOOTH_STEPS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001), 25
"""Stiffness of a fit's smoothness, in mean stiffnesses, one after another, and steps of each but the last. Without it,
1,146 fine edges of a walking shirt rest at lengths over 15% off the cage's, with it 23; of a kilt 2,754 and 76."""
HOLD = 1e-6
"""Stiffness holding a fitted shape in place, in mean stiffnesses: makes the matrix regular, keeps lengths."""
SHORTEST = 1e-3
"""Length, in mean edges, below which edges pull no harder."""
SHARP, KEPT = math.radians(60.0), 0.1
"""Least angle of a pressed fold that nobody marked, and its most relative change. All 28 edges of a turned collar are
so, 251 of two skinned garments with modelled hems, 10 of two made samples; none of eight simulated shots."""
_AUTHORED = ("physics:restShapePoints", "omniphysics:restShapePoints", "primvars:rest", "primvars:Pref")
_BENT = ("restShape", "restShapeDefault")
_PER_CORNER = UsdGeom.Tokens.faceVarying
_SAME_PLACE = 1e-6
"""Tolerance for equal corners of a point, relative to the rest shape's size: the rounding of single precision."""
_TINY = 1e-9
_MOST_SCALED = 2.0


@dataclass(frozen=True, eq=False)
class Rest:
    """A rest shape.

    Attributes:
        points: Rest positions [m], shape (V, 3), float64.
        source: Source in words, for the report.
        notices: Warnings about the rest shape.
    """

    points: np.ndarray
    source: str
    notices: tuple[Notice, ...] = ()


@dataclass(frozen=True, eq=False)
class Animation:
    """A garment's points over the shot.

    Attributes:
        times: All authored time codes, independent of the frame range.
        first: Positions at the first refined time code, or at the default [m], shape (V, 3).
        read: Positions at a time code, or at the default [m], shape (V, 3), and notices of repairs.
    """

    times: Sequence[float]
    first: np.ndarray
    read: Callable[[float | None], tuple[np.ndarray, tuple[Notice, ...]]]

    @cached_property
    def poses(self) -> dict[float | None, np.ndarray]:
        """Positions at up to `MOST_FITTED` readable time codes spread over the shot, by time code.

        Frames with broken points are skipped; for a shot without readable frames the result is empty.
        """
        poses = dict[float | None, np.ndarray]()
        picks = np.linspace(0, len(self.times) - 1, min(MOST_FITTED, len(self.times))).round().astype(int)
        for time in [self.times[pick] for pick in picks] or [None]:
            with contextlib.suppress(GarmentError):  # Refining a broken frame names its fault.
                poses[time] = self.read(time)[0]
        return poses


def read_rest(
    prim: Usd.Prim,
    weld: Weld,
    rest_frame: float | str | None,
    animation: Animation,
    *,
    place: Callable[[np.ndarray], np.ndarray],
    baked: Sdf.Layer,
) -> Rest:
    """Find or fit the rest shape.

    Args:
        weld: Faces of the cage, as authored and welded.
        rest_frame: Time code of the rest shape's points, `AUTO`, or None.
        animation: Points over the shot.
        place: From local rest points to metres, (V, 3) to (V, 3).
        baked: Layer of baked skinning; its points are not used as rest shape.

    Raises:
        GarmentError: When an authored rest shape does not fit the mesh, or the rest shape is invalid.
    """
    edges, first, notices_of_authored = weld.apart.half_edges.edges, animation.first, list[Notice]()
    if rest_frame == AUTO:
        rest = _fitted(weld, animation, by=" (--rest)")
    elif rest_frame is not None:
        points, notices = animation.read(float(rest_frame))
        source = f"edge lengths at time code {named_time(float(rest_frame))} (--rest)"
        rest = Rest(_lengths_of(prim, weld, points), source, notices)
    elif (authored := _authored(prim, len(first), notices_of_authored)) is not None:
        rest = Rest(place(authored[0]), authored[1])
    elif (default := _default_points(prim, baked)) is None:
        rest = _fitted(weld, animation)
    elif len(default) != len(first):
        rest = _fitted(weld, animation)
        message = f"the default points are {len(default)}, the mesh has {len(first)}; the rest shape is {rest.source}"
        rest = replace(rest, notices=(Notice(str(prim.GetPath()), None, message),))
    else:
        rest = _from_default(prim, edges, place(default), first=first)
        is_frame = np.allclose(rest.points, first, rtol=_SAME_PLACE, atol=_SAME_PLACE)
        if is_frame and animation.times and baked.GetPrimAtPath(prim.GetPath()) is None:  # A bind pose is modelled.
            rest = replace(rest, points=_lengths_of(prim, weld, rest.points))
    return _checked(prim, edges, replace(rest, notices=(*notices_of_authored, *rest.notices)), first=first)


def _lengths_of(prim: Usd.Prim, weld: Weld, pose: np.ndarray) -> np.ndarray:
    """A smooth shape with the edge lengths of an animated pose, which may be folded; the pose itself to rest bent."""
    return pose if rests_bent(prim)[0] else weld.split(median_shape(weld.mesh, [weld.joined(pose)])[0])


def _from_default(prim: Usd.Prim, edges: np.ndarray, points: np.ndarray, *, first: np.ndarray) -> Rest:
    """Rest shape of the points' default value [m], repaired from the first sample."""
    points = gather_unused(points, edges)
    if np.isfinite(points).all():
        return Rest(points, "default points")
    message = "the default points have NaN or infinite values, repaired for the rest shape"
    return Rest(repair(points, edges, first), "default points", (Notice(str(prim.GetPath()), None, message),))


def _fitted(weld: Weld, animation: Animation, *, by: str = "") -> Rest:
    """Rest shape fitted to the median lengths of the edges over the whole shot; ``by`` ends its source."""
    poses = animation.poses
    poses_joined = [weld.joined(pose) for pose in poses.values()]
    if len(poses_joined) < 2:
        return Rest(weld.split(poses_joined[0]) if poses_joined else animation.first, f"the only sample of points{by}")
    shape, nearest = median_shape(weld.mesh, poses_joined)
    message = f"median edge lengths of {len(poses)} time codes, from the points at {named_time([*poses][nearest])}"
    return Rest(weld.split(shape), f"{FITTED}: {message}{by}")


def _checked(prim: Usd.Prim, edges: np.ndarray, rest: Rest, *, first: np.ndarray) -> Rest:
    """A rest shape with notices of edges without length, and of a size different from the animation's.

    Coincident rest points are sewn together if also coincident in the animation; the faces in between are no cloth.

    Raises:
        GarmentError: When all points coincide, or a point is out of bounds.
    """
    path, rest = str(prim.GetPath()), replace(rest, points=gather_unused(rest.points, edges))
    if message := out_of_bounds(rest.points):
        raise GarmentError(path, f"the rest shape's ({rest.source}) {message}", remedy="check units and transforms")
    edges = edges[edges[:, 0] != edges[:, 1]]
    lengths = np.linalg.norm(rest.points[edges[:, 0]] - rest.points[edges[:, 1]], axis=1)
    mean = float(lengths.mean()) if len(lengths) else 0.0
    if len(lengths) and mean == 0.0:
        message, remedy = (
            f"all points of the rest shape ({rest.source}) are at one place",
            "choose another --rest FRAME",
        )
        raise GarmentError(path, message, remedy=remedy)
    short = np.flatnonzero(lengths <= _TINY * mean)
    notices = rest.notices
    if len(short):
        low, high = edges[short[0]]
        edge = "edge has" if len(short) == 1 else "edges have"
        message = f"{len(short)} {edge} no length in the rest shape ({rest.source}), the first between points[{low}]"
        notices = (*notices, Notice(path, None, f"{message} and points[{high}]: points at one place are taken for one"))
    mean_edge = float(np.linalg.norm(first[edges[:, 0]] - first[edges[:, 1]], axis=1).mean()) if len(edges) else 0.0
    ratio = mean / mean_edge if mean_edge > 0 else 1.0
    if 1 / _MOST_SCALED <= ratio <= _MOST_SCALED:
        return Rest(rest.points, rest.source, notices)
    message = f"the rest shape ({rest.source}) has edges {ratio:.3g} times as long as the animation's; check its units"
    return Rest(rest.points, rest.source, (*notices, Notice(path, None, message)))


def rests_bent(prim: Usd.Prim) -> tuple[bool, list[Notice]]:
    """Whether hinges rest at the rest shape's angles (``physics:restBendAnglesDefault``); a notice of an old token."""
    attribute = nearest(prim, "physics:restBendAnglesDefault")
    if attribute is None:
        return False, []
    value = str(attribute.Get())
    new = {"restShapeDefault": "restShape", "flatDefault": "flat"}.get(value)
    message = f"physics:restBendAnglesDefault is {value!r}, the proposal's older name; author {new!r}"
    return value in _BENT, [Notice(str(attribute.GetPrim().GetPath()), None, message)] if new else []


def _authored(prim: Usd.Prim, count: int, notices: list[Notice]) -> tuple[np.ndarray, str] | None:
    """Local rest points of an attribute besides ``points``; adds to the notices."""
    for name in _AUTHORED:
        attribute = prim.GetAttribute(name)
        if not attribute or not attribute.HasAuthoredValue():
            continue
        first, primvar = Usd.TimeCode.EarliestTime(), name.startswith("primvars:")
        value = flattened(UsdGeom.Primvar(attribute), first) if primvar else attribute.Get(first)
        if value is None or np.size(value) == 0:
            continue
        points = as_points(value, str(prim.GetPath()), name)
        if name.startswith("primvars:") and UsdGeom.Primvar(attribute).GetInterpolation() == _PER_CORNER:
            points, notice = _of_corners(attribute, points, count)
            notices.append(notice)
            if points is None:
                continue
        if len(points) != count:
            message = f"{name} has {len(points)} values, the mesh has {count} points"
            remedy = "author one value per point (vertex interpolation), or remove it"
            raise GarmentError(str(prim.GetPath()), message, remedy=remedy)
        broken = ~np.isfinite(points).all(axis=1)
        if broken.any():
            message = f"{source_name(attribute)}[{broken.argmax()}] is NaN or infinite"
            remedy = "author finite rest positions, or remove them"
            raise GarmentError(str(prim.GetPath()), message, remedy=remedy)
        return points, source_name(attribute)
    return None


def _of_corners(attribute: Usd.Attribute, values: np.ndarray, count: int) -> tuple[np.ndarray | None, Notice]:
    """Rest points from values per corner, shape (C, 3), or None if corners of a point differ; and a notice."""
    prim = attribute.GetPrim()
    corners = np.asarray(first_value(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr()))
    path, name = str(prim.GetPath()), attribute.GetName()
    if len(corners) != len(values):
        message = f"{name} has {len(values)} values, one per corner, for {len(corners)} corners; it is not the rest"
        return None, Notice(path, None, f"{message} shape; author one value per point (vertex interpolation)")
    points = np.tile(values.mean(axis=0), (count, 1))  # Default for points in no face, which are no cloth.
    points[corners] = values
    size = np.ptp(values, axis=0).max(initial=0.0)
    apart = np.flatnonzero(~(np.abs(points[corners] - values).max(axis=1) <= _SAME_PLACE * size))
    if not len(apart):
        return points, Notice(path, None, f"{name} is per corner; corners of a point agree, so it is the rest shape")
    message = f"{name} is per corner and differs between corners of points[{corners[apart[0]]}]; it is not the rest"
    return None, Notice(path, None, f"{message} shape; author one value per point (vertex interpolation)")


def _default_points(prim: Usd.Prim, baked: Sdf.Layer) -> np.ndarray | None:
    """The points' default value as composed, without baked skinning; None if blocked or not authored."""
    attribute = UsdGeom.Mesh(prim).GetPointsAttr()
    value, spec = attribute.Get(Usd.TimeCode.Default()), baked.GetAttributeAtPath(attribute.GetPath())
    if spec is not None and spec.HasDefaultValue():  # Blocks of samples and edits of arrays have no length.
        stack = [spec for spec in attribute.GetPropertyStack(Usd.TimeCode.Default()) if spec.layer != baked]
        values = [spec.default for spec in stack if spec.HasDefaultValue()]
        value = next(
            (opinion for opinion in values if isinstance(opinion, Sdf.ValueBlock) or hasattr(opinion, "__len__")), None
        )
    return (
        None if value is None or isinstance(value, Sdf.ValueBlock) else as_points(value, str(prim.GetPath()), "points")
    )


def _braced(mesh: PolygonMesh) -> np.ndarray:
    """Pairs of vertices, shape (E, 2), whose distances make a mesh's metric: the edges, and in faces with more than
    three corners each corner with the next but one.
    """
    corner, after = np.arange(len(mesh.indices)), mesh.next_corner[mesh.next_corner]
    diagonal = mesh.next_corner[after] != corner
    pairs = np.stack([mesh.indices[corner], mesh.indices[after]], axis=1)[diagonal]
    return np.unique(np.sort(np.concatenate([mesh.half_edges.edges, pairs]), axis=1), axis=0)


def median_shape(mesh: PolygonMesh, poses: Sequence[np.ndarray]) -> tuple[np.ndarray, int]:
    """Fit a smooth shape to the median length of each edge.

    A single pose has its own stretch; median lengths may fit no exact shape, yet cloth comes near them almost
    everywhere. Where the nearest pose is folded, a shape with the right lengths alone would be crumpled. So the sum

        sum over edges of (l - m)^2 / m + s |x - mean of the neighbours|^2

    is minimised with a stiffness s that falls from `SMOOTHNESS`'s first to its last value. Collapsed poses are left
    out, because garments are hidden by scaling to nothing. The method is SMACOF (de Leeuw 1977): each step solves a
    linear equation with the current edge directions, with the momentum of Nesterov (1983), restarted whenever the sum
    grows (O'Donoghue and Candes 2015).

    Args:
        mesh: The welded mesh.
        poses: Positions of the vertices, each of shape (V, 3); at least a single pose.

    Returns:
        The shape, (V, 3), and the index of the pose nearest to the medians; the fit starts from this pose.
    """
    edges = _braced(mesh)
    lengths = np.array([np.linalg.norm(np.subtract(*pose[edges.T]), axis=1) for pose in poses])
    are_whole = _are_whole(lengths)
    median = np.median(lengths[are_whole] if are_whole.any() else lengths, axis=0)
    nearest = int(np.abs(lengths - median).sum(axis=1).argmin())
    shape = np.array(poses[nearest], np.float64)
    if not median.any():
        return shape, nearest
    weight = 1.0 / np.maximum(median, max(SHORTEST * float(median.mean()), np.finfo(float).tiny))
    rows = np.arange(len(edges))
    ends = np.concatenate([edges[:, 0], edges[:, 1]])
    signs = np.repeat([1.0, -1.0], len(edges))
    spans = sparse.csr_matrix((signs, (np.tile(rows, 2), ends)), shape=(len(edges), len(shape)))
    pull = sparse.csr_matrix(spans.T @ sparse.diags(weight))
    stiffness = pull @ spans
    mean = float(stiffness.diagonal().mean())
    hold, bent = HOLD * mean, _bent(mesh)
    for smoothness in SMOOTHNESS:
        rough = smoothness * mean * (bent.T @ bent)
        solve = splu(sparse.csc_matrix(stiffness + rough + hold * sparse.identity(len(shape)))).solve
        ahead, pace, error = shape, 1.0, np.inf
        for _ in range(STEPS if smoothness == SMOOTHNESS[-1] else SMOOTH_STEPS):
            span = spans @ ahead
            length = np.linalg.norm(span, axis=1)
            wanted = span * (median / np.maximum(length, np.finfo(float).tiny))[:, None]
            last, shape = shape, solve(pull @ wanted + hold * ahead)
            before, error = error, float((weight * (length - median) ** 2).sum() + (ahead * (rough @ ahead)).sum())
            last_pace = 1.0 if error > before else pace
            pace = 0.5 + np.sqrt(0.25 + last_pace**2)
            ahead = shape + (last_pace - 1.0) / pace * (shape - last)
    return shape, nearest


def _are_whole(lengths: Float[np.ndarray, "poses edges"]) -> Bool[np.ndarray, " poses"]:
    """Whether each pose is not collapsed, by its edges' lengths [m]."""
    total = lengths.sum(axis=1)
    return np.asarray(total > COLLAPSED * np.sort(total)[-2:][0])  # The largest pose may be blown up.


def pressed_folds(
    mesh: PolygonMesh,
    poses: Sequence[Float[np.ndarray, "vertices 3"]],
    pressed_edges: Int[np.ndarray, "pressed 2"],
    refused: Int[np.ndarray, "refused 2"],
) -> tuple[Bool[np.ndarray, " vertices"], Float[np.ndarray, "vertices 3"]] | None:
    """Vertices at pressed folds, and the pose that has the folds as they rest.

    A fold is pressed where an artist says so, and where the cage keeps it: folded by more than `SHARP`, with an
    angle within `KEPT` of its median in every pose that is not collapsed. Simulated wrinkles form and move.

    Args:
        mesh: The welded mesh.
        poses: Positions of its vertices.
        pressed_edges: Vertices of the edges that are pressed, lower first.
        refused: Vertices of the edges that are not, lower first.

    Returns:
        Whether each vertex is at a pressed edge, and the pose nearest to the median angles; None without pressed edges.
    """
    edges = mesh.half_edges.edges
    if poses:
        are_whole = _are_whole(np.array([np.linalg.norm(np.subtract(*pose[edges.T]), axis=1) for pose in poses]))
        poses = [pose for pose, is_whole in zip(poses, are_whole, strict=True) if is_whole]
    if not poses:
        return None
    elements = elastic_elements(mesh, mesh.triangulate(poses[0]), poses[0])
    hinges = elements.hinges[~elements.twists]
    wanted, unwanted = (find_edges(folds, np.sort(hinges[:, :2], axis=1)) >= 0 for folds in (pressed_edges, refused))
    hinges, wanted, unwanted = (
        selection[wanted | (np.abs(hinge_geometry(poses[0], hinges)[0]) > (1.0 - KEPT) * SHARP)]
        for selection in (hinges, wanted, unwanted)
    )
    angles = np.array([hinge_geometry(pose, hinges)[0] for pose in poses])
    median = np.median(angles, axis=0)
    is_kept = (np.abs(angles - median) <= KEPT * np.abs(median)).all(axis=0) & (np.abs(median) > SHARP)
    pressed = wanted | (is_kept & ~unwanted & (len(poses) > 1))
    if not pressed.any():
        return None
    nearest = np.abs(angles - median)[:, pressed].sum(axis=1).argmin()
    return np.isin(np.arange(mesh.vertex_count), hinges[pressed, :2]), np.asarray(poses[nearest])


def _bent(mesh: PolygonMesh) -> sparse.csr_matrix:
    """Maps positions to each vertex's vector from the mean of its neighbours, shape (V, V); zero on open borders."""
    ends, count = mesh.half_edges.edges, mesh.vertex_count
    beside = adjacency(ends, count)
    degree = np.asarray(beside.sum(axis=1)).ravel()
    inner = degree > 0
    inner[ends[mesh.half_edges.count == 1]] = False
    mean = sparse.diags(1.0 / np.maximum(degree, 1.0)) @ beside
    return sparse.csr_matrix(sparse.diags(inner.astype(float)) @ (sparse.identity(count) - mean))
