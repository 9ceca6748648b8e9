"""One resolution of the garments that are solved together: topology, rest shape and the maps between levels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import pairwise
from typing import NewType

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .fabric import Fabric
from .grain import SHORTEST, LevelGrain, axes, edge_cosines
from .mesh.defects import NO_AREA
from .mesh.elements import QUAD_SPRING, ElasticElements, elastic_elements, flat_rows, hinge_geometry
from .mesh.lengths import FOLDS, LENGTHS, NORMALS, ElementValues
from .mesh.recorded import Recordings
from .mesh.stencil import Stencil
from .mesh.subdivide import ControlMesh, Refinement, on_triangles, subdivide_times
from .mesh.topology import PolygonMesh, TriangleSplit, find_edges, sorted_rows
from .mesh.vectors import at_corners, cross, dot, inverse, mean_of, norm, product
from .scene import Garment
from .seen import vertex_normals

HINGE_SHAPE_LIMIT = 10.0
"""Cap of l0^2 / (A1 + A2): 1.15 on equilateral triangles, unbounded on slivers."""

OF_VERTICES = ("triangles", "edges", "springs", "membrane", "hinges")
"""Arrays of vertex numbers of a garment, and of the level."""

OWNED = {"vertex": "rest", "spring": "springs", "membrane": "membrane", "hinge": "hinges"}
"""Names of elements in the level's fields, and the arrays of a garment that hold them."""

PIN_MARGIN = 1e-6
"""A pin within this of 1 is exact."""

Placed = NewType("Placed", Tensor)
"""Positions of a level's cloth [m], shape (V, 3), at which nothing crosses that did not where the level began. Only a
start, a safe move, or the absence of anything to touch makes them; the type checker refuses any other positions."""


def unhindered(x: Tensor) -> Placed:
    """Positions of cloth that nothing may touch [m]."""
    return Placed(x)


