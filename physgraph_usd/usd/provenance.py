"""A refined layer's provenance: stage metadata copied from the shot, the record, and the root layer over the shot.

The record lies in ``customLayerData["physgraph"]``. The record holds no clock time and, unless asked for, no absolute
path of this machine: the same input gives the same bytes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, Vt

from ..errors import LayerError, StageError
from ..interrupts import leave_if_asked
from .lookup import bound_materials, with_ancestors
from .stage import TRAVERSAL, USD_ERRORS, paths_in, reason_of
from .view import root_over
from .write.atomic import prepare_target, publish, temporary_path

RECORD = "physgraph"
CONTENTS = "contents"
"""Entry of the record: a digest of the layer's contents, to detect a record copied into a different layer."""
FAILED, UNSOLVED, UNSETTLED, CROSSED = "failed", "unsolved", "unsettled", "crossed"
"""Entries of the record: time codes without a sample; unsolved frames of garments, following their cage; frames written
but not settled; edges left through faces, if over a tenth of the input's."""
LACKING = (FAILED, UNSOLVED, UNSETTLED, CROSSED)
"""Defects of a layer: with the first two, any run counts as done in part; with the rest, a strict run."""
_LIST = (Vt.StringArray, list)
_TYPES: dict[str, Any] = {
    "garments": _LIST,
    "variants": _LIST,
    "shot": str,
    "left_out": Mapping,
}
RANGE = ("startTimeCode", "endTimeCode")
METADATA = ("upAxis", "metersPerUnit", "kilogramsPerUnit", "defaultPrim", *RANGE)
"""Stage metadata shared by a refined layer and its shot; a layer of some of the shot's frames has its own range."""


def copy_stage_metadata(
    stage: Usd.Stage, layer: Sdf.Layer, *, span: tuple[float, float] | None = None, whole: bool = True
) -> None:
    """Copy the metadata of a shot to a new layer.

    ``span`` is the time range of the layer if the shot authors none, or if the layer does not hold the ``whole`` shot:
    UsdUtils' StitchClips takes the ranges of its clips from there.

    Time codes per second are always authored: a layer without authored rate counts as 24 and USD would rescale its
    samples.
    """
    layer.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    layer.framesPerSecond = stage.GetFramesPerSecond()
    root = stage.GetRootLayer().pseudoRoot
    for key in METADATA:
        if stage.HasAuthoredMetadata(key):
            layer.pseudoRoot.SetInfo(key, stage.GetMetadata(key))
        elif root.HasInfo(key):
            layer.pseudoRoot.SetInfo(key, root.GetInfo(key))
    if span is not None and not (whole and stage.HasAuthoredTimeCodeRange()):
        layer.startTimeCode, layer.endTimeCode = span


def author_record(layer: Sdf.Layer, record: Mapping[str, Any]) -> None:
    """Write the record into ``customLayerData["physgraph"]`` after all other contents; None entries are left out."""
    layer.customLayerData = {RECORD: _plain(dict(record) | {CONTENTS: _contents(layer)})}


def _contents(layer: Sdf.Layer) -> str:
    """Digest of a layer's specs and sample times, without values; includes the other layer data."""
    digest = hashlib.sha256()
    foreign = sorted(set(layer.customLayerData) - {RECORD})
    digest.update(repr((str(layer.subLayerPaths), foreign)).encode())
    for path in sorted(map(str, paths_in(layer))):
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec):
            arcs = [spec.referenceList, spec.payloadList, spec.inheritPathList, spec.specializesList]
            opinions = [str(spec.specifier), spec.typeName, *map(str, arcs)]
        elif isinstance(spec, Sdf.AttributeSpec):
            times = layer.ListTimeSamplesForPath(path)
            opinions = [str(spec.typeName), *map(str, (spec.HasInfo("default"), spec.connectionPathList, times))]
        else:
            opinions = []
        digest.update(repr((path, opinions)).encode())
    return digest.hexdigest()


def is_only_ours(layer: Sdf.Layer) -> bool:
    """Whether a layer with our record is unmodified, and for example has no shot stitched in."""
    record = read_record(layer)
    try:
        return record is not None and record.get(CONTENTS) == _contents(layer)
    except (*USD_ERRORS, UnicodeDecodeError):
        return False


