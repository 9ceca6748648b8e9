"""A shot and what an artist tries on it, solved frame by frame, with a page or without one.

session = TuneSession("shot.usda", out="shot.tuned.usda")
session.set_value("/World/Coat", "bendStiffness", 2e-5)
session.solve()    # Roughly, from where the cloth was.
session.settle()   # On from there, as `refine` solves.
session.save()
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from copy import copy
from pathlib import Path
from shlex import join

from ..errors import UsageError
from ..shot.findings.table import Facts, texts
from ..shot.findings.untagged import find_candidates
from ..shot.solve import prepare_device
from ..solver.mesh.subdivide import Refinement
from .setting import Setting
from .solver import FrameSolver, Seen
from .takes import Shown, Start, Take, Takes
from .tried import TriedShot
from .tuning import Tuning


class TuneSession(Tuning):
    """Values tried on a shot, and the cloth with them.

    Attributes:
        out: The layer that `save` writes.
        solver: The solver, with the last positions.
        takes: Frames of the shot that were solved in order.
        kept: The setting A that the present one is compared with, and its cloth; or None.
        warning: Bodies that the cloth touches and does not feel, in words, or "".
    """

    def __init__(
        self,
        shot: str | Path,
        *,
        garments: Sequence[str] = (),
        colliders: Sequence[str] = (),
        bind: Sequence[str] = (),
        out: str | Path | None = None,
        device: str = "cpu",
        overwrite: bool = False,
    ) -> None:
        """Open a shot at its first frame.

        Args:
            shot: The shot file; never edited.
            garments: Prim paths, names, globs or collections; empty finds applied schemas.
            colliders: Bodies, as ``garments``.
            bind: Meshes, curves or points that follow the nearest garment, as ``garments``.
            out: Layer to save into; ``<shot>.tuned.usda`` beside the shot when None.
            device: Where to compute: "cpu", "cuda" or "auto".
            overwrite: Whether a file there may be replaced.

        Raises:
            UsageError: The layer exists.
            StageError: The shot cannot be read.
        """
        self._device, self._overwrite = prepare_device(device), overwrite
        self.out = Path(out) if out is not None else Path(shot).with_suffix(".tuned.usda")
        if self.out.exists() and not overwrite:
            raise UsageError(f"{self.out} exists; choose another name with -o, or replace it by --overwrite")
        super().__init__(TriedShot(shot, garments=garments, colliders=colliders, bind=bind))
        self.warning = "".join(texts("unfelt", Facts(candidates=find_candidates(self.shot))))
        self.solver = FrameSolver(self.shot, self.setting.levels, contact=True, device=self._device)
        self._solves = self.setting  # What the solver was made for, or solved last.
        self._shown: tuple[Setting, Shown] | None = None
        self.takes = Takes()
        self.kept: Take | None = None
        self._steps = Takes()  # Settled cloth of the settings looked at last, for undo.

    def close(self) -> None:
        """Let go of the stage and of all solvers; the session cannot be used afterwards."""
        self._tried.close()
        self.takes, self.kept, self._shown, self._steps = Takes(), None, None, Takes()
        del self.solver

    @property
    def refinements(self) -> Sequence[Sequence[Refinement]]:
        """The subdivisions of each garment, coarsest first."""
        return self.solver.refinements

    def set_time(self, time: float | None) -> None:
        """Go to a time code; a take of the present setting is used.

        Raises:
            UsageError: The shot has no sample there.
        """
        self.time, self._shown = (time := self.sampled(time)), None
        self._go_to(self.takes.fresh(time, self.setting))

    def _go(self, way: int) -> None:
        super()._go(way)
        self._go_to(self._steps.fresh(self.time, self.setting))

    def _go_to(self, take: Take | None) -> None:
        if take is not None:
            self.solver, self._solves = copy(take.start.solver), take.setting
            self._shown = take.setting, take.shown

    def keep(self) -> None:
        """Store the present setting and its settled cloth as A."""
        shown = self.settle()
        self.kept = Take(Start(self.setting, self.shot, copy(self.solver)), shown)

    def swap(self) -> None:
        """Go to A's setting, from A's cloth, and keep the present one as A; does nothing without A."""
        if (kept := self.kept) is not None:
            self.keep()
            self.put(kept.setting, "A and B exchanged")
            self.solver, self._solves = copy(kept.start.solver), kept.setting

    def solve(self, seen: Seen = lambda _: None, cancelled: Callable[[], bool] = lambda: False) -> Shown:
        """The frame with the values tried, roughly, from the last result; a first frame as `settle` does.

        Arguments are those of `FrameSolver.solve`.

        Raises:
            GarmentError: A rest shape cannot be solved on.
            SolveError: A term of the potential is not finite.
            StageError: The frame cannot be read.
        """
        return self._known or self._show(seen, cancelled, rough=True)

    def settle(self, seen: Seen = lambda _: None, cancelled: Callable[[], bool] = lambda: False) -> Shown:
        """The frame as ``refine`` solves it from the last result; not settled if ``cancelled``.

        Arguments and errors are those of `solve`.
        """
        known = self._known
        return known if known and known.settled else self._show(seen, cancelled, rough=False)

    @property
    def kept_shown(self) -> Shown | None:
        """A's cloth in the present frame; None without A, or if unsolved."""
        if self.kept is None or self.kept.shown.frame.time == self.time:
            return None if self.kept is None else self.kept.shown
        return take.shown if (take := self.takes.fresh(self.time, self.kept.setting)) else None

    def go_on(self, span: tuple[float, float] | None, cancelled: Callable[[], bool] = lambda: False) -> bool:
        """Solve what else is looked at: A in this frame, or the next frame of a range; returns whether there was any.

        Args:
            span: First and last time code to solve in order into `takes`, with A's setting too; None solves none.
            cancelled: As in `settle`; errors are those of `solve`.
        """
        if self.kept is not None and self.kept_shown is None:
            take = self.kept.start.at(self.time, cancelled)
            self.kept = take if take.shown.settled else self.kept
            return True
        return self._solve_next(self.codes_in(span), cancelled) is not None

    def step(self, span: tuple[float, float] | None, cancelled: Callable[[], bool] = lambda: False) -> Shown | None:
        """Go to the next frame of a range, in a cycle, and return it; None if solving it was cancelled.

        Before a missing or stale frame, the first such frame of the range is solved and shown. Arguments and errors are
        those of `go_on`.
        """
        times = self.codes_in(span)
        if not times:
            return self.solve()
        after = next((time for time in times if self.time is None or time > self.time), times[0])
        if any(self.takes.fresh(after, each.setting) is None for each in self._starts()):
            solved = self._solve_next(times, cancelled)
            after = times[0] if solved is None else solved
        self.set_time(after)
        return self._known

    def _starts(self) -> list[Start]:
        """The present setting, and A's."""
        self._prepare()
        present = Start(self.setting, self.shot, self.solver)
        return [present] if self.kept is None else [present, self.kept.start]

    def _solve_next(self, times: Sequence[float], cancelled: Callable[[], bool]) -> float | None:
        """Solve a range's first missing or stale frame; returns the time code."""
        found = (self.takes.solve_next(times, start, cancelled) for start in self._starts() if times)
        return next((time for time in found if time is not None), None)

    @property
    def command(self) -> str:
        """The command that refines the whole shot with the saved layer."""
        words = ["physgraph-usd", "refine", str(self.out), "-o", str(self.out.with_suffix(".refined.usdc"))]
        words += [] if self._device == "cpu" else ["--device", self._device]
        for option, paths in zip(("--garment", "--collider", "--bind"), self._tried.named.values(), strict=True):
            words += [word for path in paths for word in (option, path)]
        return join(words + ([] if self.setting.contact else ["--contact", "off", "--self-contact", "off"]))

    def save(self) -> Path:
        """Write values and maps as a layer over the shot, like ``tag``; raises UsageError, StageError or LayerError."""
        written = self._tried.save(self.setting, self.out, overwrite=self._overwrite)
        self._overwrite = True  # It is this session's own from here on.
        return written

    @property
    def _known(self) -> Shown | None:
        """The last result, if of the present setting and time; else None."""
        return self._shown[1] if self._shown is not None and self._shown[0] is self.setting else None

    def _show(self, seen: Seen, cancelled: Callable[[], bool], *, rough: bool) -> Shown:
        began = clock.perf_counter()
        self._prepare()
        rough = rough and self.solver.begun  # A first frame is as `refine` solves it.
        result = self.solver.solve(self.shot, self.time, rough=rough, seen=seen, cancelled=cancelled)
        shown = Shown.of(self.shot.frame(self.time), result, began=began, settled=not (rough or cancelled()))
        self._shown = self.setting, shown
        if shown.settled:
            self._steps.keep_last(Take(Start(self.setting, self.shot, copy(self.solver)), shown))
        return shown

    def _prepare(self) -> None:
        """Build a new solver if levels or maps changed, starting from the last positions."""
        setting, before, old = self.setting, self._solves, self.solver
        if setting.levels != before.levels or setting.painted is not before.painted:
            self.solver = FrameSolver(self.shot, setting.levels, contact=setting.contact, device=self._device)
            self.solver.continue_from(old)
        if setting.contact != before.contact:
            self.solver.feel(contact=setting.contact)
        self._solves = setting