@dataclass(frozen=True, eq=False)
class Level:
    """One resolution; tensors live on one device in one dtype, integers are int32.

    Attributes:
        index: 0 is the cage.
        spans: Vertex range of each garment.
        rest: Rest positions [m], shape (V, 3), linear between the cage's. Lengths, areas and angles at rest are of
            the smoothly subdivided cage, stretched to the cage's mean lengths around each cage vertex.
        triangles: Corner vertices of the surface that collides; a quad is two, shape (T, 3).
        edges: Their sides, shape (E, 2).
        springs: End vertices of the elastic springs, every edge among them, shape (S, 2).
        edge_spring: The spring along each edge, shape (E,).
        spring_length: Rest length [m], shape (S,).
        spring_area: A third of the adjacent triangles' areas [m^2], times `QUAD_SPRING` in quads, shape (S,).
        membrane: Corner vertices of the elastic triangles, shape (M, 3): all those of both splits of a quad.
        membrane_area: Rest area that each stands for [m^2], shape (M,): half of its own in a quad.
        membrane_inverse: Inverse of the rest sides in the material's axes [1/m], rows (a, b, c, d) of [[a, b], [c, d]],
            shape (M, 4); zero where a triangle has no area.
        sides: The spring along each side of the elastic triangles, shape (M, 3).
        hinges: Edge i-j and the corners opposite to it: k and k' of one face, l and l' of the other, shape (H, 6).
        hinge_spring: The spring along each hinge's edge, shape (H,).
        hinge_shape: Bending stiffness of a hinge over the fabric's, as `rest_shape` gives it, shape (H,).
        rest_angle: [rad], shape (H,).
        vertex_area: A third of the areas of the incident elastic triangles [m^2], shape (V,).
        spacing: Mean rest length of the incident springs [m], shape (V,).
        spring_garment, hinge_garment, vertex_garment, membrane_garment: Garment number of each element.
        spring_scale, membrane_scale: Painted multiplier of the stretch stiffness, times that of the faces' fabrics,
            shapes (S,) and (M,).
        bend_scale: Likewise of the bending stiffness, shape (H,).
        density_scale: Multiplier of the density by the faces' fabrics, shape (V,).
        pin: Painted pin weight, shape (V,); fixed where it is 1.
        from_coarse: Linear map from the cage, shape (V, C).
        smooth_from_coarse: Smooth map from the cage, shape (V, C).
        ups: Linear map to each level from the next coarser one, this level first; none at the first level.
        smooth_from_below: Smooth map from there, None at the first level.
        flat_from_below: Map onto the triangles of the level below, None at the first level.
        threads: Most threads that a kernel over the level uses on the CPU.
        grain: Which way warp and weft lie at its elements, or None where no garment says.
    """

    index: int
    spans: tuple[slice, ...]
    rest: Float[Tensor, "vertices 3"]
    triangles: Int[Tensor, "triangles 3"]
    edges: Int[Tensor, "edges 2"]
    springs: Int[Tensor, "springs 2"]
    edge_spring: Int[Tensor, " edges"]
    spring_length: Float[Tensor, " springs"]
    spring_area: Float[Tensor, " springs"]
    membrane: Int[Tensor, "membrane 3"]
    membrane_area: Float[Tensor, " membrane"]
    membrane_inverse: Float[Tensor, "membrane 4"]
    sides: Int[Tensor, "membrane 3"]
    hinges: Int[Tensor, "hinges 6"]
    hinge_spring: Int[Tensor, " hinges"]
    hinge_shape: Float[Tensor, " hinges"]
    rest_angle: Float[Tensor, " hinges"]
    vertex_area: Float[Tensor, " vertices"]
    spacing: Float[Tensor, " vertices"]
    spring_garment: Int[Tensor, " springs"]
    hinge_garment: Int[Tensor, " hinges"]
    vertex_garment: Int[Tensor, " vertices"]
    membrane_garment: Int[Tensor, " membrane"]
    spring_scale: Float[Tensor, " springs"]
    membrane_scale: Float[Tensor, " membrane"]
    bend_scale: Float[Tensor, " hinges"]
    density_scale: Float[Tensor, " vertices"]
    pin: Float[Tensor, " vertices"]
    from_coarse: sp.csr_matrix
    smooth_from_coarse: sp.csr_matrix
    ups: tuple[Stencil, ...]
    smooth_from_below: Stencil | None
    flat_from_below: Stencil | None
    threads: int = 1
    grain: LevelGrain | None = None

    def eased(self, fabrics: Sequence[Fabric]) -> Level:
        """The level with the rest lengths and areas of its garments' fabrics; this level if no fabric has ease."""
        if self.grain is None or not (self.grain.gathers or any(fabric.is_eased for fabric in fabrics)):
            return self
        ease = self.rest.new_tensor([[fabric.warp_ease, fabric.weft_ease] for fabric in fabrics])
        at_springs, at_membrane = (
            (1.0 + scale.unsqueeze(1) * ease[owner.long()] + torch.stack([0.0 * gather, gather], dim=1)).clamp_min(
                SHORTEST
            )
            for scale, gather, owner in (
                (self.grain.spring_scale, self.grain.spring_gather, self.spring_garment),
                (self.grain.membrane_scale, self.grain.membrane_gather, self.membrane_garment),
            )
        )
        return replace(
            self,
            spring_length=self.spring_length * (self.grain.spring * at_springs**2).sum(dim=1).sqrt(),
            spring_area=self.spring_area * at_springs.prod(dim=1),
            membrane_area=self.membrane_area * at_membrane.prod(dim=1),
            membrane_inverse=self.membrane_inverse / at_membrane.repeat(1, 2),
        )

    @cached_property
    def rest_length(self) -> Float[Tensor, " edges"]:
        """Rest lengths of the edges [m]."""
        return self.spring_length[self.edge_spring.long()]

    @property
    def dtype(self) -> torch.dtype:
        """Scalar type of the tensors."""
        return self.rest.dtype

    @cached_property
    def all_free(self) -> bool:
        """Whether no vertex is fixed."""
        return bool(self.free.all())

    @cached_property
    def recordings(self) -> Recordings:
        """Functions of the level's vertices, recorded on a card."""
        return Recordings()

    @property
    def device(self) -> str:
        """Device of the tensors."""
        return str(self.rest.device)

    @property
    def from_below(self) -> Stencil | None:
        """Linear map from the level below; None at the first level."""
        return self.ups[0] if self.ups else None

    @property
    def vertex_count(self) -> int:
        """Number of vertices V."""
        return self.rest.shape[0]

    @cached_property
    def free(self) -> Bool[Tensor, "vertices 1"]:
        """False where a vertex follows the coarse cloth exactly or belongs to no triangle."""
        return ((self.pin < 1.0 - PIN_MARGIN) & (self.vertex_area > 0)).unsqueeze(1)

    @cached_property
    def lengths(self) -> ElementValues:
        """Gives the edges' lengths at positions [m]."""
        return ElementValues(LENGTHS, self.edges, self.rest, shape=(), threads=self.threads)

    @cached_property
    def normals(self) -> ElementValues:
        """Gives the triangles' normals at positions [m], twice their areas long [m^2]."""
        return ElementValues(NORMALS, self.triangles, self.rest, shape=(3,), threads=self.threads)

    @cached_property
    def some_normals(self) -> ElementValues:
        """`normals` of every eighth triangle."""
        return ElementValues(NORMALS, self.triangles[::8], self.rest, shape=(3,), threads=self.threads)

    @cached_property
    def folds(self) -> ElementValues:
        """Gives the cosine of each hinge's angle at positions [m]."""
        return ElementValues(FOLDS, self.hinges, self.rest, shape=(), threads=self.threads)

    @cached_property
    def hinge_couplings(self) -> sp.csr_matrix:
        """The couplings along the springs of hinges of stiffness 1 N m, unfolded flat [1/m^2], shape (S, H).

        The Hessian of a hinge is row^T row (Bergou et al. 2006). Couplings between vertices across two triangles are
        left out: they double the time of a solve and hardly lower the energy at equal steps.
        """
        hinges, springs = self.hinges.cpu().numpy(), self.springs.cpu().numpy()
        rows = flat_rows(self.rest.double().cpu().numpy(), hinges).T.ravel()
        indices = hinges.ravel(), np.repeat(np.arange(len(hinges), dtype=np.int32), 6)
        by_vertex = sp.csr_matrix((rows, indices), shape=(self.vertex_count, len(hinges)))
        return sp.csr_matrix(-by_vertex[springs[:, 0]].multiply(by_vertex[springs[:, 1]]))

    @cached_property
    def base(self) -> Stencil:
        """Linear map from cage positions to this level."""
        return Stencil(self.from_coarse, dtype=self.dtype, device=self.device, threads=self.threads)

    @cached_property
    def smooth_base(self) -> Stencil:
        """Smooth map from cage positions to this level."""
        return Stencil(self.smooth_from_coarse, dtype=self.dtype, device=self.device, threads=self.threads)


