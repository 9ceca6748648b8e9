"""Plain-array records of stages, for writing sample stages and drawing pictures.

No pxr here, so geometry code and tests can use the records without a USD library.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...solver.fabric import Fabric


@dataclass(frozen=True)
class Look:
    """A plain surface material.

    Attributes:
        name: Prim name of the material.
        color: Linear RGB reflectance, 0..1.
        roughness: UsdPreviewSurface roughness, 0..1.
    """

    name: str
    color: tuple[float, float, float]
    roughness: float = 0.85


@dataclass(frozen=True, eq=False)
class FaceVarying:
    """Values on face corners with a separate topology, such as UVs with seams.

    Attributes:
        values: Distinct values, shape (N, 2).
        indices: One entry per face corner into ``values``, shape (C,).
    """

    values: np.ndarray
    indices: np.ndarray


@dataclass(frozen=True, eq=False)
class Skin:
    """Linear-blend skinning weights.

    Attributes:
        joints: Joint numbers, shape (V, K).
        weights: Weights with sum 1 per vertex, shape (V, K).
    """

    joints: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints and their animation; matrices act on column vectors.

    Attributes:
        joints: Joint paths such as ``torso/upper_arm``, parents first.
        bind: World matrices at bind time [stage units], shape (J, 4, 4).
        rotations: Local rotations as quaternions (w, x, y, z), shape (T, J, 4).
        translations: Local translations [stage units], shape (T, J, 3).
    """

    joints: tuple[str, ...]
    bind: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray


@dataclass(frozen=True, eq=False)
class PlainMesh:
    """One mesh prim.

    Attributes:
        name: Prim name.
        counts: Vertices per face, shape (F,).
        indices: Vertices of the face corners, shape (C,).
        points: Default positions, the rest shape of a garment [stage units], shape (V, 3).
        look: Material of all faces outside the subsets.
        role: ``garment``, ``collider``, ``trim``, which the first garment binds, or ``prop``.
        samples: Positions at the stage's times, shape (T, V, 3), or None.
        transforms: Local matrices (column vectors) at the stage's times, shape (T, 4, 4), or None.
        uv: Texture coordinates, or None.
        subsets: Faces with different materials: (look, face numbers).
        pin: 1 where the fine cloth follows the coarse cloth exactly, shape (V,), or None.
        fabric: Material values authored on a garment, or None.
        level: Number of subdivisions authored on a garment.
        skin: Weights on the stage's skeleton, or None.
        left_handed: Whether faces run clockwise seen from outside.
        scheme: USD subdivision scheme.
    """

    name: str
    counts: np.ndarray
    indices: np.ndarray
    points: np.ndarray
    look: Look
    role: str = "garment"
    samples: np.ndarray | None = None
    transforms: np.ndarray | None = None
    uv: FaceVarying | None = None
    subsets: tuple[tuple[Look, np.ndarray], ...] = ()
    pin: np.ndarray | None = None
    fabric: Fabric | None = None
    level: int = 2
    skin: Skin | None = None
    left_handed: bool = False
    scheme: str = "none"


@dataclass(frozen=True, eq=False)
class PlainStage:
    """A whole small shot.

    Attributes:
        name: Name of the default prim.
        doc: Purpose of the shot, one sentence.
        times: Time codes of every sample, ascending.
        skeleton: Skeleton of the skinned meshes, or None.
        rate: Time codes per second.
        metres_per_unit: Length of one stage unit [m].
        up_axis: ``Y`` or ``Z``.
    """

    name: str
    doc: str
    meshes: tuple[PlainMesh, ...]
    times: np.ndarray = field(default_factory=lambda: np.arange(1.0, 25.0))
    skeleton: Skeleton | None = None
    rate: float = 24.0
    metres_per_unit: float = 1.0
    up_axis: str = "Y"
