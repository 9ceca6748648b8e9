"""Refined cloth in Solaris, by a Python Script LOP with two lines.

    import refine_lop
    refine_lop.cook(hou.pwd())

Spare parameters of the node, all optional: ``garments`` (paths, separated by blanks), ``frames`` (first and last one),
``level``. The node has to cook once, not each frame: all frames are in the layer.
"""

from __future__ import annotations

from typing import Any

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
    node.editableLayer().TransferContent(layer)
    for warning in reports[0].warnings:
        node.addWarning(warning)
    return reports[0]


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
