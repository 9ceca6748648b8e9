"""The rules for a refined layer as a whole, and against the shot below it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from ..provenance import read_record
from ..stage import root_metadata
from ..write.chunk import read_chunk
from .rules import Problem, code_of

_SAME = ("upAxis", "metersPerUnit", "kilogramsPerUnit", "defaultPrim", "startTimeCode", "endTimeCode")


def _error(message: str, path: str = "/", time: float | None = None) -> Problem:
    """An error; ``rule`` is filled in by `validate`."""
    return Problem("error", path, time, message, "")


def record(layer: Sdf.Layer) -> Iterator[Problem]:
    """The layer says where it comes from."""
    found = read_record(layer)
    if found is None:
        yield _error('has no customLayerData["physgraph"]; is it a refined layer?')
    elif not found.get("garments") or not (found.get("shot") or found.get("unsaved")):
        yield _error("its record names no garments or no shot")


def time_scale(layer: Sdf.Layer) -> Iterator[Problem]:
    """Time codes per second are authored: a layer without them counts as 24 and its samples are rescaled."""
    if not layer.HasTimeCodesPerSecond():
        yield _error("timeCodesPerSecond is not authored; USD would take 24 and rescale the samples")


def whole_range(layer: Sdf.Layer) -> Iterator[Problem]:
    """All samples of the shot were refined: outside those that were, the cloth stands still."""
    for path, said in (read_record(layer) or {}).get("left_out", {}).items():
        yield Problem("warning", path, None, f"was refined without {said}, where it stands still (--frames)", "")
    chunk = read_chunk(layer)
    if chunk is not None and chunk.times != chunk.every:
        said = f"is a chunk, with {len(chunk.times)} of the shot's {len(chunk.every)} frames; stitch it to the others"
        yield Problem("warning", "/", None, said, "")


def self_contained(layer: Sdf.Layer) -> Iterator[Problem]:
    """The layer brings no other layer and authors in no variant."""
    if len(layer.subLayerPaths):
        yield _error(f"has sublayers {layer.subLayerPaths}; a refined layer stands over the shot, not on it")
    found: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda path: found.append(Sdf.Path(path)))
    for path in found:
        if path.IsPrimVariantSelectionPath():
            yield _error("authors inside a variant of an asset", str(path))


RULES: tuple[Callable[[Sdf.Layer], Iterator[Problem]], ...] = (record, time_scale, whole_range, self_contained)
"""Rules for a refined layer by itself."""


def same_metadata(layer: Sdf.Layer, shot: Usd.Stage) -> Iterator[Problem]:
    """Units, axes, rate and range are the shot's."""
    if layer.timeCodesPerSecond != shot.GetTimeCodesPerSecond():
        said = f"timeCodesPerSecond is {layer.timeCodesPerSecond:g}; the shot has {shot.GetTimeCodesPerSecond():g}"
        yield _error(said)
    for key in _SAME:
        wanted = root_metadata(shot, key)
        found = layer.pseudoRoot.GetInfo(key) if layer.pseudoRoot.HasInfo(key) else None
        if wanted is not None and found != wanted:
            yield _error(f"{key} is {found!r}; the shot has {wanted!r}")


def is_mesh(path: str, composed: Usd.Stage) -> str:
    """Why a path holds no editable mesh, or ""."""
    prim = composed.GetPrimAtPath(path)
    if not prim:
        return "is not on the stage: the layer is not over the shot that it was made from"
    if prim.IsInstanceProxy():
        return "lies in an instance, where overs are ignored; its instance root must be instanceable = false"
    return "" if UsdGeom.Mesh(prim) else f"is of type {prim.GetTypeName() or 'none'}, not Mesh"


def against_shot(layer: Sdf.Layer, coarse: Usd.Prim, target: Sdf.Path) -> Iterator[Problem]:
    """Samples lie at the shot's own times, and the fine mesh is about where and as large as the coarse one."""
    name = str(target.AppendProperty("points"))
    written = list(layer.ListTimeSamplesForPath(name))
    if _is_skinned(coarse):
        return
    known = np.array(sorted(_times(coarse)))
    for time in written:
        if not len(known) or np.abs(known - time).min() > 1e-6:
            yield _error("is a sample at a time that the shot does not author", name, time)
            break
    spec, clouds = layer.GetAttributeAtPath(name), []
    for time in written[:1] + written[-1:] if written else [None]:
        value = layer.QueryTimeSample(name, time) if time is not None else (spec.default if spec else None)
        below = UsdGeom.Mesh(coarse).GetPointsAttr().Get(code_of(time))
        if value is not None and below is not None and len(value) and len(below):
            clouds.append((np.asarray(value), np.asarray(below), time))
    yield from _compare(clouds, name)


def _times(prim: Usd.Prim) -> set[float]:
    """Authored times of a mesh's points and of every transform above it."""
    times = set(UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples())
    while prim and not prim.IsPseudoRoot():
        if UsdGeom.Xformable(prim):
            times.update(UsdGeom.Xformable(prim).GetTimeSamples())
        prim = prim.GetParent()
    return times


def _is_skinned(prim: Usd.Prim) -> bool:
    """Whether a skeleton may move the coarse mesh; then its own points are a bind pose."""
    while prim and not prim.IsPseudoRoot():
        if UsdSkel.Root(prim):
            return True
        prim = prim.GetParent()
    return False


def _compare(clouds: Sequence[tuple[np.ndarray, np.ndarray, float | None]], name: str) -> Iterator[Problem]:
    """Compare fine and coarse clouds in the same local space by size and place, at some times.

    A sample that is broken, such as one whose points are all at one place, is not the size of the cloth: what is as
    large as the coarse mesh is at any of the times will do.
    """
    whole = [(fine.astype(np.float64), below[np.isfinite(below).all(axis=1)], time) for fine, below, time in clouds]
    whole = [each for each in whole if len(each[1]) and np.isfinite(each[0]).all()]
    sizes = [_size(below) for _, below, _ in whole]
    for fine, below, time in whole if max(sizes, default=0.0) > 0 else ():
        least, most = min(sizes), max(sizes)
        away = float(np.linalg.norm(fine.mean(axis=0) - below.mean(axis=0, dtype=np.float64)))
        if not least / 4 <= _size(fine) <= 4 * most:
            said = f"is {_size(fine):g} units large; the coarse mesh is {_size(below):g}"
            yield _error(f"{said}: units or transforms are wrong", name, time)
        elif away > most:
            yield _error(f"lies {away:g} units from the coarse mesh, which is {most:g} large", name, time)


def _size(cloud: np.ndarray) -> float:
    """Diagonal of a cloud's box."""
    return float(np.linalg.norm(np.ptp(cloud.astype(np.float64), axis=0)))