def read_record(layer: Sdf.Layer) -> dict[str, Any] | None:
    """The record of a refined layer, or None; a damaged file has no record.

    Anyone may write a record: known entries of an unexpected type are left out.
    """
    try:
        record = layer.customLayerData.get(RECORD)
    except USD_ERRORS:
        return None
    if not isinstance(record, Mapping):
        return None
    return {key: value for key, value in record.items() if isinstance(value, _TYPES.get(key, object))}


def is_result_of(path: Path, record: Mapping[str, Any], *, settled: bool = False) -> bool:
    """Whether a file is a complete layer with the given record entries, and with settled frames if asked for."""
    expected = Sdf.Layer.CreateAnonymous()
    expected.customLayerData = {RECORD: _plain(record)}
    try:
        layer = Sdf.Layer.FindOrOpen(str(path))
    except USD_ERRORS:
        return False
    recorded = (read_record(layer) if layer and is_only_ours(layer) else None) or {}
    lacking = any(name in recorded for name in (LACKING if settled else LACKING[:2]))
    return not lacking and all(recorded.get(key) == value for key, value in (read_record(expected) or {}).items())


def recorded_shot(layer: Sdf.Layer) -> str | None:
    """The shot named by a layer's record, relative to the layer's location; None if not named."""
    named = (read_record(layer) or {}).get("shot")
    return layer.ComputeAbsolutePath(str(named)) if named else None


def refined_layers(stage: Usd.Stage) -> list[Sdf.Layer]:
    """Layers of a stage with refined garments; muting the layers shows the coarse shot below."""
    layers = (layer for layer in stage.GetUsedLayers() if (read_record(layer) or {}).get("garments"))
    return sorted(layers, key=lambda layer: layer.identifier)


def mute_refined(stage: Usd.Stage) -> list[str]:
    """Mute every layer of refined garments on this stage only, so artists' changes above such layers count.

    Layers with additional contents, and the root layer, are not muted. Returns the identifiers of the muted layers.
    """
    layers = (layer for layer in refined_layers(stage) if layer != stage.GetRootLayer())
    identifiers = [layer.identifier for layer in layers if is_only_ours(layer)]
    for identifier in identifiers:
        stage.MuteLayer(identifier)
    return identifiers


def refuse_refined(stage: Usd.Stage, paths: Iterable[Sdf.Path] = ()) -> None:
    """Refuse (StageError) a refined layer as root, and garments refined in a layer with additional contents."""
    for layer in refined_layers(stage):
        record, name = read_record(layer) or {}, Path(layer.identifier).name
        instead = f"refine the shot that it was made from, {record.get('shot') or 'which was in memory'}"
        if layer == stage.GetRootLayer() and is_only_ours(layer):
            raise StageError(f"{name} is a refined layer and no shot; {instead}")
        for path in {str(path) for path in paths}.intersection(map(str, record["garments"])):
            raise StageError(
                f"<{path}> is refined already in {name}, which holds other things as well and so cannot be left out; "
                f"{instead}"
            )


def selections(prims: Iterable[Usd.Prim]) -> tuple[str, ...]:
    """Active variant selections on prims, ancestors and materials, sorted.

    Each is a path such as ``/World/coat{fit=loose}``; a variant set without selection has an empty selection.
    """
    files = set()
    for prim in prims:
        for source in (ancestor for start in (prim, *bound_materials(prim)) for ancestor in with_ancestors(start)):
            sets = source.GetVariantSets()
            path = source.GetPath()
            files |= {path.AppendVariantSelection(name, sets.GetVariantSelection(name)) for name in sets.GetNames()}
    return tuple(sorted(str(path) for path in files))


def unsaved_layers(stage: Usd.Stage) -> tuple[str, ...]:
    """Names of a stage's layers with unsaved content: edited, or in memory only.

    An in-memory layer without prims, such as an empty session layer, is not listed unless the layer is the root.
    """
    dirty = [layer for layer in stage.GetUsedLayers() if layer.dirty]
    dirty = [layer for layer in dirty if layer.rootPrims or not layer.anonymous or layer == stage.GetRootLayer()]
    return tuple(sorted(layer.GetDisplayName() or "in memory" for layer in dirty))


