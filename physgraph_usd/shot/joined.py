"""Joins what two processes solved of the same frames: cloth that can lie in several ways lies in one of them at a time.

Over the L frames of a pre-roll the positions go from one solution to the other in equal parts,

    x_k = (1 - s_k) a_k + s_k b_k,   s_k = k / (L + 1),   k = 1 .. L,

so that the seam adds |b - a| / (L + 1) to a frame's move in place of |b - a| at once. From the nearer of the two the
cloth moves there as far as nothing newly crosses, and out of bodies. Where the input itself crosses, that promises
less: if more crosses than in both, or is in bodies, nothing is joined and the seam is told.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LayerError
from ..solver.frame.refiner import Refiner
from ..solver.level import refine_garments
from ..solver.mesh.threads import start_warp
from ..solver.scene import Frame
from ..usd.read.reader import Shot
from ..usd.stage import is_there
from ..usd.write.seams import Look, Points, Seam, between
from ..usd.write.stitch import SEAM_BOUND
from ..usd.write.stitch import check_seams as look_at_seams
from ..usd.write.stitch import stitch as stitch_layers
from ..usd.write.track import to_local
from .frames import Lead, Outcome
from .options import RefineOptions
from .untagged import open_with_colliders

_FINEST = 6
_Pair = tuple[np.ndarray | None, np.ndarray | None]
Join = Callable[[float | None, Sequence[_Pair], float], tuple[list[np.ndarray | None], str]]
"""Joins one frame, of its time code, what both sides have of each garment, and the part of the second."""


def stitch(
    chunks: Sequence[str | Path],
    out: str | Path,
    *,
    frames: tuple[float, float] | None = None,
    seam_bound: float = SEAM_BOUND,
    clips: bool = False,
    root: str | Path | None = None,
    overwrite: bool = False,
) -> list[Seam]:
    """Join chunks of one shot into one layer, as `usd.stitch.stitch` does, and look at the joined frames in the shot.

    Args:
        chunks: Layers that `refine_shot` wrote with ``preroll``, in any order; a folder stands for all layers in it.
        out: Layer to write.
        frames: First and last time code that the layer must have; None for all of the shot.
        seam_bound: Most that a seam may add to a frame's move, RMS over a garment, in mean fine edge lengths.
        clips: Leave the chunks where they are and make ``out`` a small layer that plays them as value clips.
        root: A small root layer to write, with the layer over the shot.
        overwrite: Whether existing files may be replaced.

    Returns:
        The seams, in order.

    Raises:
        UsageError: A frame is missing or doubled, chunks are not of one shot, version and set of options, or ``out`` is
            one of them.
        LayerError: A chunk cannot be read, a seam moves too far, or the layer cannot be written or is invalid.
    """
    given = {"frames": frames, "seam_bound": seam_bound, "clips": clips, "root": root, "overwrite": overwrite}
    with ExitStack() as stack:
        return stitch_layers(chunks, out, **given, look_with=partial(_looking, stack))


def check_seams(chunks: Sequence[str | Path], *, of: Path | None = None, seam_bound: float = SEAM_BOUND) -> list[Seam]:
    """Look at the seams of chunks in the shot; arguments, result and errors are those of `usd.stitch.check_seams`."""
    with ExitStack() as stack:
        return look_at_seams(chunks, of=of, seam_bound=seam_bound, look_with=partial(_looking, stack))


def joined(outcomes: Iterable[Outcome], look: Join, tell: Callable[[str], object]) -> Iterator[Outcome]:
    """Frames in order, joined where two processes solved them.

    Args:
        outcomes: The frames, those that two solved with the other one's as ``lead``.
        look: Joins one frame, as `Looking` does.
        tell: Told of each seam that is not joined.
    """
    both: list[tuple[Outcome, Lead]] = []
    for outcome in outcomes:
        ends = bool(both) and (outcome.lead is None or outcome.lead.seam != both[0][1].seam)
        if ends:
            yield from _over(both, look, tell)
            both = []
        # What it equals is the pre-roll's last frame, not the one that was written.
        given = replace(outcome, reused=(False,) * len(outcome.reused)) if ends else outcome
        if outcome.lead is None:
            yield given
        else:
            both.append((given, outcome.lead))
    yield from _over(both, look, tell)


def _over(both: Sequence[tuple[Outcome, Lead]], look: Join, tell: Callable[[str], object]) -> Iterator[Outcome]:
    """The frames of one seam."""
    made, why = [], ""
    for outcome, lead in both:
        pairs = list(zip(outcome.points, lead.outcome.points, strict=False))
        differ = any(a is not None and b is not None and not np.array_equal(a, b) for a, b in pairs)
        if differ and not why:
            points, why = look(outcome.time, pairs, lead.weight)
            made.append(replace(outcome, points=tuple(points), reused=(False,) * len(points)))
        else:
            made.append(outcome)
    if why:
        tell(f"the cloth jumps after time code {both[-1][0].time:g}, where the work of two processes meets: {why}")
    for (outcome, _), each in zip(both, made, strict=True):
        yield replace(outcome if why else each, lead=None)


class Looking:
    """Looks at joined frames of a shot: nothing in bodies, nothing newly crossing; its solver is built when needed."""

    def __init__(self, opened: Shot, options: RefineOptions, levels: Sequence[int]) -> None:
        """Take a shot.

        Args:
            opened: The shot.
            options: How it was refined.
            levels: Subdivisions of each garment.
        """
        self._opened, self._options, self._levels = opened, options, list(levels)
        self._refiner: Refiner | None = None

    def __call__(
        self, time: float | None, pairs: Sequence[_Pair], weight: float
    ) -> tuple[list[np.ndarray | None], str]:
        """Join one frame.

        Args:
            time: Its time code.
            pairs: Of each garment, world positions [m] before and after the seam, or None where it has no sample.
            weight: Part of the second.

        Returns:
            World positions of each garment, and what newly crosses in words, "" where nothing does.
        """
        made = [a if a is None or b is None else between(a, b, weight) for a, b in pairs]
        sides = [a for a, _ in pairs], [b for _, b in pairs]
        near, far = sides if weight < 0.5 else sides[::-1]
        return self.looked_at(self._opened.frame(time), near, far, made)

    def looked_at(
        self,
        frame: Frame,
        near: Sequence[np.ndarray | None],
        far: Sequence[np.ndarray | None],
        made: Sequence[np.ndarray | None],
    ) -> tuple[list[np.ndarray | None], str]:
        """Move cloth safely from the nearer solution to joined positions, and compare what crosses then with both."""
        if self._refiner is None:
            start_warp()
            threads = os.cpu_count() or 1
            given = {"levels": self._levels, "device": self._options.device, "threads": threads}
            self._refiner = Refiner(self._opened.scene, self._options.solve_settings(), **given)
        found = self._refiner.moved_safely(frame, near, made)
        told = [[each for _, each in self._refiner.moved_safely(frame, side, side)] for side in (near, far)]
        for index, (_, own) in enumerate(found):
            worse = _worse(own, [side[index] for side in told])
            if worse:
                return [each for each, _ in found], f"joined, <{self._opened.sources[index].path}> would have {worse}"
        return [each for each, _ in found], ""


def _worse(own: Mapping[str, Any], others: Sequence[Mapping[str, Any]]) -> str:
    """Which count of contact is larger than in all other solutions, in words."""
    counts, beside = _counts(own), [_counts(each) for each in others]
    for name, count in counts.items():
        if count > max(each.get(name, 0) for each in beside):
            return f"{count:,} {name}"
    return ""


def _counts(told: Mapping[str, Any]) -> dict[str, int]:
    """What crosses and what is in bodies, of telemetry of contact."""
    bodies = {f"vertices inside <{path}>": each["after"]["inside"] for path, each in told.get("bodies", {}).items()}
    return {"edges through cloth": told.get("cloth", {}).get("after", {}).get("crossings", 0)} | bodies


def _looking(stack: ExitStack, shot: Path, options: Mapping[str, Any], meshes: Mapping[str, int]) -> Look | None:
    """What looks at joined frames of a shot whose chunks are stitched, or None where the shot is not there any more.

    Args:
        stack: Closes the shot at its end.
        shot: The shot.
        options: Those that the chunks were made with, plain.
        meshes: Number of vertices of each fine mesh, by its path.
    """
    if not is_there(shot):
        return None
    plain = {name: value for name, value in options.items() if name not in ("frames", "preroll", "weights")}
    made_with = RefineOptions(**plain)
    given = {name: getattr(made_with, name) for name in ("garments", "colliders", "level", "overrides", "rest_frame")}
    opened = stack.enter_context(closing(open_with_colliders(str(shot), **given)))
    paths = [str(source.path) + ("_refined" if made_with.mode == "sibling" else "") for source in opened.sources]
    levels = [_level_of(opened, index, meshes.get(path)) for index, path in enumerate(paths)]
    looking = Looking(opened, made_with, levels)
    return partial(_look_at_local, opened, looking, paths)


def _level_of(opened: Shot, index: int, count: int | None) -> int:
    """How often a garment was subdivided to have a number of vertices; 0 where it is in no chunk."""
    for level in range(_FINEST + 1) if count is not None else ():
        chain = refine_garments(
            opened.scene.garments, [level if k == index else 0 for k in range(len(opened.sources))]
        )[index]
        if (chain[-1].mesh if chain else opened.scene.garments[index].mesh).vertex_count == count:
            return level
    if count is None:
        return 0
    said = "is not what the chunks were refined from: it has changed since; refine them anew"
    raise LayerError(f"<{opened.sources[index].path}> of {opened.path} {said}")


def _look_at_local(
    opened: Shot, looking: Looking, paths: Sequence[str], time: float, near: Points, far: Points, made: Points
) -> tuple[dict[str, np.ndarray], str]:
    """`Look` at local positions by path; those of garments that are not joined there are left out."""
    matrices = {path: opened.to_metres(index, time) for index, path in enumerate(paths) if path in made}
    sides = [[_world(each.get(path), matrices.get(path)) for path in paths] for each in (near, far, made)]
    found, worse = looking.looked_at(opened.frame(time), *sides)
    out = dict(made)
    for path, given, each in zip(paths, sides[2], found, strict=True):
        if given is not None and each is not None and not np.array_equal(given, each):
            out[path] = to_local(each, matrices[path], path, time)
    return out, worse


def _world(local: np.ndarray | None, matrix: np.ndarray | None) -> np.ndarray | None:
    return None if local is None or matrix is None else local.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
