"""One resolution of the garments that are solved together: topology, rest shape and the maps between levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NewType

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .fabric import Fabric
from .grain import SHORTEST, LevelGrain, axes, edge_cosines
from .mesh.defects import FLAT
from .mesh.lengths import ANGLES, LENGTHS, NORMALS, ElementValues
from .mesh.stencil import Stencil
from .mesh.subdivide import Refinement, on_triangles, smooth, subdivide_times
from .mesh.topology import TriangleSplit, edges_of, find_edges, hinges_of, quad_edges
from .scene import Garment

HINGE_SHAPE_LIMIT = 10.0
"""Cap of l0^2 / (A1 + A2): 1.15 on equilateral triangles, unbounded on slivers."""

QUAD_SPRING = (0.75, 1.5)
"""Factors of the springs along a quad's sides and diagonal: with them squares whose diagonals alternate, as subdivision
splits them, are isotropic with nu = 1/3; else Y varies from 0.75 to 1.2 with direction (docs/notes/calibration.md)."""

QUAD_HINGE = (1.28, 0.64)
"""Such factors of hinges: D is then 1 in all directions instead of 0.86 to 1.36."""

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
        rest: Rest positions [m], shape (V, 3).
        triangles: Corner vertices, shape (T, 3).
        edges: End vertices, shape (E, 2).
        hinges: Edge i-j, then the opposite vertices k and l, shape (H, 4).
        rest_length: [m], shape (E,).
        edge_area: A third of the adjacent triangles' areas [m^2], shape (E,).
        edge_factor: `QUAD_SPRING` on edges of quads, 1 on edges of triangles, shape (E,).
        hinge_shape: l0^2 / (A1 + A2), clamped, shape (H,).
        hinge_factor: `QUAD_HINGE` on edges of quads, 1 on edges of triangles, shape (H,).
        hinge_area: A third of the two triangles' areas [m^2], shape (H,).
        rest_angle: [rad], shape (H,).
        vertex_area: A third of the incident triangles' areas [m^2], shape (V,).
        spacing: Mean rest length of the incident edges [m], shape (V,).
        triangle_area: Rest area [m^2], shape (T,).
        triangle_inverse: Inverse of the rest sides in the material's axes [1/m], rows (a, b, c, d) of [[a, b], [c, d]],
            shape (T, 4); zero where a triangle has no area.
        edge_garment, hinge_garment, vertex_garment, triangle_garment: Garment number of each element.
        stretch_scale: Painted multiplier, shape (E,).
        triangle_scale: The same multiplier for triangles, shape (T,).
        bend_scale: Painted multiplier, shape (H,).
        pin: Painted pin weight, shape (V,); fixed where it is 1.
        from_coarse: Linear map from the cage, shape (V, C).
        smooth_from_coarse: Smooth map from the cage, shape (V, C).
        from_below: Linear map from the level below, None at the first level.
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
    hinges: Int[Tensor, "hinges 4"]
    rest_length: Float[Tensor, " edges"]
    edge_area: Float[Tensor, " edges"]
    edge_factor: Float[Tensor, " edges"]
    hinge_shape: Float[Tensor, " hinges"]
    hinge_factor: Float[Tensor, " hinges"]
    hinge_area: Float[Tensor, " hinges"]
    rest_angle: Float[Tensor, " hinges"]
    vertex_area: Float[Tensor, " vertices"]
    spacing: Float[Tensor, " vertices"]
    triangle_area: Float[Tensor, " triangles"]
    triangle_inverse: Float[Tensor, "triangles 4"]
    edge_garment: Int[Tensor, " edges"]
    hinge_garment: Int[Tensor, " hinges"]
    vertex_garment: Int[Tensor, " vertices"]
    triangle_garment: Int[Tensor, " triangles"]
    stretch_scale: Float[Tensor, " edges"]
    triangle_scale: Float[Tensor, " triangles"]
    bend_scale: Float[Tensor, " hinges"]
    pin: Float[Tensor, " vertices"]
    from_coarse: sp.csr_matrix
    smooth_from_coarse: sp.csr_matrix
    from_below: Stencil | None
    smooth_from_below: Stencil | None
    flat_from_below: Stencil | None
    threads: int = 1
    grain: LevelGrain | None = None

    def eased(self, fabrics: Sequence[Fabric]) -> Level:
        """The level with the rest lengths and areas that its garments' fabrics have; itself where none has ease."""
        if self.grain is None or not (self.grain.gathers or any(each.is_eased for each in fabrics)):
            return self
        ease = self.rest.new_tensor([[each.warp_ease, each.weft_ease] for each in fabrics])
        at_edges, at_triangles = (
            (1.0 + scale.unsqueeze(1) * ease[owner.long()] + torch.stack([0.0 * gather, gather], dim=1)).clamp_min(
                SHORTEST
            )
            for scale, gather, owner in (
                (self.grain.edge_scale, self.grain.edge_gather, self.edge_garment),
                (self.grain.triangle_scale, self.grain.triangle_gather, self.triangle_garment),
            )
        )
        return replace(
            self,
            rest_length=self.rest_length * (self.grain.edge * at_edges**2).sum(dim=1).sqrt(),
            edge_area=self.edge_area * at_edges.prod(dim=1),
            triangle_area=self.triangle_area * at_triangles.prod(dim=1),
            triangle_inverse=self.triangle_inverse / at_triangles.repeat(1, 2),
        )

    @property
    def dtype(self) -> torch.dtype:
        """Scalar type of the tensors."""
        return self.rest.dtype

    @property
    def device(self) -> str:
        """Device of the tensors."""
        return str(self.rest.device)

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
    def angles(self) -> ElementValues:
        """Gives the hinges' signed angles at positions [m], in [-pi, pi]."""
        return ElementValues(ANGLES, self.hinges, self.rest, shape=(), threads=self.threads)

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
        garments: The garments.
        levels: Number of subdivisions of each.

    Returns:
        The refinements of each garment, coarsest first.
    """
    return [subdivide_times(garment.mesh, level) for garment, level in zip(garments, levels, strict=True)]


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
        device: Their device.
        threads: Most threads that a kernel uses on the CPU.

    Returns:
        Levels, coarsest first.
    """
    depth = max((len(chain) for chain in refinements), default=0)
    levels: list[Level] = []
    for index in range(depth + 1):
        parts = [_garment_level(g, chain, index) for g, chain in zip(garments, refinements, strict=True)]
        below: list[Stencil | None] = [None] * 3
        if index:
            maps = zip(*((part.linear_step, part.smooth_step, part.flat_step) for part in parts), strict=True)
            whole = [sp.csr_matrix(sp.block_diag(each)) for each in maps] or [sp.csr_matrix((0, 0))] * 3
            below = [Stencil(each, dtype=dtype, device=device, threads=threads) for each in whole]
            below[2] = below[2] if abs(whole[2] - whole[0]).sum() > 0 else below[0]
        levels.append(_join(index, parts, below, dtype=dtype, device=device, threads=threads))
    return tuple(levels)


