"""Draws solved frames that no layer holds yet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ...errors import LayerError
from ...solver.level import refine_garments
from ...solver.scene import Result
from ...usd.read.reader import Shot
from ...usd.write.writer import LayerWriter
from ..options import RefineOptions
from .preview import preview


def draw_frames(
    shot: Shot, levels: Sequence[int], results: Sequence[Result], out: Path, *, options: RefineOptions, **look: Any
) -> Path:
    """Draw solved frames of an open shot beside its input, by way of a temporary layer.

    Args:
        shot: The shot, open.
        levels: Subdivisions of each garment.
        results: The frames, in order; all are solved.
        out: Picture to write.
        options: The run's options.
        look: Size, camera and overwriting, as in `preview`.

    Returns:
        The picture written.

    Raises:
        UsageError: The picture exists, or is a file of the shot.
        LayerError: The picture cannot be written.
        StageError: The shot shows no mesh.
    """
    times = [result.time for result in results if result.time is not None]
    refinements = refine_garments(shot.scene.garments, levels)
    try:
        with TemporaryDirectory(prefix="physgraph-usd-") as folder:
            layer = Path(folder) / "frames.usdc"
            writer = LayerWriter(
                shot, refinements, layer, mode=options.mode, scheme=options.scheme, times=times or None
            )
            with writer:
                for result in results:
                    writer.write(result.as_changed())
                writer.close()
            return preview(layer, out, shot=shot.path, times=times or None, **look)
    except OSError as error:
        raise LayerError(f"cannot draw {out}: {error.strerror or error}") from error
