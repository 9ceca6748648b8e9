"""A frame of a whole scene: which garments are solved together, taken over, or left on their cages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...errors import SolveError
from ..deadline import is_over
from ..scene import Frame
from ..strain import has_collapsed, size_left, strayed
from .history import Kept, Known, is_same, origin_of
from .scene_cloth import SceneCloth
from .settings import SolveSettings
from .solve import solve_frame
from .values import FrameInput, split


@dataclass(frozen=True, eq=False)
class Answer:
    """One garment's frame.

    Attributes:
        points: Fine positions [m], world space.
        telemetry: What the report says.
        kept: What its next frame needs.
    """

    points: np.ndarray
    telemetry: dict[str, object]
    kept: Kept


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """One frame of a scene, about to be solved part by part.

    Attributes:
        cloth: What the scene is solved with; its bodies are posed.
        settings: How to solve.
        frame: The frame.
        kept: What is kept of each garment's last frames.
        gap: Whether the time since the last frame is too long to start from it.
        walked: World positions of each cage [m] that another refiner walked here, and from which time code; or None.
        limit: Seconds after which the frame stops where it stands.
    """

    cloth: SceneCloth
    settings: SolveSettings
    frame: Frame
    kept: Sequence[Kept]
    gap: bool
    walked: tuple[Sequence[np.ndarray | None], float] | None
    limit: float

    def solve(self, asked: Sequence[bool]) -> tuple[dict[int, Answer], list[bool]]:
        """Answers by garment, of the parts asked for; and for all garments whether they equal the last ones.

        Raises:
            SolveError: No garment could be solved.
        """
        found, reused = dict[int, Answer](), [False] * len(asked)
        unsolved = dict[tuple[int, ...], SolveError]()
        for part in self.cloth.parts_of(self.frame, self.settings):
            near = self.cloth.near(part, [self.frame.garments[index] for index in part], self.settings)
            same = is_same(part, self.frame, [self.kept[index] for index in part], near)
            for index in part:
                reused[index] = same and self.kept[index].solved
            if not any(asked[index] for index in part):
                continue
            try:
                found |= zip(part, self._answer(part, near, same=same), strict=True)
            except SolveError as error:
                unsolved[part] = error
        if unsolved and not found:
            raise next(iter(unsolved.values()))
        for part, error in unsolved.items():
            found |= zip(part, self._on_cages(part, error), strict=True)
        return found, reused

    def _answer(self, part: tuple[int, ...], near: tuple[int, ...], *, same: bool) -> list[Answer]:
        """Garments upsampled, taken over, or solved."""
        first, points = self.cloth.scene.garments[part[0]], self.frame.garments[part[0]].points
        if has_collapsed(first, points):  # It is alone, and the next frame starts from the last one solved.
            entry = {"start": "not solved: the cage has collapsed", "collapsed": size_left(first, points)}
            return [Answer(self.cloth.upsampled(part[0], points), entry, replace(self.kept[part[0]], solved=False))]
        if not same:
            return self._solve_part(part, near)
        found = [(self.kept[index], self.kept[index].last) for index in part]
        entry: dict[str, object] = {"start": "reused: the input equals the last frame's"}
        return [Answer(last.points, entry, replace(kept, solved=True)) for kept, last in found if last is not None]

    def _on_cages(self, part: tuple[int, ...], error: SolveError) -> list[Answer]:
        """Garments that could not be solved, on their cages' smooth surface; the next frame starts from one before."""
        entry: dict[str, object] = {"start": "not solved: it follows its cage", "not_solved": str(error)}
        points = self.cloth.group(part, self.settings).upsampled([self.frame.garments[index] for index in part])
        kept = [replace(self.kept[index], solved=False) for index in part]
        return [Answer(x, entry, each) for x, each in zip(points, kept, strict=True)]

    def _solve_part(self, part: tuple[int, ...], near: tuple[int, ...]) -> list[Answer]:
        """Solve garments together; bodies that the cloth reaches only as it is solved are taken up."""
        frames, kept = [self.frame.garments[index] for index in part], [self.kept[index] for index in part]
        group = self.cloth.group(part, self.settings)
        edge = float(group.levels[0].spacing.mean())
        origin = origin_of(part, self.frame, kept, near=near, edge=edge, gap=self.gap)
        cage = None if origin.state is not None else self._cage_walked(part)
        while True:
            touching, moved = self.cloth.touching(part, frames, near), origin.moved(part, self.frame, near)
            given = FrameInput(frames, self.frame.time, touching, moved, walked=None if cage is None else cage[0])
            solved = solve_frame(group, given, origin.state)
            more = self.cloth.reached(part, frames, solved.points, self.settings)
            if more <= set(near):
                break
            near = tuple(sorted({*near, *more}))
        self._refuse_strayed(part, solved.points)
        entry = solved.telemetry | self._surroundings(part, near)
        entry |= origin.told(None if cage is None else cage[1]) | (
            {"time_limit": float(f"{self.limit:.3g}")} if is_over() else {}
        )
        states = split(solved.state, group.levels[0].spans, group.levels[-1].spans)
        found = list[Answer]()
        for place, (index, own) in enumerate(zip(part, kept, strict=True)):
            at = self.frame.time, self.frame.garments[index], self.frame.colliders, near, part
            points, crossing = solved.points[place], solved.crossing[place]
            now = Known(*at, points, states[place], crossing, first=own.last is None)
            before = own.last if origin.broken is None else origin.frames[place]
            found.append(Answer(points, entry, Kept(now, before)))
        return found

    def _surroundings(self, part: tuple[int, ...], near: Sequence[int]) -> dict[str, object]:
        """What garments were solved with: bodies, where they feel any, and one another."""
        found: dict[str, object] = {}
        if any(self.cloth.scene.garments[index].colliders for index in part):
            found["near"] = [self.cloth.scene.colliders[each].path for each in near]
        if len(part) > 1:
            found["together"] = [self.cloth.scene.garments[index].path for index in part]
        return found

    def _cage_walked(self, part: tuple[int, ...]) -> tuple[np.ndarray, float] | None:
        """World positions of cages that another refiner walked to this frame [m], and from which time code."""
        if self.walked is None:
            return None
        found = [each for each in (self.walked[0][index] for index in part) if each is not None]
        return (np.concatenate(found), self.walked[1]) if len(found) == len(part) else None

    def _refuse_strayed(self, part: tuple[int, ...], points: Sequence[np.ndarray]) -> None:
        """Refuse cloth that is no more where its cage is."""
        for index, fine in zip(part, points, strict=True):
            last = self.kept[index].last
            before = None if last is None else last.frame.points
            if wrong := strayed(self.frame.garments[index].points, fine, before=before):
                when = "" if self.frame.time is None else f" at time code {self.frame.time:g}"
                raise SolveError(f"<{self.cloth.scene.garments[index].path}>{when}: {wrong}")
