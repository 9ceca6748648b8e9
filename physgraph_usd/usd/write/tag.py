"""Tags garments, colliders and targets of a shot, in a new layer over the shot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import SchemaError, StageError, UsageError
from ...solver.fabric import PRESETS
from ..files import LAYER_SUFFIXES, check_suffix, check_targets, files_of
from ..lookup import USER_PROPERTIES, check_known, check_limits
from ..provenance import asset_path, export_layer
from ..read.find import find_colliders, find_garments
from ..read.reader import open_shot
from ..read.targets import TARGETS
from ..schema import COLLIDER, COLLIDER_API, GARMENT, GARMENT_API, SIDES, Property, every_fabric_value
from ..stage import open_stage
from ..view import root_over
from .atomic import ASSET_PATHS, prepare_target
from .paint import author_painted


def tag(
    shot: str | Path,
    out: str | Path,
    *,
    garments: Sequence[str] = (),
    colliders: Sequence[str] = (),
    bind: Sequence[str] = (),
    preset: str | None = None,
    side: str | None = None,
    values: Mapping[str, Mapping[str, float]] | None = None,
    painted: Mapping[str, Mapping[str, np.ndarray]] | None = None,
    asset_paths: str = "relative",
    overwrite: bool = False,
) -> Path:
    """Apply the schemas to prims of a shot, in a new layer over the shot, ready for refining.

    Args:
        shot: The shot file; never edited.
        out: Layer to write, with the shot as sublayer.
        garments: Prim paths, names, globs or collections of meshes; if empty and a preset is given, the tagged
            garments.
        colliders: Prim paths, names, globs or collections of surfaces.
        bind: Meshes, curves or points that follow the nearest of the garments, named likewise.
        preset: Name of a fabric to author on the garments, or None.
        side: Side of the colliders for the cloth, one of `SIDES`, or None.
        values: Values to author after the preset's, by the prim path of a garment or of one of its subsets, and by
            the schema's short names.
        painted: Maps to author, values of each authored point, shape (V,), by the same names.
        asset_paths: "relative" or "absolute": form of the shot's path in the layer.
        overwrite: Whether an existing file may be replaced.

    Returns:
        The layer's path.

    Raises:
        UsageError: Nothing was named, the preset or the side is unknown or not applicable, or the file exists.
        StageError: A named prim is missing, lies in an instance, or is no surface.
        GarmentError: A prim cannot follow a garment.
        LayerError: The layer cannot be written.
    """
    if not garments and not colliders and not bind and preset is None:
        raise UsageError("nothing to tag; name a garment or a collider")
    requested = [("preset", preset, sorted(PRESETS)), ("side", side, SIDES)]
    for kind, word, allowed in [entry for entry in requested if entry[1] is not None]:
        check_known(kind, word, allowed)
    check_known("asset path", asset_paths, ASSET_PATHS)
    if side is not None and not colliders:
        raise UsageError("a side is for colliders; name one")
    _check_values(values or {})
    target = Path(out)
    check_suffix("the layer", target, LAYER_SUFFIXES)
    check_targets([("the layer", target)], files_of(shot))
    prepare_target(target, overwrite=overwrite)
    stage, _ = open_stage(str(shot))
    cloth = find_garments(stage, garments) if garments or bind or preset is not None else []
    solid = find_colliders(stage, cloth, colliders) if colliders else []
    targets = _targets(str(shot), [str(prim.GetPath()) for prim in cloth], bind) if bind else {}
    root = root_over(stage.GetRootLayer(), [asset_path(shot, target.parent, absolute=asset_paths == "absolute")])
    for prim in (*cloth, *solid):
        _check_editable(prim)
    for prim in cloth:
        spec = _applied(root, prim, GARMENT_API)
        _author_values(root, prim, {} if preset is None else every_fabric_value(PRESETS[preset]))
        for candidate in (prim, *prim.GetChildren()):
            _author_values(root, candidate, (values or {}).get(str(candidate.GetPath()), {}))
        author_painted(spec, prim, (painted or {}).get(str(prim.GetPath()), {}))
        if prim.GetPath() in targets:
            Sdf.RelationshipSpec(spec, TARGETS, False).targetPathList.prependedItems = targets[prim.GetPath()]
    for prim in solid:
        spec = _applied(root, prim, COLLIDER_API)
        if side is not None:
            _author(spec, COLLIDER["collider:side"], side)
    return export_layer(root, target)


def _targets(shot: str, garments: Sequence[str], bind: Sequence[str]) -> dict[Sdf.Path, list[Sdf.Path]]:
    """Paths of all targets bound to the cloth, authored ones included, by garment."""
    paths_of: dict[Sdf.Path, list[Sdf.Path]] = {}
    with closing(open_shot(shot, garments=garments, bind=bind)) as opened:
        for target in opened.targets:
            if target.on is None:
                paths_of.setdefault(opened.sources[target.garment].path, []).append(target.path)
    return paths_of


def _check_values(values: Mapping[str, Mapping[str, float]]) -> None:
    try:
        for path, items in values.items():
            for name, value in items.items():
                check_limits(GARMENT[name], value, f"<{path}>")
    except SchemaError as error:
        raise UsageError(str(error)) from error


def _check_editable(prim: Usd.Prim) -> None:
    """Refuse prims on which an opinion would have no effect."""
    if prim.IsInstanceProxy():
        remedy = "tag the prim in the asset, or name it when refining"
        raise StageError(f"<{prim.GetPath()}> lies in an instance, where a layer over the shot cannot reach; {remedy}")
    if not UsdGeom.Gprim(prim):
        raise StageError(f"<{prim.GetPath()}> is a {prim.GetTypeName() or 'prim without a type'}; it has no surface")


def _applied(layer: Sdf.Layer, prim: Usd.Prim, schema: str) -> Sdf.PrimSpec:
    """The layer's over of a prim, with an API schema prepended."""
    spec = Sdf.CreatePrimInLayer(layer, prim.GetPath())
    schemas = Sdf.TokenListOp()
    schemas.prependedItems = [schema]
    spec.SetInfo("apiSchemas", schemas)
    return spec