def refine_garments(garments: Sequence[Garment], levels: Sequence[int]) -> list[tuple[Refinement, ...]]:
    """Subdivide each garment's cage.

    Args:
        levels: Number of subdivisions of each.

    Returns:
        The refinements of each garment, coarsest first.
    """
    return [subdivide_times(garment.mesh, level) for garment, level in zip(garments, levels, strict=True)]


def fine_meshes(garments: Sequence[Garment], refinements: Sequence[Sequence[Refinement]]) -> list[PolygonMesh]:
    """The finest mesh of each garment, given its refinements, coarsest first; the cage without any."""
    return [steps[-1].mesh if steps else cage.mesh for cage, steps in zip(garments, refinements, strict=True)]


def build_levels(
    garments: Sequence[Garment],
    refinements: Sequence[Sequence[Refinement]],
    *,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
    threads: int = 1,
) -> tuple[Level, ...]:
    """Build every level of garments that are solved together, the cage itself first.

    A garment with fewer subdivisions than its neighbours stays at its last level while they go on.

    Args:
        garments: Garments solved together.
        refinements: Their refinements, as `refine_garments` gives them.
        dtype: Scalar type of the tensors.
        threads: Most threads that a kernel uses on the CPU.

    Returns:
        Levels, coarsest first.
    """
    depth = max((len(chain) for chain in refinements), default=0)
    levels: list[Level] = []
    carried = [_carried(g, chain) for g, chain in zip(garments, refinements, strict=True)]
    for index in range(depth + 1):
        parts = [_garment_level(g, *next(meshes)) for g, meshes in zip(garments, carried, strict=True)]
        below: list[Stencil | None] = [None, None]
        ups = tuple[Stencil, ...]()
        if index:
            maps = zip(*((part.linear_step, part.smooth_step, part.flat_step) for part in parts), strict=True)
            joined = [sp.csr_matrix(sp.block_diag(blocks)) for blocks in maps] or [sp.csr_matrix((0, 0))] * 3
            up, smooth, flat = (Stencil(matrix, dtype=dtype, device=device, threads=threads) for matrix in joined)
            below = [smooth, flat if abs(joined[2] - joined[0]).sum() > 0 else up]
            ups = (up, *levels[-1].ups)
        levels.append(_join(index, parts, below, ups=ups, dtype=dtype, device=device, threads=threads))
    return tuple(levels)


