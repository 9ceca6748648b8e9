"""Marks garments and colliders of a shot, in a new layer over it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom

from ..errors import StageError, UsageError
from ..fabric import PRESETS, Fabric
from .atomic import prepare_target
from .find import find_colliders, find_garments
from .provenance import export_layer, relative_path, root_over
from .schema import COLLIDER_API, GARMENT_API
from .stage import open_stage


def tag(
    shot: str | Path,
    out: str | Path,
    *,
    garments: Sequence[str] = (),
    colliders: Sequence[str] = (),
    preset: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Apply the schemas to prims of a shot, in a new layer that shows the shot and can be refined.

    Args:
        shot: The shot file; never edited.
        out: Layer to write; it sublayers the shot.
        garments: Prim paths, names, globs or collections of meshes.
        colliders: The same, of anything with a surface.
        preset: Name of a fabric whose values are authored on the garments, or None.
        overwrite: Whether an existing file may be replaced.

    Returns:
        The layer's path.

    Raises:
        UsageError: Nothing was named, the preset is unknown, or the file exists.
        StageError: A named prim is not there, lies in an instance, or is no surface.
        LayerError: The layer cannot be written.
    """
    if not garments and not colliders:
        raise UsageError("nothing to tag; name a garment or a collider")
    if preset is not None and preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}; known presets: {', '.join(sorted(PRESETS))}")
    target = Path(out)
    if target.resolve() == Path(shot).resolve():
        raise UsageError(f"{out} is the shot itself; the input is never edited, choose another name")
    prepare_target(target, overwrite=overwrite)
    stage, _ = open_stage(str(shot))
    cloth = find_garments(stage, garments) if garments else []
    solid = find_colliders(stage, cloth, colliders) if colliders else []
    layer = root_over(stage.GetRootLayer(), [relative_path(shot, target.parent)])
    for prim in (*cloth, *solid):
        _check_editable(prim)
    for prim in cloth:
        _apply(layer, prim, GARMENT_API)
        if preset is not None:
            _author_fabric(layer, prim, PRESETS[preset])
    for prim in solid:
        _apply(layer, prim, COLLIDER_API)
    return export_layer(layer, target)


def _check_editable(prim: Usd.Prim) -> None:
    """Refuse prims where an opinion would be ignored or mean nothing."""
    if prim.IsInstanceProxy():
        raise StageError(
            f"<{prim.GetPath()}> lies in an instance, where a layer over the shot cannot reach; tag the prim in the "
            "asset, or name it when refining"
        )
    if not UsdGeom.Gprim(prim):
        raise StageError(f"<{prim.GetPath()}> is a {prim.GetTypeName() or 'prim without a type'}; it has no surface")


def _apply(layer: Sdf.Layer, prim: Usd.Prim, schema: str) -> None:
    """Prepend an API schema in the layer's over."""
    spec = Sdf.CreatePrimInLayer(layer, prim.GetPath())
    schemas = Sdf.TokenListOp()
    schemas.prependedItems = [schema]
    spec.SetInfo("apiSchemas", schemas)


def _author_fabric(layer: Sdf.Layer, prim: Usd.Prim, fabric: Fabric) -> None:
    """Author a fabric's values on a garment."""
    spec = layer.GetPrimAtPath(prim.GetPath())
    values = {
        "stretchStiffness": fabric.stretch,
        "shearStiffness": fabric.shear,
        "bendStiffness": fabric.bend,
        "density": fabric.density,
        "thickness": fabric.thickness,
    }
    for name, value in values.items():
        if value is not None:
            attribute = Sdf.AttributeSpec(spec, f"physgraph:material:{name}", Sdf.ValueTypeNames.Float)
            attribute.default = value