@dataclass(frozen=True, eq=False)
class _GarmentLevel:
    """One garment at one level, in numpy."""

    vertex_count: int
    rest: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray
    hinges: np.ndarray
    edge_factor: np.ndarray
    hinge_factor: np.ndarray
    bent_rest: bool
    vertex_values: dict[str, np.ndarray]
    warp: np.ndarray | None
    linear: sp.csr_matrix
    smooth: sp.csr_matrix
    linear_step: sp.csr_matrix
    smooth_step: sp.csr_matrix
    flat_step: sp.csr_matrix


def _garment_level(garment: Garment, whole: Sequence[Refinement], index: int) -> _GarmentLevel:
    """Carry one garment to a level, or to the end of its chain of refinements, at which it stays."""
    mesh, chain = garment.mesh, whole[:index]
    linear = smoothing = linear_step = smooth_step = flat_step = sp.identity(mesh.vertex_count, format="csr")
    face = np.arange(mesh.face_count)
    for number, refinement in enumerate(chain):
        split = mesh.triangulate(None if number else garment.rest)
        flat_step = on_triangles(mesh, refinement, split)
        linear_step, smooth_step = refinement.linear, sp.csr_matrix(smooth(mesh, refinement))
        smoothing, linear = sp.csr_matrix(smooth_step @ smoothing), sp.csr_matrix(linear_step @ linear)
        mesh, face = refinement.mesh, face[refinement.parent_face]
    if index > len(chain):
        linear_step = smooth_step = flat_step = sp.identity(mesh.vertex_count, format="csr")
    rest = np.asarray(linear @ np.asarray(garment.rest, dtype=np.float64))
    split = _sound(mesh.triangulate(rest if not chain else None), rest)
    triangles, hinges = split.triangles, hinges_of(split.triangles)
    edges = edges_of(triangles, mesh.vertex_count).vertices
    from_quad, diagonal = quad_edges(split, mesh.counts, edges)
    edge_factor, at_edge = (1.0 + from_quad * (np.where(diagonal, f[1], f[0]) - 1.0) for f in (QUAD_SPRING, QUAD_HINGE))
    painted = {name: getattr(garment, name) for name in ("stretch_scale", "bend_scale", "pin")}
    if garment.grain is not None:
        painted |= {"ease_scale": garment.grain.ease_scale, "gather": garment.grain.gather}
    return _GarmentLevel(
        vertex_count=mesh.vertex_count,
        rest=rest,
        triangles=triangles,
        edges=edges,
        hinges=hinges,
        edge_factor=edge_factor,
        hinge_factor=at_edge[find_edges(edges, hinges[:, :2])],
        bent_rest=garment.bent_rest,
        vertex_values={name: np.asarray(linear @ each.astype(np.float64)) for name, each in painted.items()},
        warp=None if garment.grain is None else garment.grain.warp[face[split.face]],
        linear=linear,
        smooth=smoothing,
        linear_step=linear_step,
        smooth_step=smooth_step,
        flat_step=flat_step,
    )


