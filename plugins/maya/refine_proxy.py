"""Refined cloth on the stage of a Maya USD proxy shape. Not tested: it needs Maya.

import refine_proxy
refine_proxy.refine("|stage1|stageShape1")
"""

from __future__ import annotations

from typing import Any

import mayaUsd.ufe

import physgraph_usd as pg

_SHOWN: dict[str, Any] = {}
"""Layers in memory by proxy shape: a stage does not keep those alive that it names."""


def refine(shape: str, **options: Any) -> pg.RefineReport:
    """Refine the garments of a proxy shape's stage, as it stands, and show them by its session layer.

    Args:
        shape: Path of the proxy shape.
        options: Options of `physgraph_usd.RefineOptions`.

    Returns:
        The report.
    """
    reports: list[pg.RefineReport] = []
    stage = mayaUsd.ufe.getStage(shape)
    layer = pg.refine_stage(stage, pg.RefineOptions(**options), on_report=reports.append)
    over = stage.GetSessionLayer().subLayerPaths
    if shape in _SHOWN and _SHOWN[shape].identifier in over:
        over.remove(_SHOWN[shape].identifier)
    over.insert(0, layer.identifier)
    _SHOWN[shape] = layer
    return reports[0]
