"""What everyday shots bring now and then: glitches, points at one place, huge faces, variants, cloth of any size."""

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt
from stages import vec3

from physgraph_usd.usd.stage import paths_in

from .bases import garments_of
from .damage import numbers
from .files import TIMED
from .meshes import OWN, a_mesh
from .mutant import Draft, Kind


def _times(mesh: UsdGeom.Mesh) -> list[Usd.TimeCode]:
    """The default and every sample of a mesh's points."""
    return [Usd.TimeCode.Default(), *map(Usd.TimeCode, mesh.GetPointsAttr().GetTimeSamples())]


def _variants(draft: Draft) -> None:
    """Variants that hold the garment's points, values or nothing; one, another or none is selected."""
    stage = draft.open()
    garment = draft.pick(garments_of(stage))
    holder = draft.pick([garment, garment.GetParent()])
    points = numbers(UsdGeom.Mesh(garment).GetPointsAttr().Get(Usd.TimeCode.EarliestTime()))
    choices = holder.GetVariantSets().AddVariantSet("look")
    for name in ("bare", "moved", "switched"):
        choices.AddVariant(name)
        choices.SetVariantSelection(name)
        with choices.GetVariantEditContext():
            mesh = UsdGeom.Mesh(stage.OverridePrim(garment.GetPath()))
            if name == "moved":
                mesh.GetPointsAttr().Set(vec3(points * draft.pick([0.0, 1.1, 100.0])), draft.pick(_times(mesh)))
            elif name == "switched" and draft.chance(0.5):
                mesh.GetPrim().SetActive(False)
            elif name == "switched":
                mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray([3]))
                mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray([0, 1, 2]))
    chosen = draft.pick(["bare", "moved", "switched", "nowhere", ""])
    if chosen:
        choices.SetVariantSelection(chosen)
    else:
        choices.ClearVariantSelection()
    draft.save(stage, f"{holder.GetPath()}: variant {chosen or 'none'}")


def _glitch(draft: Draft) -> None:
    """One sample gone wrong: all points equal, a hundred times its size, turned inside out, far away, or torn."""
    stage = draft.open()
    mesh = a_mesh(draft, stage)
    code = draft.pick(_times(mesh))
    points = numbers(mesh.GetPointsAttr().Get(code)).astype(np.float64).reshape(-1, 3)
    how = draft.pick(["equal", "size", "inside out", "far", "torn", "body eightfold", "speck", "one far"])
    centre = points.mean(axis=0)
    changed = {
        "equal": lambda: np.broadcast_to(centre, points.shape),
        "size": lambda: centre + draft.pick([1e-3, 100.0]) * (points - centre),
        "inside out": lambda: centre - (points - centre),
        "far": lambda: points + draft.pick([10.0, 1e4]),
        "speck": lambda: 1e-6 * points,
        "one far": lambda: np.vstack([points[:-1], [1e9, 0.0, 0.0]]),
        "torn": lambda: points + draft.rng.standard_normal(points.shape),
        "body eightfold": lambda: centre + 8.0 * (points - centre),
    }[how]()
    mesh.GetPointsAttr().Set(vec3(changed), code)
    draft.save(stage, f"{mesh.GetPath()} at {code}: {how}")


def _coincident(draft: Draft) -> None:
    """Points at one place, at rest or always; a face twice; points that no face uses."""
    stage = draft.open()
    mesh = UsdGeom.Mesh(draft.pick(garments_of(stage)))
    indices, counts = (
        numbers(each.Get()) for each in (mesh.GetFaceVertexIndicesAttr(), mesh.GetFaceVertexCountsAttr())
    )
    pairs = [draft.rng.choice(indices, 2) for _ in range(draft.pick([0, 1, 3, 8]))]
    if draft.chance(0.5):
        start = int(draft.rng.integers(len(indices) - 1))
        pairs.append(indices[start : start + 2])
    loose = draft.pick([0, 0, 1, 5])
    for code in _times(mesh):
        points = numbers(mesh.GetPointsAttr().Get(code)).reshape(-1, 3).copy()
        for one, other in pairs if code.IsDefault() or draft.chance(0.7) else ():
            points[one] = points[other]
        mesh.GetPointsAttr().Set(vec3(np.vstack([points, np.zeros((loose, 3))])), code)
    if draft.chance(0.5):
        first = int(counts[0])
        mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.append(counts, first).astype(np.int32)))
        mesh.GetFaceVertexIndicesAttr().Set(
            Vt.IntArray.FromNumpy(np.append(indices, indices[:first][:: draft.pick([1, -1])]).astype(np.int32))
        )
    draft.save(stage, f"{mesh.GetPath()}: {len(pairs)} pairs at one place, {loose} loose points, {len(counts)} faces")


def _retimed(draft: Draft) -> None:
    """Samples of what moves, cloth or body, at other times; at other rates, in a range."""
    stage = draft.open()
    layer = stage.GetRootLayer()
    moving = [path for path in paths_in(layer) if layer.ListTimeSamplesForPath(path)]
    hows = ["seconds"] if draft.chance(0.2) else ["rounded", "jump", "sparse", "far", "one", "blocked"]
    for path in moving if draft.chance(0.5) or hows == ["seconds"] else moving[:1]:
        samples = {time: layer.QueryTimeSample(path, time) for time in layer.ListTimeSamplesForPath(path)}
        how = draft.pick(hows)
        changed = _other_times(draft, samples, how)
        for time in samples:
            layer.EraseTimeSample(path, time)
        for time, value in changed.items():
            layer.SetTimeSample(path, time, value)
        draft.said.append(f"{path}: {how}")
    if hows == ["seconds"] or draft.chance(0.3):
        layer.timeCodesPerSecond = draft.pick([1000.0, 48.0, 25.0]) if len(hows) > 1 else 1.0
    if draft.chance(0.3):
        draft.options["frames"] = draft.pick([(1.0, 2.0), (2.0, 2.0), (1.0, 1e6), (2.5, 3.0)])
    draft.save(stage, f"{len(moving)} sampled")


def _other_times(draft: Draft, samples: dict[float, object], how: str) -> dict[float, object]:
    """Samples rounded, with a jump, sparse, far away, in seconds, one alone, or with a block."""
    first, last = min(samples), max(samples)
    return {
        "rounded": lambda: {time + draft.pick([3e-5, -9e-4, 0.0]): each for time, each in samples.items()},
        "jump": lambda: samples | {last - draft.pick([1e-9, 9e-4]): samples[first]},
        "sparse": lambda: {first: samples[first], last + draft.pick([4.0, 11.5]): samples[last]},
        "far": lambda: samples | {draft.pick([-1e5, 1e7, 40.0]): samples[first]},
        "seconds": lambda: {time / 24.0: each for time, each in samples.items()},
        "one": lambda: {first: samples[first]},
        "blocked": lambda: samples | {draft.pick([first, last, last + 2.0]): Sdf.ValueBlock()},
    }[how]()


KINDS = (
    Kind("odd: variants", _variants, OWN),
    Kind("odd: glitch frames", _glitch, ("plain", "bodies", "dressed", "several")),
    Kind("odd: points at one place", _coincident, OWN),
    Kind("odd: times of samples", _retimed, (*TIMED, "bodies", "skinned", "dressed", "layered")),
)