@dataclass(frozen=True, eq=False)
class _GarmentLevel:
    rest: np.ndarray
    smooth_rest: np.ndarray
    metric: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray
    elements: ElasticElements
    bent: np.ndarray
    pressed: np.ndarray
    vertex_values: dict[str, np.ndarray]
    warp: np.ndarray | None
    fabric: np.ndarray
    linear: sp.csr_matrix
    smooth: sp.csr_matrix
    linear_step: sp.csr_matrix
    smooth_step: sp.csr_matrix
    flat_step: sp.csr_matrix


def _garment_level(
    garment: Garment, cage: ControlMesh, face: np.ndarray, maps: dict[str, sp.csr_matrix]
) -> _GarmentLevel:
    """Arrays of a garment at one level, given mesh, cage faces and maps from `_carried`."""
    linear, smoothing, mesh = maps["linear"], maps["smooth"], cage.mesh
    always = np.unique(np.sort(cage.ends[np.isinf(cage.creases)], axis=1), axis=0)
    rest, smooth_rest = (np.asarray(matrix @ np.asarray(garment.rest, np.float64)) for matrix in (linear, smoothing))
    split = _sound(mesh.triangulate(rest if mesh is garment.mesh else None), rest, rigid=_is_rigid(garment, linear))
    elements = elastic_elements(mesh, split, rest)
    # Along normals only: what smoothing moves within the surface would strain a flat cage.
    normal = vertex_normals(smooth_rest, elements.membrane)
    smooth_rest = rest + ((smooth_rest - rest) * normal).sum(axis=1, keepdims=True) * normal
    painted = {name: getattr(garment, name) for name in ("stretch_scale", "bend_scale", "pin")}
    if garment.grain is not None:
        painted |= {"ease_scale": garment.grain.ease_scale, "gather": garment.grain.gather}
    scale = np.ones((garment.mesh.face_count, 3)) if garment.fabric_scale is None else garment.fabric_scale
    return _GarmentLevel(
        rest=rest,
        smooth_rest=smooth_rest,
        metric=_metric_of(linear, elements, rest, smooth_rest),
        triangles=split.triangles,
        edges=elements.springs[elements.edge_spring],
        elements=elements,
        bent=garment.bent_rest | (find_edges(always, elements.hinges[:, :2]) >= 0),
        pressed=_pressed_angles(garment, elements, linear=linear, smoothing=smoothing),
        vertex_values={name: np.asarray(linear @ values.astype(np.float64)) for name, values in painted.items()},
        warp=None if garment.grain is None else garment.grain.warp[face[elements.face]],
        fabric=scale[face[elements.face]],
        **maps,
    )


