"""A publish hook in plain Python: an open stage in, a validated layer in the publish's folder out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import physgraph_usd as pg


def publish(stage: Any, file: str | Path, options: pg.RefineOptions | None = None) -> list[str]:
    """Refine the garments of an open stage into a file; the stage and its layers are not changed.

    Args:
        stage: The open ``Usd.Stage``, read as it stands.
        file: Layer to write, in a folder that is there.
        options: What to do and how.

    Returns:
        Warnings.

    Raises:
        PhysGraphError: A garment or a frame could not be refined, or the layer is not valid.
    """
    reports: list[pg.RefineReport] = []
    layer = pg.refine_stage(stage, options or pg.RefineOptions(), on_report=reports.append)
    errors = [str(problem) for problem in pg.validate_layer(layer) if problem.severity == "error"]
    if reports[0].failed or errors:
        raise pg.LayerError(f"nothing is published: {[*reports[0].failed.values(), *errors][0]}")
    if not layer.Export(str(file)):
        raise pg.LayerError(f"cannot write {file}")
    return reports[0].warnings
