"""Opens a shot with the options of a run."""

from __future__ import annotations

from ..usd.read.reader import Shot
from ..usd.view import Stage
from .findings.untagged import open_with_colliders
from .options import RefineOptions


def open_for(shot: str | Stage, options: RefineOptions) -> Shot:
    """Open a shot with the reading options.

    Raises:
        UsageError: An option cannot be used.
        StageError: The stage cannot be read.
    """
    return open_with_colliders(
        shot,
        garments=options.garments,
        colliders=options.colliders,
        bind=options.bind,
        frames=options.frames if options.preroll is None else None,
        level=options.level,
        overrides=options.overrides,
        rest_frame=options.rest_frame,
        gravity=options.gravity,
    )