def _pressed_angles(
    garment: Garment, elements: ElasticElements, *, linear: sp.csr_matrix, smoothing: sp.csr_matrix
) -> np.ndarray:
    """Rest angles of pressed folds [rad], shape (H,): those of the smooth folded cage, fading within a cage edge."""
    if garment.pressed is None or garment.folded is None:
        return np.zeros(len(elements.hinges))
    angle = hinge_geometry(np.asarray(smoothing @ garment.folded), elements.hinges)[0]
    share = np.asarray(linear @ garment.pressed.astype(np.float64))
    return angle * mean_of(share, elements.hinges[:, :2])


def _carried(
    garment: Garment, chain: Sequence[Refinement]
) -> Iterator[tuple[ControlMesh, np.ndarray, dict[str, sp.csr_matrix]]]:
    """A garment's mesh at each level with what is sharp, the cage's face of each face, and its maps by name.

    Maps from the level below are the identity where the garment stays at the end of its chain.
    """
    mesh, face = garment.mesh, np.arange(garment.mesh.face_count)
    linear = smoothing = sp.identity(mesh.vertex_count, format="csr")
    cage = garment.control
    steps = dict.fromkeys(("linear_step", "smooth_step", "flat_step"), linear)
    for number, refinement in enumerate(chain):
        yield cage, face, {"linear": linear, "smooth": smoothing} | steps
        smooth_step, cage = cage.subdivided(refinement)
        flat_step = on_triangles(mesh, refinement, mesh.triangulate(None if number else garment.rest))
        steps = {"linear_step": refinement.linear, "smooth_step": smooth_step, "flat_step": flat_step}
        smoothing, linear = sp.csr_matrix(smooth_step @ smoothing), sp.csr_matrix(refinement.linear @ linear)
        mesh, face = refinement.mesh, face[refinement.parent_face]
    while True:
        yield cage, face, {"linear": linear, "smooth": smoothing} | steps
        steps = dict.fromkeys(steps, sp.identity(mesh.vertex_count, format="csr"))


def _metric_of(
    linear: sp.csr_matrix, elements: ElasticElements, rest: np.ndarray, smooth_rest: np.ndarray
) -> np.ndarray:
    """The metric S of the cloth on the smooth rest surface, shape (V, 9), by rows: a vector d is (d.S d)^1/2 long.

    Smooth subdivision shortens a curved cage, across a fold but not along the fold. S gives the cage's lengths,
    averaged around each cage vertex; along the normal S is 1. With areas kept but not lengths, cloth would be too long
    along folds, and crumple.

    Args:
        linear: Linear map from the cage, shape (V, C).
        elements: Elastic elements.
        rest: The cage's rest positions on the mesh, linearly [m], shape (V, 3).
        smooth_rest: The same smoothly [m].
    """
    triangles = elements.membrane
    cage, surface = (x[1:] - x[0] for x in (at_corners(rest, triangles), at_corners(smooth_rest, triangles)))
    normal = cross(*surface)
    double = norm(normal)
    has_area = 0.5 * double > 1e-9 * (surface**2).reshape(6, -1).sum(axis=0)
    gram, lengths = (np.stack([[dot(a, b) for b in vectors] for a in vectors]) for vectors in (surface, cage))
    dual = product(inverse(np.where(has_area, gram, np.eye(2)[:, :, None])), surface)
    normal /= np.where(has_area, double, 1.0)
    tensor = product(product(dual.swapaxes(0, 1), lengths), dual) + normal[:, None] * normal
    tensor[:, :, ~has_area] = np.eye(3)[:, :, None]
    weight, starts = np.repeat(elements.share * (0.5 * double), 3), np.arange(0, 3 * len(triangles) + 1, 3)
    vertices = np.sort(triangles, axis=1).ravel()
    around = linear.T @ sp.csc_matrix((weight, vertices, starts), shape=(len(rest), len(triangles)))
    total, mean = np.asarray(around.sum(axis=1)), np.asarray(around @ tensor.reshape(9, -1).T)
    mean = np.where(total > 0, mean / np.where(total > 0, total, 1.0), np.eye(3).ravel())
    return np.asarray(linear @ mean)


