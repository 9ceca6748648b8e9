"""Opens a shot with the options of a run."""

from __future__ import annotations

from ..usd.read.reader import Shot
from ..usd.view import Stage
from .options import RefineOptions
from .untagged import open_with_colliders


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


def why_not_posed(shot: Shot, options: RefineOptions) -> str:
    """Why requested poses from the bind pose to the first frame are not solved; "" if they are."""
    if options.temporal == "off":
        return "--temporal off solves each frame by itself"
    return "" if shot.is_skinned else "no garment is skinned"
