"""The nouns of the solver: what a shot is and what one time code gives.

Everything here is SI, in world space, without USD. Only ``usd/`` converts.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..errors import GarmentError
from .colliders.pose import Collider, Pose, extent
from .fabric import Fabric
from .mesh.subdivide import ControlMesh, creases_of
from .mesh.topology import PolygonMesh

FARTHEST = 1e9
"""Farthest that a point may be from the world's origin along an axis [m]. Products of four lengths below it, such as
squared areas, are finite in float32; the hierarchies that kernels build end the process where a box is not."""
RESOLVED = 0.1
"""Part of an edge that single precision must tell apart where the farthest vertex is: about the garment's mean the
solver's positions have 24 bits, and with less than that nothing of the cloth is left in them."""
FALLS = 4.0
"""Largest distance that a garment may sink, in diameters. Cloth over one diameter off the cage is invalid."""
SPECK = 0.1
"""Least size of a garment in the test for cloth that sinks [m]: smaller garments have wrong units, not a weak guide."""
OUTGROWN = 1e3
"""Median edges of the rest shape above which those of a cage are not of stretched cloth: it rests as a speck."""
GIVEN_UP = "given up: the cloth is its subdivided cage"
"""Start, in a frame's telemetry, of cloth that is not solved since its cage crosses itself too often."""
SAME_TIME = 1e-3
"""Time codes closer than this count as equal: float seconds and layer offsets leave rounding errors. Two poses that
close are the sides of a jump."""
_REMEDY = (
    "check metersPerUnit, the rest shape (--rest) and the transforms above it, cache that frame again, or leave it out "
    "with --frames"
)


@dataclass(frozen=True, eq=False)
class Grain:
    """A garment's grain.

    Attributes:
        warp: Unit direction of the warp on each face of the cage, in the rest shape, shape (F, 3), float64.
        ease_scale: Painted multiplier of the ease, shape (V,).
        gather: Painted length more along the weft, as a fraction, shape (V,).
    """

    warp: np.ndarray
    ease_scale: np.ndarray
    gather: np.ndarray