def _in_cloth(vectors: np.ndarray, metric: np.ndarray) -> np.ndarray:
    """Tangent vectors of the smooth rest surface in the cloth's lengths and angles: S^1/2 times the vectors.

    Args:
        vectors: Two sides of each triangle [m], and more vectors in the triangle's plane, shape (K, 3, T).
        metric: S, shape (3, 3, T).
    """
    second = cross(cross(vectors[0], vectors[1]), vectors[0])
    axes = np.stack([vector / norm(vector).clip(np.finfo(float).tiny) for vector in (vectors[0], second)])
    plane = product(product(axes, metric), axes.swapaxes(0, 1))
    root = np.sqrt((plane[0, 0] * plane[1, 1] - plane[0, 1] ** 2).clip(0.0))
    trace = (plane[0, 0] + plane[1, 1] + 2.0 * root).clip(np.finfo(float).tiny)
    plane += root * np.eye(2)[:, :, None]  # The square root of a 2 x 2 matrix, by Cayley and Hamilton.
    return product(product(product(vectors, axes.swapaxes(0, 1)), plane) / np.sqrt(trace), axes)


def _is_rigid(garment: Garment, linear: sp.csr_matrix) -> np.ndarray:
    """Whether each vertex of a level belongs to a rigid part, shape (V,)."""
    parts = np.full(len(garment.rest), -1) if garment.rigid is None else garment.rigid
    return np.asarray(linear @ (parts >= 0).astype(np.float64)) > 0.0


def _sound(split: TriangleSplit, rest: np.ndarray, *, rigid: np.ndarray) -> TriangleSplit:
    """The triangles that are cloth: not rigid, not without rest area, and none twice."""
    corners = at_corners(rest, split.triangles)
    sides = corners - np.roll(corners, 1, axis=0)
    area = 0.5 * norm(cross(sides[0], sides[1]))
    valid = (area > NO_AREA * (sides**2).sum(axis=1).max(axis=0)) & ~rigid[split.triangles[:, 0]]
    rows = np.sort(split.triangles, axis=1).T
    order = sorted_rows(*rows, count=len(rest))
    valid[order[1:][(rows[:, order[1:]] == rows[:, order[:-1]]).all(axis=0)]] = False
    return split if valid.all() else TriangleSplit(split.triangles[valid], split.face[valid])


def _join(
    index: int,
    parts: Sequence[_GarmentLevel],
    below: Sequence[Stencil | None],
    *,
    ups: tuple[Stencil, ...],
    dtype: torch.dtype,
    device: str,
    threads: int,
) -> Level:
    """Concatenate garments into one level, with lengths, areas and angles at rest."""
    joined, starts = _joined(parts), np.cumsum([0, *(len(part.rest) for part in parts)])
    names = (*OF_VERTICES, "sides", "edge_spring", "hinge_spring", *(f"{element}_garment" for element in OWNED))
    integers = {name: joined[name] for name in names}
    warp, grain = _grain(parts, joined)
    real = _measured(joined, warp=warp)
    tensors = {n: torch.as_tensor(np.ascontiguousarray(a), dtype=dtype, device=device) for n, a in grain.items()}
    return Level(
        index=index,
        spans=tuple(slice(int(a), int(b)) for a, b in pairwise(starts)),
        **{n: torch.as_tensor(np.ascontiguousarray(a), dtype=dtype, device=device) for n, a in real.items()},
        **{n: torch.as_tensor(np.ascontiguousarray(a, dtype=np.int32), device=device) for n, a in integers.items()},
        from_coarse=sp.csr_matrix(sp.block_diag([part.linear for part in parts])),
        smooth_from_coarse=sp.csr_matrix(sp.block_diag([part.smooth for part in parts])),
        ups=ups,
        smooth_from_below=below[0],
        flat_from_below=below[1],
        threads=threads,
        grain=LevelGrain(**tensors) if tensors else None,
    )


