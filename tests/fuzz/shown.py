"""What a renderer shows and when: purposes, blocked samples, gaps, holes, rates, open bodies, cuts and loose pieces."""

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt
from stages import vec3

from .bases import garments_of
from .damage import numbers
from .meshes import OWN, a_mesh
from .mutant import Draft, Kind


def _faces(mesh: UsdGeom.Mesh) -> list[np.ndarray]:
    counts, indices = (
        numbers(each.Get()) for each in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    )
    return np.split(indices, np.cumsum(counts)[:-1])


def _set_faces(mesh: UsdGeom.Mesh, faces: list[np.ndarray]) -> None:
    mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.array([len(face) for face in faces], np.int32)))
    mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(np.concatenate(faces).astype(np.int32)))


def _open_bodies(draft: Draft) -> None:
    """Meshes that lack faces: deleted, or in holeIndices, or drawn as a subdivision surface."""
    stage = draft.open()
    mesh = a_mesh(draft, stage)
    faces = _faces(mesh)
    gone = [index for index in range(len(faces)) if draft.chance(draft.pick([0.1, 0.5]))]
    if draft.chance(0.5) and len(gone) < len(faces):
        _set_faces(mesh, [face for index, face in enumerate(faces) if index not in gone])
    else:
        mesh.CreateHoleIndicesAttr(Vt.IntArray(gone))
    mesh.CreateSubdivisionSchemeAttr(draft.pick(["none", "catmullClark", "loop", "bilinear"]))
    draft.options["colliders"] = draft.pick([(), ("auto",)])
    draft.save(stage, f"{mesh.GetPath()}: {len(gone)} of {len(faces)} faces gone")


def _cut(draft: Draft) -> None:
    """A garment whose faces have corners of their own, all or some, apart by nothing or a little; or a sheet twice."""
    stage = draft.open()
    mesh = UsdGeom.Mesh(draft.pick(garments_of(stage)))
    faces = _faces(mesh)
    twice, part = draft.chance(0.3), draft.pick([0.2, 1.0])
    source, cut = [*range(1 + max(int(face.max()) for face in faces))], list[np.ndarray]()
    for face in faces:
        if draft.chance(part):
            cut.append(np.arange(len(source), len(source) + len(face)))
            source += face.tolist()
        else:
            cut.append(face)
    _set_faces(mesh, [*faces, *(each[:: draft.pick([1, -1])] for each in cut)] if twice else cut)
    apart = draft.pick([0.0, 0.0, 1e-5, 1e-2])
    for code in (Usd.TimeCode.Default(), *map(Usd.TimeCode, mesh.GetPointsAttr().GetTimeSamples())):
        points = numbers(mesh.GetPointsAttr().Get(code)).reshape(-1, 3)[source]
        mesh.GetPointsAttr().Set(vec3(points + apart * np.sin(np.arange(len(points)))[:, None]), code)
    if draft.chance(0.3):
        draft.options["overrides"] = (f"seam:tolerance={draft.pick(['1e-4', '0.1', '1'])}",)
    draft.save(stage, f"{mesh.GetPath()}: {len(cut)} faces cut, {apart:g} apart" + ", twice" * twice)


def _pieces(draft: Draft) -> None:
    """Boxes on a garment as buttons are: small, large, or all there is; some asked to be rigid."""
    stage = draft.open()
    mesh = UsdGeom.Mesh(draft.pick(garments_of(stage)))
    faces = _faces(mesh)
    first = numbers(mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime())).reshape(-1, 3)
    box = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    size = draft.pick([0.0, 1e-3, 0.05, 2.0]) * float(np.ptp(first, axis=0).max())
    extra = [np.array(side) + len(first) for side in sides]
    alone = draft.chance(0.1)
    _set_faces(mesh, extra if alone else [*faces, *extra])
    for code in (Usd.TimeCode.Default(), *map(Usd.TimeCode, mesh.GetPointsAttr().GetTimeSamples())):
        points = numbers(mesh.GetPointsAttr().Get(code)).reshape(-1, 3)
        mesh.GetPointsAttr().Set(vec3(np.vstack([points, points.mean(axis=0) + size * box])), code)
    if draft.chance(0.5):
        subset = UsdGeom.Subset.Define(stage, mesh.GetPath().AppendChild("badge"))
        subset.CreateIndicesAttr(Vt.IntArray(draft.pick([[0, 1], [*range(len(faces))], [10**6], []])))
        kind, value = draft.pick([("Bool", True), ("Bool", False), ("Int", 3), ("Token", "x")])
        subset.GetPrim().CreateAttribute("physgraph:rigid", getattr(Sdf.ValueTypeNames, kind)).Set(value)
    draft.save(stage, f"{mesh.GetPath()}: a box of {size:g}" + ", alone" * alone)


def _doubled(draft: Draft) -> None:
    """Faces that give corners twice, in a row or apart, once or as their last ones; points doubled beside them."""
    stage = draft.open()
    mesh = a_mesh(draft, stage)
    faces, changed = _faces(mesh), list[np.ndarray]()
    part, how = draft.pick([0.2, 1.0]), draft.pick(["next", "next", "apart", "all", "point"])
    source = [*range(1 + max((int(face.max()) for face in faces if len(face)), default=0))]
    for face in faces:
        at = int(draft.rng.integers(max(len(face), 1)))
        if not len(face) or not draft.chance(part):
            changed.append(face)
        elif how == "point":
            changed.append(np.insert(face, at, len(source)))
            source.append(int(face[at]))
        else:
            extra = {"next": face[at], "apart": face[at - 2], "all": face[at - 1]}[how]
            changed.append(np.repeat(face, 2) if how == "all" else np.insert(face, at, extra))
    _set_faces(mesh, changed)
    for code in (Usd.TimeCode.Default(), *map(Usd.TimeCode, mesh.GetPointsAttr().GetTimeSamples())):
        points = numbers(mesh.GetPointsAttr().Get(code)).reshape(-1, 3)
        if how == "point" and len(points):
            mesh.GetPointsAttr().Set(vec3(points[np.minimum(source, len(points) - 1)]), code)
    draft.save(stage, f"{mesh.GetPath()}: corners twice, {how}")


KINDS = (
    Kind("shown: open bodies", _open_bodies, OWN),
    Kind("shown: cut along edges", _cut, OWN),
    Kind("shown: loose pieces", _pieces, OWN),
    Kind("shown: corners twice", _doubled, OWN),
)