@dataclass(frozen=True, eq=False)
class Garment:
    """One garment's constant data.

    Attributes:
        path: Prim path, used as its name in reports and errors.
        mesh: The coarse cage, faces in authored order and winding, holes removed.
        rest: Rest positions of the cage [m], shape (V, 3), float64.
        level: Number of subdivisions.
        bent_rest: True: hinges rest at the rest shape's angles; False: flat.
        stretch_scale: Multiplier of the stretch stiffness, shape (V,).
        bend_scale: Multiplier of the bending stiffness, shape (V,).
        guide_scale: Multiplier of the guide stiffness, shape (V,).
        detail_scale: Multiplier of the detail written out, shape (V,).
        pin: 1 where the fine cloth follows the coarse cloth exactly, shape (V,).
        colliders: Numbers of the scene's colliders that the garment feels.
        self_contact: Whether it feels itself.
        apart_from: Paths of the garments that it never touches; each of them names it too.
        grain: Which way its warp lies, and its painted ease; None is unknown, and none.
        raises_bending: Whether bending is raised on a level whose edges are too long for the fabric's folds.
        sewn_at: Places of the vertices that are sewn to others, in a pose in which the seams are closed [m], NaN at
            all other vertices, shape (V, 3). Vertices of any garments at one place are sewn together, and vertices on
            another border's edge to that edge. None without seams.
        pressed: Whether each vertex is at a pressed fold, shape (V,); None without pressed folds.
        folded: A pose in which pressed folds are as they rest [m], shape (V, 3); None without.
        closed: Whether each vertex belongs to a closed piece, whose sharp edges stay sharp, shape (V,); None without
            such pieces.
        creases: Vertices of the cage's crease edges, shape (C, 2), and the sharpness of each, shape (C,); None without.
        corners: Sharpness of each vertex, shape (V,); None without sharp corners.
        rigid: Number of the rigid part that each vertex belongs to, -1 for cloth, shape (V,); None without parts.
        fabric_scale: Multipliers of the fabric's stretch, bending and density on each face of the cage, shape (F, 3);
            None for one fabric.
        flipped: Whether the authored winding is clockwise seen from outside: flat compressed cloth buckles to one side.
    """

    path: str
    mesh: PolygonMesh
    rest: np.ndarray
    level: int
    bent_rest: bool
    stretch_scale: np.ndarray
    bend_scale: np.ndarray
    guide_scale: np.ndarray
    detail_scale: np.ndarray
    pin: np.ndarray
    colliders: tuple[int, ...] = ()
    self_contact: bool = True
    apart_from: tuple[str, ...] = ()
    grain: Grain | None = None
    raises_bending: bool = True
    sewn_at: np.ndarray | None = None
    pressed: np.ndarray | None = None
    folded: np.ndarray | None = None
    closed: np.ndarray | None = None
    creases: tuple[np.ndarray, np.ndarray] | None = None
    corners: np.ndarray | None = None
    rigid: np.ndarray | None = None
    fabric_scale: np.ndarray | None = None
    flipped: bool = False

    @property
    def control(self) -> ControlMesh:
        """The cage with its creases and corners; sharp edges of closed pieces are creases after any subdivision."""
        always = creases_of(self.mesh, self.rest, self.closed)
        ends, sharpness = self.creases or (always[:0], np.zeros(0))
        sharpness = np.concatenate([np.full(len(always), np.inf), sharpness])
        return ControlMesh(self.mesh, np.concatenate([always, ends]), sharpness, self.corners)

    @staticmethod
    def of(
        path: str,
        faces: np.ndarray,
        rest: np.ndarray,
        *,
        level: int = 2,
        colliders: tuple[int, ...] = (),
        pin: np.ndarray | None = None,
    ) -> Garment:
        """A garment without paint, its hinges flat at rest.

        Args:
            path: Its name.
            faces: Corner vertices of triangles or quads, counter-clockwise seen from outside, shape (F, 3) or (F, 4).
            rest: Rest positions of the cage [m], shape (V, 3).
            level: Number of subdivisions.
            colliders: Numbers of the scene's colliders that it feels.
            pin: 1 where the fine cloth follows the coarse cloth exactly, shape (V,); None pins no vertex.
        """
        ones, corners = np.ones(len(rest)), np.asarray(faces)
        mesh = PolygonMesh(np.full(len(corners), corners.shape[1]), corners.ravel(), len(rest))
        pinned = 0 * ones if pin is None else np.asarray(pin, float)
        return Garment(path, mesh, np.asarray(rest, float), level, False, ones, ones, ones, ones, pinned, colliders)


@dataclass(frozen=True, eq=False)
class Limits:
    """Distances that cloth may be from its smoothly subdivided cage, each times its painted multiplier.

    Attributes:
        max_distance: Largest distance in any direction [m]; None for no limit.
        backstop: Largest distance inwards, against the cage's outward normals [m]; None for no limit.
        max_distance_scale: Multiplier of ``max_distance`` at the cage's vertices, 0 to 1, shape (V,).
        backstop_scale: Multiplier of ``backstop``, likewise.
    """

    max_distance: float | None
    backstop: float | None
    max_distance_scale: np.ndarray
    backstop_scale: np.ndarray

    @staticmethod
    def are_equal(a: Limits | None, b: Limits | None) -> bool:
        """Whether two limits are equal."""
        if a is None or b is None:
            return a is b
        maps = (a.max_distance_scale, b.max_distance_scale), (a.backstop_scale, b.backstop_scale)
        values = (a.max_distance, a.backstop) == (b.max_distance, b.backstop)
        return values and all(x is y or np.array_equal(x, y) for x, y in maps)