def _joined(parts: Sequence[_GarmentLevel]) -> dict[str, np.ndarray]:
    """Arrays of all garments by name, and the garment number of each element."""
    tables = [vars(part) | vars(part.elements) | part.vertex_values for part in parts]
    names = "rest smooth_rest metric share twists bent pressed fabric stretch_scale bend_scale pin".split()
    joined = {name: np.concatenate([table[name] for table in tables]) for name in names}
    for names, counted in ((OF_VERTICES, "rest"), (("sides", "edge_spring", "hinge_spring"), "springs")):
        starts = np.cumsum([0, *(len(table[counted]) for table in tables)])
        for name in names:
            joined[name] = np.concatenate([table[name] + start for table, start in zip(tables, starts, strict=False)])
    for name, owned in OWNED.items():
        joined[f"{name}_garment"] = np.repeat(np.arange(len(tables)), [len(table[owned]) for table in tables])
    return joined


def _grain(
    parts: Sequence[_GarmentLevel], joined: dict[str, np.ndarray]
) -> tuple[np.ndarray | None, dict[str, np.ndarray]]:
    """The warp's direction on each membrane triangle, shape (3, M), 0 where unknown, and `LevelGrain`'s fields."""
    triangles, springs = joined["membrane"], joined["springs"]
    if all(part.warp is None for part in parts):
        return None, {}
    warp = np.concatenate([np.zeros((len(p.elements.membrane), 3)) if p.warp is None else p.warp for p in parts]).T
    cosines = edge_cosines(joined["rest"], triangles, joined["sides"], count=len(springs), warp=warp)
    scale, gather = (
        np.concatenate([part.vertex_values.get(name, np.full(len(part.rest), none)) for part in parts])
        for name, none in (("ease_scale", 1.0), ("gather", 0.0))
    )
    along, across = cosines[joined["hinge_spring"]].T
    return warp, {
        "spring": cosines,
        "hinge": np.where(joined["twists"], 0.0, across - along),  # A hinge bends across its edge; a twist is both.
        "spring_scale": mean_of(scale, springs),
        "membrane_scale": mean_of(scale, triangles),
        "spring_gather": mean_of(gather, springs),
        "membrane_gather": mean_of(gather, triangles),
    }


def _measured(joined: dict[str, np.ndarray], *, warp: np.ndarray | None) -> dict[str, np.ndarray]:
    """The real-valued fields of a level by name."""
    springs, triangles, surface, fabric = (joined[name] for name in ("springs", "membrane", "smooth_rest", "fabric"))
    corners, metric = at_corners(surface, triangles), joined["metric"].T.reshape(3, 3, -1)
    vectors = np.concatenate([corners[1:] - corners[:1], *([] if warp is None else [warp[None]])])
    vectors = _in_cloth(vectors, mean_of(metric, triangles))
    span, around = np.subtract(*at_corners(surface, springs)[::-1]), mean_of(metric, springs)
    square = reduce(np.add, (span[i] * around[i, j] * span[j] for i in range(3) for j in range(3)))
    area = joined["share"] * (0.5 * norm(cross(vectors[0], vectors[1])))
    of_stretch, of_bend, of_density = np.repeat(fabric, 3, axis=0).T
    sides = joined["sides"].ravel()
    at_hinges = mean_at(sides, of_bend, len(springs))[joined["hinge_spring"]]
    return rest_shape(joined, length=np.sqrt(square.clip(0.0)), area=area) | {
        "rest": joined["rest"],
        "membrane_inverse": triangle_inverse(vectors[:2], None if warp is None else vectors[2]),
        "spring_scale": mean_of(joined["stretch_scale"], springs) * mean_at(sides, of_stretch, len(springs)),
        "membrane_scale": mean_of(joined["stretch_scale"], triangles) * fabric[:, 0],
        "bend_scale": mean_of(joined["bend_scale"], joined["hinges"][:, :2]) * at_hinges,
        "density_scale": mean_at(triangles.ravel(), of_density, len(surface), weight=np.repeat(area, 3)),
        "pin": joined["pin"],
    }