def _sound(split: TriangleSplit, rest: np.ndarray) -> TriangleSplit:
    """Without triangles that have no rest area or repeat an earlier one: they are no cloth."""
    corners = rest[split.triangles]
    sides = corners - np.roll(corners, 1, axis=1)
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    valid = np.zeros(len(area), bool)
    valid[np.unique(np.sort(split.triangles, axis=1), axis=0, return_index=True)[1]] = True
    valid &= area > FLAT * (sides**2).sum(axis=2).max(axis=1)
    return split if valid.all() else TriangleSplit(split.triangles[valid], split.face[valid])


def _join(
    index: int,
    parts: Sequence[_GarmentLevel],
    below: Sequence[Stencil | None],
    *,
    dtype: torch.dtype,
    device: str,
    threads: int,
) -> Level:
    """Concatenate garments into one level and measure its rest shape."""
    counts = [part.vertex_count for part in parts]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    elements = {
        name: np.concatenate([getattr(part, name) + start for part, start in zip(parts, starts, strict=False)])
        for name in ("triangles", "edges", "hinges")
    }
    owners = {"vertex_garment": counts}
    owners |= {f"{name[:-1]}_garment": [len(getattr(part, name)) for part in parts] for name in elements}
    whole = elements | {name: np.repeat(np.arange(len(parts)), sizes) for name, sizes in owners.items()}
    warp, grain = _grain(parts, elements)
    real = _measured(parts, elements["triangles"], elements["edges"], hinges=elements["hinges"], warp=warp)
    tensors = {n: torch.as_tensor(np.ascontiguousarray(a), dtype=dtype, device=device) for n, a in grain.items()}
    return Level(
        index=index,
        spans=tuple(slice(int(a), int(b)) for a, b in pairwise(starts)),
        **{n: torch.as_tensor(np.ascontiguousarray(a), dtype=dtype, device=device) for n, a in real.items()},
        **{n: torch.as_tensor(np.ascontiguousarray(a, dtype=np.int32), device=device) for n, a in whole.items()},
        from_coarse=sp.csr_matrix(sp.block_diag([part.linear for part in parts])),
        smooth_from_coarse=sp.csr_matrix(sp.block_diag([part.smooth for part in parts])),
        from_below=below[0],
        smooth_from_below=below[1],
        flat_from_below=below[2],
        threads=threads,
        grain=LevelGrain(**tensors) if tensors else None,
    )