@dataclass(frozen=True, eq=False)
class GarmentFrame:
    """One garment at one time code.

    Attributes:
        points: Coarse positions [m], world space, shape (V, 3), float64.
        guide: Guide stiffness [N/m^3].
        detail: Gain of the added detail, 1 writes the solution itself.
        offset: Distance kept from colliders [m].
        acceleration: Acceleration of the coarse points that the cloth feels [m/s^2], shape (V, 3), as
            `inertia.felt` gives it; None where it feels none.
        load: Force of the air per area at the coarse points [N/m^2], shape (V, 3), as `air.load` gives it; None for
            calm air without a difference in pressure.
        limits: Distances that the cloth may be from its cage; None for no limits.
    """

    points: np.ndarray
    fabric: Fabric
    guide: float = 2000.0
    detail: float = 1.0
    offset: float = 0.002
    acceleration: np.ndarray | None = None
    load: np.ndarray | None = None
    limits: Limits | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """The stage at one time code.

    Attributes:
        time: The stage's own time code; None for a shot without samples.
        garments: One entry per garment of the scene, in its order.
        colliders: One entry per collider of the scene, in its order; None where a collider has no shape at this time.
    """

    time: float | None
    garments: tuple[GarmentFrame, ...]
    colliders: tuple[Pose | None, ...] = ()


@dataclass(frozen=True, eq=False)
class Scene:
    """The constant part of a shot.

    Attributes:
        garments: The garments to refine.
        gravity: Gravity [m/s^2], shape (3,).
        times: Time codes to refine, ascending; empty for a shot without samples.
        colliders: The bodies that garments may touch.
        seconds: Length of one time code [s].
    """

    garments: tuple[Garment, ...]
    gravity: np.ndarray
    times: tuple[float, ...] = ()
    colliders: tuple[Collider, ...] = ()
    seconds: float = 1.0 / 24.0


@dataclass(frozen=True, eq=False)
class GarmentResult:
    """One garment's result at one time code.

    Attributes:
        points: Fine positions [m], world space, shape (V, 3), float64; None where it was not asked for.
        telemetry: Plain numbers and words, ready for JSON.
        reused: Whether the input equalled the previous frame's, and its points were kept.
        heat: Heat maps where they were asked for: "penetration", depth in the deepest body [mm], and "crossing", 1 at
            corners of what crosses a face and 0 elsewhere, each of shape (V,), float32.
    """

    points: np.ndarray | None
    telemetry: dict[str, Any] = field(default_factory=dict)
    reused: bool = False
    heat: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Result:
    """The result at one time code.

    Attributes:
        time: The stage's own time code; None for a shot without samples.
        garments: One entry per garment of the scene, in its order; () if the frame could not be solved.
        telemetry: Values of the whole frame, ready for JSON; "error", a message, if it could not be solved.
    """

    time: float | None
    garments: tuple[GarmentResult, ...] = ()
    telemetry: dict[str, Any] = field(default_factory=dict)

    def as_changed(self) -> Result:
        """The result with no garment reused, to be written after any frame."""
        return replace(self, garments=tuple(replace(garment, reused=False) for garment in self.garments))


def recentred(garment: Garment) -> Garment:
    """The garment with its rest shape about the origin: far away, float32 would lose its edges."""
    if not len(garment.rest):
        return garment
    return replace(garment, rest=garment.rest - garment.rest.mean(axis=0))


@functools.lru_cache(maxsize=64)
def mean_edge(garment: Garment) -> float:
    """Mean edge of the cage at rest [m], 0 without edges."""
    lengths = _rest_edges(garment)
    return float(lengths.mean()) if len(lengths) else 0.0


@functools.lru_cache(maxsize=64)
def _median_edge(garment: Garment) -> float:
    """Median edge of a cage with edges at rest [m]."""
    return float(np.median(_rest_edges(garment)))


def _rest_edges(garment: Garment) -> np.ndarray:
    """Length of each edge of the cage at rest [m]."""
    ends = garment.mesh.half_edges.edges
    return np.linalg.norm(garment.rest[ends[:, 1]] - garment.rest[ends[:, 0]], axis=1)


def out_of_bounds(points: np.ndarray) -> str:
    """Which of positions [m], shape (V, 3), no kernel may see, not finite or beyond `FARTHEST`, in words; or ""."""
    if (np.abs(points) <= FARTHEST).all():
        return ""
    index = int((~(np.abs(points) <= FARTHEST).all(axis=1)).argmax())
    at = ", ".join(f"{value:g}" for value in points[index])
    return f"point {index} is at ({at}) m; it must be finite and at most {FARTHEST:g} m from the origin"