def mean_at(elements: np.ndarray, values: np.ndarray, count: int, *, weight: np.ndarray | None = None) -> np.ndarray:
    """Mean of the values at each of some elements, shape (count,); 1 at an element without values.

    Args:
        elements: Element of each value, shape (K,).
        values: Shape (K,).
        count: Number of elements.
        weight: Weight of each value, shape (K,); None for equal weights.
    """
    if (values == 1.0).all():
        return np.ones(count)
    weight = np.ones(len(elements)) if weight is None else weight
    total = np.bincount(elements, weight, count)
    return np.divide(np.bincount(elements, weight * values, count), total, out=np.ones(count), where=total > 0)


def rest_shape(joined: dict[str, np.ndarray], *, length: np.ndarray, area: np.ndarray) -> dict[str, np.ndarray]:
    """Lengths, areas and angles of the rest shape, under the names of `Level`'s fields.

    The bending energy of a sheet is D/2 (k1^2 + k2^2) by its principal curvatures. A hinge at an edge l between
    triangles of areas A1 and A2 bends across l: D l^2 / (A1 + A2) times half its angle squared. On a grid of rectangles
    these leave out D k12^2, the twist along the sides. Round the diagonal l of a rectangle of area A the angle is
    k12 l, so that hinge has 2 D A / l^2.

    Args:
        joined: Arrays by name, from `_joined`: smooth_rest [m] (V, 3), springs (S, 2), membrane (M, 3), sides (M, 3),
            share (M,), hinges (H, 6), twists, bent and pressed angles [rad] (H,).
        length: Length of each spring in the cloth [m], shape (S,).
        area: Area that each triangle stands for in the cloth [m^2], shape (M,).

    Returns:
        spring_length, spring_area, membrane_area, hinge_shape, rest_angle, vertex_area, spacing.
    """
    count, springs, twists = len(joined["rest"]), joined["springs"], joined["twists"]
    factor = np.where((joined["share"] < 1.0)[:, None], np.array(QUAD_SPRING)[[0, 0, 1]], 1.0)
    spring_area = np.bincount(joined["sides"].ravel(), (factor * area[:, None] / 3.0).ravel(), len(springs))
    degree = np.bincount(springs.ravel(), minlength=count)
    spacing = np.bincount(springs.ravel(), np.repeat(length, 2), count) / np.maximum(degree, 1)
    fallback = float(length.mean()) if len(length) else 1.0
    angle, first, second, hinge_length = hinge_geometry(joined["smooth_rest"], joined["hinges"])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = hinge_length**2 / (first + second)
        hinge_shape = np.where(twists, 2.0 / ratio, np.minimum(ratio, HINGE_SHAPE_LIMIT))
    return {
        "spring_length": np.maximum(length, 1e-9 * fallback),
        "spring_area": spring_area,
        "membrane_area": area,
        "hinge_shape": np.nan_to_num(hinge_shape, nan=0.0),
        "rest_angle": np.where(joined["bent"], angle, joined["pressed"]),
        "vertex_area": np.bincount(joined["membrane"].ravel(), np.repeat(area, 3) / 3.0, count),
        "spacing": np.where(spacing > 0, spacing, fallback),
    }


def triangle_inverse(sides: np.ndarray, warp: np.ndarray | None = None) -> np.ndarray:
    """Inverse of each triangle's sides in the material's axes, which are warp and weft (`axes`).

    Args:
        sides: Two sides from the first corner of each triangle [m], shape (2, 3, T), float64.
        warp: Direction of the warp on each triangle, shape (3, T), 0 where unknown; None where it is on all.

    Returns:
        Rows of the inverse [1/m], shape (T, 4), zero where there is no area.
    """
    double = norm(cross(*sides))
    along, across = axes(sides, np.zeros_like(sides[0]) if warp is None else warp)
    a, b, c, d = (dot(side, axis) for axis in (along, across) for side in sides)
    squares = (sides**2).sum(axis=1)
    has_area = double > 1e-12 * (squares[0] + squares[1])
    return np.where(has_area, np.stack([d, -b, -c, a]) / np.where(has_area, double, 1.0), 0.0).T
