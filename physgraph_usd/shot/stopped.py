"""Draws the finished frames of a run that was stopped."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from ..errors import UsageError, named_time
from .job import made_from, open_for
from .page.frames import draw_frames
from .page.preview import STILL, check_picture, preview
from .stitch import Chunk, check_same_shot, chunks_in, stopped_run


def preview_any(
    layer: Path | str,
    out: Path | str,
    *,
    shot: Path | str | None = None,
    times: Sequence[float] | None = None,
    **look: Any,
) -> Path:
    """Draw a refined layer, or the finished frames of a stopped run, beside the input.

    Args:
        layer: A refined layer, or a shot; the folder of a stopped run's finished frames or of a chunk; or the layer of
            a stopped run, which is not there.
        out: Picture to write.
        shot: As in `preview`.
        times: As in `preview`; of a stopped run only finished frames.
        look: Further arguments of `preview`.

    Returns:
        The picture written.

    Raises:
        UsageError: As in `preview`; or no frame is finished, a time code is not, or the shot has changed since.
        LayerError: As in `preview`; or a finished frame is damaged.
        StageError: As in `preview`.
    """
    layer, out = Path(layer), Path(out)
    if layer.is_file() or not (layer.is_dir() or stopped_run(layer)):
        return preview(layer, out, shot=shot, times=times, **look)
    (run, *further) = chunks_in([layer], partial=True)
    if further:
        raise UsageError(f"{layer} holds {len(further) + 1} chunks; name one of them")
    check_picture(out, times=times, overwrite=look.get("overwrite", False))
    numbers = _numbers(run, times, single=out.suffix.lower() == STILL)
    source = Path(shot) if shot is not None else run.shot
    options = run.options()
    with closing(open_for(str(source), options)) as opened:
        check_same_shot(run, made_from(opened, run.folder, options))
        results = [run.read(number, run.run["times"][number]) for number in numbers]
        return draw_frames(
            opened, run.run["levels"], [result for result in results if result], out, options=options, **look
        )


def _numbers(run: Chunk, times: Sequence[float] | None, *, single: bool) -> list[int]:
    """Numbers of the finished frames to draw: those at some time codes, the last one, or all."""
    every, finished = run.run["times"], sorted(run.kept)
    if not finished:
        raise UsageError(f"no frame in {run.folder} was solved")
    if times is None:
        return finished[-1:] if single else finished
    wanted = [every.index(time) if time in every else -1 for time in times]
    if absent := [named_time(time) for time, number in zip(times, wanted, strict=True) if number not in run.kept]:
        codes = ", ".join(named_time(every[number]) for number in finished)
        raise UsageError(f"{', '.join(absent)}: not finished in {run.folder}; finished: {codes}")
    return sorted(set(wanted))