def _grain(parts: Sequence[_GarmentLevel], elements: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The warp's direction on each triangle, shape (T, 3), 0 where unknown, and the fields of `LevelGrain`, if any."""
    triangles, edges, hinges = (elements[name] for name in ("triangles", "edges", "hinges"))
    if all(part.warp is None for part in parts):
        return np.zeros((len(triangles), 3)), {}
    rest = np.concatenate([part.rest for part in parts])
    warp = np.concatenate([np.zeros((len(p.triangles), 3)) if p.warp is None else p.warp for p in parts])
    cosines = edge_cosines(rest, triangles, edges, warp=warp)
    scale, gather = (
        np.concatenate([part.vertex_values.get(name, np.full(part.vertex_count, none)) for part in parts])
        for name, none in (("ease_scale", 1.0), ("gather", 0.0))
    )
    along = cosines[find_edges(edges, hinges[:, :2])]
    return warp, {
        "edge": cosines,
        "hinge": along[:, 1] - along[:, 0],  # A hinge bends across its edge.
        "edge_scale": scale[edges].mean(axis=1),
        "triangle_scale": scale[triangles].mean(axis=1),
        "edge_gather": gather[edges].mean(axis=1),
        "triangle_gather": gather[triangles].mean(axis=1),
    }


def _measured(
    parts: Sequence[_GarmentLevel], triangles: np.ndarray, edges: np.ndarray, *, hinges: np.ndarray, warp: np.ndarray
) -> dict[str, np.ndarray]:
    """Every real-valued field of a level, under its name there."""
    rest = np.concatenate([part.rest for part in parts])
    bent = np.repeat([part.bent_rest for part in parts], [len(part.hinges) for part in parts])
    area, inverse = triangle_shape(rest, triangles, warp)
    stretch, bend, pin = (
        np.concatenate([part.vertex_values[name] for part in parts]) for name in ("stretch_scale", "bend_scale", "pin")
    )
    return rest_shape(rest, triangles, edges, hinges, bent=bent) | {
        "rest": rest,
        "edge_factor": np.concatenate([part.edge_factor for part in parts]),
        "hinge_factor": np.concatenate([part.hinge_factor for part in parts]),
        "triangle_area": area,
        "triangle_inverse": inverse,
        "stretch_scale": stretch[edges].mean(axis=1),
        "triangle_scale": stretch[triangles].mean(axis=1),
        "bend_scale": bend[hinges[:, :2]].mean(axis=1),
        "pin": pin,
    }


def rest_shape(
    rest: np.ndarray, triangles: np.ndarray, edges: np.ndarray, hinges: np.ndarray, *, bent: np.ndarray
) -> dict[str, np.ndarray]:
    """Lengths, areas and angles of the rest shape, under the names of `Level`'s fields.

    Args:
        rest: Rest positions [m], shape (V, 3), float64.
        triangles: Shape (T, 3).
        edges: Shape (E, 2).
        hinges: Shape (H, 4).
        bent: True where a hinge rests at the rest shape's angle, shape (H,).

    Returns:
        rest_length, edge_area, hinge_shape, hinge_area, rest_angle, vertex_area, spacing.
    """
    count = len(rest)
    corners = rest[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    length = np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)
    edge_of_side = find_edges(edges, triangles[:, [[0, 1], [1, 2], [2, 0]]])
    edge_area = np.bincount(edge_of_side, np.repeat(area, 3) / 3.0, len(edges)) if len(edges) else np.zeros(0)
    vertex_area = np.bincount(triangles.ravel(), np.repeat(area, 3) / 3.0, count)
    degree = np.bincount(edges.ravel(), minlength=count)
    spacing = np.bincount(edges.ravel(), np.repeat(length, 2), count) / np.maximum(degree, 1)
    fallback = float(length.mean()) if len(length) else 1.0
    angle, first, second, hinge_length = hinge_geometry(rest, hinges)
    with np.errstate(divide="ignore", invalid="ignore"):
        hinge_shape = np.minimum(hinge_length**2 / (first + second), HINGE_SHAPE_LIMIT)
    return {
        "rest_length": np.maximum(length, 1e-9 * fallback),
        "edge_area": edge_area,
        "hinge_shape": np.nan_to_num(hinge_shape, nan=0.0),
        "hinge_area": (first + second) / 3.0,
        "rest_angle": np.where(bent, angle, 0.0),
        "vertex_area": vertex_area,
        "spacing": np.where(spacing > 0, spacing, fallback),
    }


def triangle_shape(
    rest: np.ndarray, triangles: np.ndarray, warp: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Area of each triangle and its sides' inverse in the material's axes, which are warp and weft (`axes`).

    Args:
        rest: Rest positions [m], shape (V, 3), float64.
        triangles: Shape (T, 3).
        warp: Direction of the warp on each triangle, shape (T, 3), 0 where unknown; None where it is on all.

    Returns:
        Areas [m^2], shape (T,), and the rows of the inverse [1/m], shape (T, 4), zero where there is no area.
    """
    corners = rest[triangles]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    double = np.linalg.norm(np.cross(first, second), axis=1, keepdims=True)
    along, across = axes(rest, triangles, np.zeros((len(triangles), 3)) if warp is None else warp)
    a, b, c, d = (np.einsum("tc,tc->t", s, axis) for axis in (along, across) for s in (first, second))
    sides = (first**2).sum(axis=1, keepdims=True) + (second**2).sum(axis=1, keepdims=True)
    whole = double > 1e-12 * sides
    adjugate = np.stack([d, -b, -c, a], axis=1)
    return 0.5 * double[:, 0], np.where(whole, adjugate / np.where(whole, double, 1.0), 0.0)


def hinge_geometry(x: np.ndarray, hinges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Signed angle [rad], both triangle areas [m^2] and edge length [m] of each hinge."""
    i, j, k, ell = (x[hinges[:, corner]] for corner in range(4))
    axis = j - i
    n1, n2 = np.cross(axis, k - i), np.cross(ell - i, axis)
    length = np.linalg.norm(axis, axis=1)
    sine = np.einsum("hc,hc->h", np.cross(n1, n2), axis) / np.maximum(length, np.finfo(float).tiny)
    angle = np.arctan2(sine, np.einsum("hc,hc->h", n1, n2))
    return angle, 0.5 * np.linalg.norm(n1, axis=1), 0.5 * np.linalg.norm(n2, axis=1), length
