"""Refined cloth in Solaris, by a Python Script LOP with two lines.

    import refine_lop
    refine_lop.cook(hou.pwd())

Spare parameters of the node, all optional: ``garments`` (paths, separated by blanks), ``frames`` (first and last one),
``level``. The node has to cook once, not each frame: all frames are in the layer.

The animation has to be on the stage with all its samples, as a Sublayer LOP brings it from a file. A live SOP Import
holds one sample, that of the frame at which it cooked, and the cloth would stand still: write it to a file first.
"""

from __future__ import annotations

from typing import Any

from pxr import Sdf

import physgraph_usd as pg


def cook(node: Any) -> pg.RefineReport:
    """Refine the garments of the stage that comes into the node, and add the result to the node's layer.

    Args:
        node: The ``hou.LopNode`` that is cooking.

    Returns:
        The report; its warnings are on the node.

    Raises:
        PhysGraphError: What Houdini shows as the node's error.
    """
    reports: list[pg.RefineReport] = []
    layer = pg.refine_stage(node.editableStage(), _options(node), on_report=reports.append)
    _add(layer.pseudoRoot, node.editableLayer())
    for warning in reports[0].warnings:
        node.addWarning(warning)
    return reports[0]


def _add(source: Sdf.PrimSpec, target: Sdf.Layer) -> None:
    """Add what lies at and below a spec to a layer that keeps all else.

    A sublayer would be weaker than what the layer says of the cage itself. Attributes are replaced whole: coarse
    samples between fine ones would have other topology.
    """
    there = target.GetPrimAtPath(source.path)
    if there is None:
        Sdf.CopySpec(source.layer, source.path, target, source.path)
        return
    kept = there.ListInfoKeys() if source.path == Sdf.Path.absoluteRootPath else ("apiSchemas",)
    for key in source.ListInfoKeys():
        if key == "customLayerData":
            there.SetInfo(key, dict(target.customLayerData) | dict(source.layer.customLayerData))
        elif key not in ("specifier", "typeName") and not (there.HasInfo(key) and key in kept):
            there.SetInfo(key, source.GetInfo(key))
    for spec in source.properties:
        Sdf.CopySpec(source.layer, spec.path, target, spec.path)
    for child in source.nameChildren:
        _add(child, target)


def _options(node: Any) -> pg.RefineOptions:
    """The options that the node's spare parameters make."""
    parms = {name: node.parm(name) for name in ("garments", "frames", "level")}
    given: dict[str, Any] = {}
    if parms["garments"] is not None:
        given["garments"] = tuple(parms["garments"].evalAsString().split())
    if parms["frames"] is not None and (span := parms["frames"].evalAsString().split()):
        given["frames"] = (float(span[0]), float(span[-1]))
    if parms["level"] is not None:
        given["level"] = parms["level"].evalAsInt()
    return pg.RefineOptions(**given)
