"""A shot and the values that an artist tries on it, with a page or without one.

session = TuneSession("shot.usda", out="shot.tuned.usda")
session.set_value("/World/Coat", "bendStiffness", 2e-5)
session.solve()    # Roughly, from where the cloth was.
session.settle()   # On from there, as `refine` solves.
session.save()
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import join
from typing import Any

import numpy as np

from ..errors import UsageError
from ..shot.solve import prepare_device
from ..shot.untagged import AUTO, find_candidates, open_with_colliders
from ..shot.warnings import of_unfelt
from ..solver.fabric import PRESETS
from ..solver.mesh.subdivide import Refinement
from ..solver.resolution import choose_levels, sample_frames
from ..solver.scene import Frame
from ..usd.schema import AUTO_LEVEL, FABRIC, GARMENT, fabric_values
from ..usd.write.tag import tag
from .solver import FrameSolver, Seen
from .values import TUNABLES


@dataclass(frozen=True, eq=False)
class Shown:
    """A solved frame.

    Attributes:
        frame: The input: cages, values and bodies.
        points: Fine positions of each garment [m], world space; None for one without a sample here.
        telemetry: The solver's figures of each garment, as in a report's frame.
        seconds: Wall time of reading and solving.
        settled: Whether the frame is solved as ``refine`` solves it.
    """

    frame: Frame
    points: tuple[np.ndarray | None, ...]
    telemetry: tuple[dict[str, Any], ...]
    seconds: float
    settled: bool


class TuneSession:
    """Values tried on a shot, and the cloth with them.

    Attributes:
        out: The layer that `save` writes.
        garments: Prim paths of the garments.
        times: The shot's time codes; (None,) where it has no samples.
        time: The one that is solved next.
        levels: Subdivisions of each garment.
        contact: Whether cloth feels bodies and cloth.
        warning: Bodies that the cloth touches and does not feel, in words, or "".
        values: The values that `save` authors, by prim path and the schema's short names.
    """

    def __init__(
        self,
        shot: str | Path,
        *,
        garments: Sequence[str] = (),
        colliders: Sequence[str] = (),
        out: str | Path | None = None,
        device: str = "cpu",
        overwrite: bool = False,
    ) -> None:
        """Open a shot at its first frame.

        Args:
            shot: The shot file; never edited.
            garments: Prim paths, names, globs or collections; empty finds applied schemas.
            colliders: Bodies, as ``garments``.
            out: Layer to save into; ``<shot>.tuned.usda`` beside the shot when None.
            device: Where to compute: "cpu", "cuda" or "auto".
            overwrite: Whether a file there may be replaced.

        Raises:
            UsageError: The layer exists.
            StageError: The shot cannot be read.
        """
        self._device = prepare_device(device)
        self.out = Path(out) if out is not None else Path(shot).with_suffix(".tuned.usda")
        if self.out.exists() and not overwrite:
            raise UsageError(f"{self.out} exists; choose another name with -o, or replace it by --overwrite")
        self.shot = self._opened = open_with_colliders(shot, garments=garments, colliders=colliders)
        named = self.shot.colliders if AUTO in colliders else tuple(colliders)
        self._overwrite, self._named = overwrite, (tuple(garments), named)
        scene = self.shot.scene
        self.garments = tuple(garment.path for garment in scene.garments)
        self.times: tuple[float | None, ...] = scene.times or (None,)
        self.time, self.contact = self.times[0], True
        frames = sample_frames(self.shot.every_time, self.shot.frame)
        self.warning = "".join(of_unfelt([each for each in find_candidates(self.shot) if each.is_taken]))
        self.levels = [choice.level for choice in choose_levels(scene, frames)]
        # A level that is chosen from the fabric would be chosen anew from what is tried.
        chosen = zip(scene.garments, self.levels, strict=True)
        self.values = {g.path: {"refine:level": float(k)} for g, k in chosen if g.level == AUTO_LEVEL}
        self._solver = FrameSolver(self.shot, self.levels, contact=True, device=self._device)
        self._shown: Shown | None = None  # None once anything was set.

    def close(self) -> None:
        """Let go of the stage."""
        self._opened.close()

    @property
    def refinements(self) -> Sequence[Sequence[Refinement]]:
        """The subdivisions of each garment, coarsest first."""
        return self._solver.refinements

    def value(self, garment: str, name: str) -> float | None:
        """A tunable value of a garment in the frame, SI; None where nothing gives one."""
        return TUNABLES[name].read(self.shot.frame(self.time).garments[self._index(garment)])

    def set_value(self, garment: str, name: str, value: float) -> None:
        """Try a value [SI], rounded as a layer holds it.

        Raises:
            UsageError: The garment or the name is unknown, or the value is outside its limits.
        """
        if name not in TUNABLES:
            raise UsageError(f"unknown value '{name}'; known values: {', '.join(TUNABLES)}")
        self._try(garment, {name: value})

    def set_preset(self, garment: str, preset: str) -> None:
        """Try a fabric's values in place of those that were tried.

        Raises:
            UsageError: The garment or the fabric is unknown.
        """
        if preset not in PRESETS:
            raise UsageError(f"unknown preset '{preset}'; known presets: {', '.join(sorted(PRESETS))}")
        tried = self.values.get(garment, {})
        kept = {name: value for name, value in tried.items() if GARMENT[name].group != FABRIC}
        self._read_with(garment, kept | _rounded(fabric_values(PRESETS[preset])))

    def set_as_authored(self, garment: str) -> None:
        """Take a garment's values from the shot again; its level stays.

        Raises:
            UsageError: The garment is unknown.
        """
        values = self.values.get(garment, {})
        self._read_with(garment, {name: value for name, value in values.items() if name not in TUNABLES})

    def set_level(self, garment: str, level: int) -> None:
        """Try another number of subdivisions.

        Raises:
            UsageError: The garment is unknown, or the level is outside its limits.
        """
        index = self._index(garment)
        if level < 0:
            raise UsageError(f"level {level}: give 0 or more")
        self._try(garment, {"refine:level": level})
        self.levels[index] = level
        self._solver = FrameSolver(self.shot, self.levels, contact=self.contact, device=self._device)

    def set_contact(self, on: bool) -> None:
        """Let cloth feel bodies and cloth, or nothing."""
        self.contact, self._shown = on, None
        self._solver.feel(contact=on)

    def set_time(self, time: float | None) -> None:
        """Go to a time code.

        Raises:
            UsageError: The shot has no sample there.
        """
        if time not in self.times:
            raise UsageError(f"no sample at time code {time}; they run from {self.times[0]} to {self.times[-1]}")
        self.time, self._shown = time, None

    def solve(self, seen: Seen = lambda _: None, cancelled: Callable[[], bool] = lambda: False) -> Shown:
        """The frame with the values tried, roughly, from the last result; a first frame as `settle` does.

        Arguments are those of `FrameSolver.solve`.

        Raises:
            SolveError: A term of the potential is not finite.
            StageError: The frame cannot be read.
        """
        return self._shown or self._show(seen, cancelled, rough=True)

    def settle(self, seen: Seen = lambda _: None, cancelled: Callable[[], bool] = lambda: False) -> Shown:
        """The frame as ``refine`` solves it from the last result; not settled if ``cancelled``.

        Arguments and errors are those of `solve`.
        """
        if self._shown is not None and self._shown.settled:
            return self._shown
        return self._show(seen, cancelled, rough=False)

    @property
    def command(self) -> str:
        """The command that refines the whole shot with the saved layer."""
        words = ["physgraph-usd", "refine", str(self.out), "-o", str(self.out.with_suffix(".refined.usdc"))]
        words += [] if self._device == "cpu" else ["--device", self._device]
        for option, paths in zip(("--garment", "--collider"), self._named, strict=True):
            words += [word for path in paths for word in (option, path)]
        return join(words + ([] if self.contact else ["--contact", "off", "--self-contact", "off"]))

    def save(self) -> Path:
        """Write the values tried as a layer over the shot, as ``tag`` does; nothing else is ever written.

        Raises:
            UsageError: The layer's name is one of the shot's files, or its suffix is unknown.
            StageError: A garment lies in an instance.
            LayerError: It cannot be written.
        """
        (_, bodies), over = self._named, self._overwrite
        written = tag(
            self._opened.path, self.out, garments=self.garments, colliders=bodies, values=self.values, overwrite=over
        )
        self._overwrite = True  # It is this session's own from here on.
        return written

    def _show(self, seen: Seen, cancelled: Callable[[], bool], *, rough: bool) -> Shown:
        began, rough = clock.perf_counter(), rough and self._solver.begun  # A first frame is as `refine` solves it.
        state = self._solver.solve(self.shot, self.time, rough=rough, seen=seen, cancelled=cancelled)
        seconds = clock.perf_counter() - began
        found = state.points, tuple(map(dict, state.telemetry)), seconds, not (rough or cancelled())
        self._shown = Shown(self.shot.frame(self.time), *found)
        return self._shown

    def _index(self, garment: str) -> int:
        if garment not in self.garments:
            raise UsageError(f"no garment <{garment}>; garments: {', '.join(self.garments)}")
        return self.garments.index(garment)

    def _try(self, garment: str, values: Mapping[str, float]) -> None:
        """Read the shot with values more, rounded to floats that a layer can hold."""
        self._read_with(garment, self.values.get(garment, {}) | _rounded(values))

    def _read_with(self, garment: str, values: dict[str, float]) -> None:
        """Read the shot with a garment's values; values that cannot be used change nothing."""
        self._index(garment)
        tried = {**self.values, garment: values}
        texts = [
            f"{path}.{GARMENT[name].name}={value!r}" for path, each in tried.items() for name, value in each.items()
        ]
        self.shot, self.values, self._shown = self._opened.with_values(texts), tried, None


def _rounded(values: Mapping[str, float]) -> dict[str, float]:
    """Values as floats that a layer can hold."""
    return {name: float(np.float32(value)) for name, value in values.items()}