def refuse_far(scene: Scene, frame: Frame) -> None:
    """Refuse a frame with garments or bodies out of bounds; faces of bodies with NaN are left out later.

    Raises:
        GarmentError: With the prim, the time code and the point.
    """
    for garment, garment_frame in zip(scene.garments, frame.garments, strict=True):
        if problem := out_of_bounds(garment_frame.points) or _unsolvable(garment, garment_frame.points):
            raise GarmentError(garment.path, problem, time=frame.time, remedy=_REMEDY)
    for collider, pose in zip(scene.colliders, frame.colliders, strict=False):
        corners = np.zeros((0, 3)) if pose is None else pose.corners()
        corners = corners[~np.isnan(corners).any(axis=1)] if np.isnan(corners).any() else corners
        if problem := out_of_bounds(corners):
            raise GarmentError(collider.path, problem, time=frame.time, remedy=_REMEDY)


def _unsolvable(garment: Garment, points: np.ndarray) -> str:
    """Why no solve on a cage could end well, in words; or "".

    Its rest shape is a speck, or a vertex is so far from the others that single precision has no room for their edges.
    """
    ends = garment.mesh.half_edges.edges
    if not len(ends) or len(points) != len(garment.rest):
        return ""
    rest, size = _median_edge(garment), float(np.linalg.norm(extent(points)))
    if size <= OUTGROWN * rest and np.finfo(np.float32).eps * size <= RESOLVED * rest:
        return ""
    median = float(np.median(np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)))
    if median > OUTGROWN * rest > 0:
        shape = "those of its rest shape, to which cloth shrinks"
        return f"the cage's edges are of {median:.3g} m, {shape}, of {rest:.3g} m"
    edge = max(median, rest)
    used = np.zeros(len(points), bool)
    used[ends] = True
    away = np.where(used, np.linalg.norm(points - points[used].mean(axis=0), axis=1), 0.0)
    if np.finfo(np.float32).eps * away.max() <= RESOLVED * edge:
        return ""
    farthest = int(away.argmax())
    return f"point {farthest} is {away[farthest]:g} m from the garment's middle, whose edges are of {edge:g} m"


def refuse_falling(scene: Scene, frame: Frame) -> None:
    """Refuse a frame in which a garment would fall: its guide is too weak, and neither pins nor contact hold it.

    Without pins, colliders and other garments, a garment sinks by its weight per area w over the guide's stiffness.
    Held at one end, it stretches: a hanging strip of length L and modulus Y is longer by w L^2 / 2 Y.

    Raises:
        GarmentError: A garment would sink, or if held stretch, by `FALLS` times its size.
    """
    for garment, garment_frame in zip(scene.garments, frame.garments, strict=True):
        weight = garment_frame.fabric.density * float(np.linalg.norm(scene.gravity))
        supported = garment.colliders or (garment.pin > 0).any() or len(scene.garments) > 1
        size = max(SPECK, *(float(extent(x).max()) for x in (garment_frame.points, garment.rest)))
        guide, stretch = garment_frame.guide * float(garment.guide_scale.mean()), garment_frame.fabric.stretch
        if (garment.pin >= 1.0).all() or weight <= FALLS * size * guide:
            continue
        if not supported:
            sinks = "without end" if guide == 0 else f"by {weight / guide:.3g} m"
            problem = f"nothing holds it up but a guide of {garment_frame.guide:g} N/m^3: it would sink {sinks}"
            remedy = "raise physgraph:guide:stiffness, or pin it"
        elif weight * size > 2.0 * FALLS * stretch:
            longer = f"where it hangs it would be {weight * size**2 / (2.0 * stretch):.3g} m longer"
            problem = f"{stretch:g} N/m cannot carry its weight of {weight:.3g} N/m^2: {longer}"
            remedy = "raise physgraph:material:stretchStiffness or physgraph:guide:stiffness, or lower the density"
        else:
            continue
        raise GarmentError(garment.path, problem, time=frame.time, remedy=remedy)
