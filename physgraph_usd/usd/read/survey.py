"""Lists the meshes of a stage and whether each can be refined; for ``inspect``, so never raises on a mesh."""

from __future__ import annotations

from dataclasses import dataclass

from pxr import Usd, UsdGeom, UsdSkel

from ...errors import StageError
from ...solver.colliders.orient import pieces_of
from ..schema import GARMENT_API
from ..stage import Notice, list_meshes, open_stage, pxr_errors, quiet, read_units, shot_name
from ..times import motion_of
from .absence import Samples
from .cage import PointReader, read_cage
from .find import has_schema
from .garment import WORD
from .placement import check_placement

CLOTH = frozenset(
    "apron blouse cape clothes clothing cloth cloak coat costume dress dungarees garment garments gown hoodie jacket"
    " jeans kilt leggings outfit overalls overcoat pants robe scarf shirt shorts skirt suit sweater tee trousers tshirt"
    " uniform vest".split()
)
NO_CLOTH = frozenset(
    "arm arms body bed chair char character face feet floor foot ground hair hand hands head leg legs seat set skin"
    " stool table teeth torso wall".split()
)
"""Words in names of cloth meshes, and in names of meshes of bodies and sets."""


@dataclass(frozen=True)
class MeshReport:
    """One mesh of a stage.

    Attributes:
        garment: Whether the mesh has PhysGraphGarmentAPI.
        points: Number of points; 0 if unreadable.
        faces: Number of faces to be refined.
        is_open: Whether open pieces have more faces than closed pieces.
        deforms: Whether its points change in time, or follow a skeleton.
        times: Authored time codes of points and transforms, without a skeleton's.
        problem: Why the mesh cannot be refined; "" for none.
        notices: Warnings of refining the mesh.
    """

    path: str
    garment: bool
    points: int = 0
    faces: int = 0
    is_open: bool = False
    deforms: bool = False
    times: tuple[float, ...] = ()
    problem: str = ""
    notices: tuple[Notice, ...] = ()

    @property
    def looks_like_cloth(self) -> bool:
        """Whether the name says so; open meshes too, if it does not name a part of a body or of a set."""
        words = {word.lower() for word in WORD.findall(self.path.rsplit("/", 1)[-1])}
        return not words.isdisjoint(CLOTH) or (self.is_open and words.isdisjoint(NO_CLOTH))


@dataclass(frozen=True)
class Survey:
    """A stage and its meshes.

    Attributes:
        path: The shot file, or the name of an in-memory stage.
        metres_per_unit: Length of one stage unit [m].
        notices: Warnings about the stage itself.
    """

    path: str
    metres_per_unit: float
    meshes: tuple[MeshReport, ...]
    notices: tuple[Notice, ...]


def survey(shot: str | Usd.Stage) -> Survey:
    """Survey all meshes of a shot, including broken meshes; StageError if the file cannot be opened at all."""
    path = shot_name(shot)
    stage, notices = open_stage(shot)
    with pxr_errors(f"cannot read {path}"), quiet():
        units, unit_notices = read_units(stage)
        meshes = tuple(_survey_mesh(stage.GetPrimAtPath(mesh), units.metres) for mesh in list_meshes(stage))
    return Survey(path, units.metres, meshes, (*notices, *unit_notices))


def _survey_mesh(prim: Usd.Prim, metres: float) -> MeshReport:
    """One mesh; never raises, a broken mesh has a problem."""
    path = str(prim.GetPath())
    garment, count = has_schema(prim, GARMENT_API), 0
    try:
        with pxr_errors(f"cannot read <{path}>"):
            samples = Samples.of(prim, motion_of(prim).times)
            times = samples.times or tuple(samples.absent)  # A mesh absent at all times: reading raises the reason.
            first = times[0] if times else None
            points = PointReader(prim, first)
            count = points.count
            cage = read_cage(prim, count, times)
            points.edges = cage.mesh.half_edges.edges
            placed = points.read(first)[0]
            pieces = pieces_of(placed, cage.mesh.triangulate(placed).triangles)
            placement_notices = check_placement(prim, metres, times)
    except StageError as error:
        return MeshReport(path, garment, points=count, problem=str(error))
    is_open = len(pieces.open) > len(pieces.closed)
    notices = (*samples.notices(path, tuple(samples.absent)), *cage.notices, *placement_notices)
    skinned = UsdSkel.BindingAPI(prim).GetJointIndicesAttr().HasAuthoredValue()
    deforms = skinned or UsdGeom.Mesh(prim).GetPointsAttr().ValueMightBeTimeVarying()
    return MeshReport(path, garment, count, len(cage.kept_faces), is_open, deforms, times, notices=notices)