def _author_values(layer: Sdf.Layer, prim: Usd.Prim, values: Mapping[str, float | None]) -> None:
    """Author values over a prim's opinions, by the schema's short names."""
    for name, value in values.items():
        _author_over(Sdf.CreatePrimInLayer(layer, prim.GetPath()), prim, GARMENT[name], value)


def _author_over(spec: Sdf.PrimSpec, prim: Usd.Prim, row: Property, value: float | None) -> None:
    """Author an attribute's default over a prim's opinions; None hides opinions, such as an earlier preset's value."""
    if value is not None:
        _author(spec, row, round(value) if row.type == "int" else value)
        if prim.GetAttribute(row.name).HasAuthoredConnections():  # Connections are stronger than the value.
            spec.attributes[row.name].connectionPathList.ClearEditsAndMakeExplicit()
        return
    for attribute in map(prim.GetAttribute, (row.name, USER_PROPERTIES + row.name)):
        if attribute and (attribute.HasAuthoredValue() or attribute.HasAuthoredConnections()):
            hidden = Sdf.AttributeSpec(spec, attribute.GetName(), attribute.GetTypeName(), attribute.GetVariability())
            hidden.default = Sdf.ValueBlock()
            hidden.connectionPathList.ClearEditsAndMakeExplicit()


def _author(spec: Sdf.PrimSpec, row: Property, value: float | str) -> None:
    variability = Sdf.VariabilityUniform if row.uniform else Sdf.VariabilityVarying
    kind = Sdf.ValueTypeNames.Find(row.type)  # pyright: ignore[reportCallIssue]  the stubs know no argument
    Sdf.AttributeSpec(spec, row.name, kind, variability).default = value