def file_hashes(stage: Usd.Stage, folder: Path | None, *, absolute: bool = False) -> dict[str, str]:
    """SHA-256 of every layer composed by a stage, including value clips, by `asset_path` from a folder."""
    files = {Path(layer.realPath) for layer in stage.GetUsedLayers() if layer.realPath}
    for prim in Usd.PrimRange.Stage(stage, TRAVERSAL):
        if prim.HasAuthoredMetadata("clips"):
            clips = Usd.ClipsAPI(prim)
            named = [asset for name in clips.GetClips() for asset in clips.ComputeClipAssetPaths(name)]
            files |= {Path(asset.resolvedPath) for asset in named if asset.resolvedPath}
    paths = sorted(path for path in files if path.is_file())
    hashes = {}
    for path in paths:
        leave_if_asked()
        with path.open("rb") as stream:
            hashes[asset_path(path, folder, absolute=absolute)] = hashlib.file_digest(stream, "sha256").hexdigest()
    return hashes


def asset_path(path: str | Path, folder: Path | None, *, absolute: bool = False) -> str:
    """A path relative to a folder, in USD notation; absolute on request or if no relative path exists.

    In a linked folder a path that leaves it is absolute: USD follows ``..`` from the folder's name, not from its place.
    """
    full = Path(path).resolve()
    if absolute or folder is None:
        return full.as_posix()
    try:
        relative = Path(os.path.relpath(full, folder.resolve())).as_posix()
    except ValueError:
        return full.as_posix()
    if Path(os.path.normpath(folder.absolute() / relative)).resolve() != full:
        return full.as_posix()
    return relative if relative.startswith(".") else f"./{relative}"


def _plain(value: Any) -> Any:
    """Convert a record to types valid in layer metadata; an array holds points, shape (V, 3), float32."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in sorted(value.items(), key=str) if item is not None}
    if isinstance(value, np.ndarray):
        return Vt.Vec3fArray.FromNumpy(value)
    if isinstance(value, list | tuple | set | frozenset):
        return _plain_list(sorted(value) if isinstance(value, set | frozenset) else list(value))
    if isinstance(value, bool | int | float | str):
        return value
    return str(value)


def _plain_list(items: list[Any]) -> Any:
    """Convert a list to the narrowest suitable array type."""
    if items and all(isinstance(item, int) and not isinstance(item, bool) for item in items):
        return Vt.IntArray(items)
    if items and all(isinstance(item, int | float) and not isinstance(item, bool) for item in items):
        return Vt.DoubleArray(items)
    return Vt.StringArray([str(item) for item in items])


def write_root(path: Path, *, layer: Path, shot: Path, absolute: bool = False, overwrite: bool = False) -> Path:
    """Write a small root layer with a refined layer over its shot, and return the root's path.

    The root copies the shot's stage metadata, including expression variables: USD reads these from a root layer only.
    Both files are named relative to the root's folder, or by absolute paths.

    Raises:
        UsageError: The root exists and may not be replaced.
        LayerError: The shot cannot be read or the root cannot be written.
    """
    prepare_target(path, overwrite=overwrite)
    source = Sdf.Layer.FindOrOpen(str(shot))
    if not source:
        raise LayerError(f"cannot read {shot}")
    below = [asset_path(file, path.parent, absolute=absolute) for file in (layer, shot)]
    return export_layer(root_over(source, below), path)


def export_layer(layer: Sdf.Layer, path: Path) -> Path:
    """Write a layer held in memory to a file, complete or not at all (LayerError)."""
    temporary = temporary_path(path, suffix=path.suffix)
    try:
        if not layer.Export(str(temporary)):
            raise LayerError(f"cannot write {path}")
        publish(temporary, path)
    except USD_ERRORS as error:
        raise LayerError(f"cannot write {path}: {reason_of(error)}") from error
    finally:
        temporary.unlink(missing_ok=True)
    loaded = Sdf.Layer.Find(str(path))
    if loaded:
        loaded.Reload(True)
    return path
