"""An artist's trials on a shot: values, fabrics, painted maps and levels, with undo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..errors import UsageError, named_time
from ..solver.fabric import PRESETS
from ..solver.resolution import choose_levels, sample_frames
from ..usd.lookup import check_known
from ..usd.schema import AUTO_LEVEL, FABRIC, GARMENT, fabric_values
from ..usd.times import found_among, within
from .setting import History, Setting
from .tried import TriedShot
from .values import MAPS, TUNABLES


class Tuning:
    """A shot and the settings tried on it, without a solver.

    Attributes:
        garments: Prim paths of the garments.
        times: The shot's time codes; (None,) where it has no samples.
        time: The one that is looked at.
        shot: The shot read with the present setting.
        history: The settings so far.
    """

    def __init__(self, tried: TriedShot) -> None:
        """Begin at a shot's first frame."""
        self._tried, self.shot = tried, tried.opened
        scene = self.shot.scene
        self.garments = tuple(garment.path for garment in scene.garments)
        self.times: tuple[float | None, ...] = scene.times or (None,)
        self.time = self.times[0]
        frames = sample_frames(self.shot.every_time, self.shot.frame)
        levels = tuple(choice.level for choice in choose_levels(scene, frames))
        # A level that is chosen from the fabric would be chosen anew from what is tried.
        chosen = zip(scene.garments, levels, strict=True)
        values = {g.path: {"refine:level": float(k)} for g, k in chosen if g.level == AUTO_LEVEL}
        self.history = History(Setting(levels, values=values))

    @property
    def setting(self) -> Setting:
        """The present setting."""
        return self.history.at()

    @property
    def codes(self) -> tuple[float, ...]:
        """The shot's time codes; () for a shot without samples."""
        return tuple(time for time in self.times if time is not None)

    def sampled(self, time: float | None) -> float | None:
        """The shot's own time code for one given; None for a shot without samples.

        Raises:
            UsageError: The shot has no sample there.
        """
        found = None if time is None else found_among(time, self.codes)
        if found not in self.times:
            message = f"no sample at time code {named_time(time)}; they run from"
            raise UsageError(f"{message} {named_time(self.times[0])} to {named_time(self.times[-1])}")
        return found

    def codes_in(self, span: tuple[float, float] | None) -> list[float]:
        """The time codes from the first to the last of a range; none without a range."""
        return [*within(self.codes, span)] if span else []

    def value(self, garment: str, name: str) -> float | None:
        """A tunable value of a garment in the frame, SI; None if not set."""
        return TUNABLES[name].read(self.shot.frame(self.time).garments[self._index(garment)])

    def tries(self, garment: str, name: str) -> bool:
        """Whether a value was tried, and may differ from the shot's."""
        return name in self.setting.values.get(garment, {})

    def painted(self, garment: str, name: str) -> np.ndarray:
        """A map of `MAPS` on the vertices of a garment's cage, shape (V,)."""
        return self._tried.painted(self.setting, self._index(garment), name)

    def set_value(self, garment: str, name: str, value: float) -> None:
        """Try a value [SI] on a garment in every frame, as a layer holds it.

        Raises:
            UsageError: The garment or the name is unknown, or the value is outside its limits.
        """
        check_known("value", name, TUNABLES)
        tried, given = self._values(garment), _rounded({name: value})
        if tried.get(name) != given[name]:  # Pages tell a number twice: when it is typed, and when it is left.
            self._try(garment, tried | given, TUNABLES[name].label, joins=True)

    def reset(self, garment: str, name: str) -> None:
        """Return a value to the shot's.

        Raises:
            UsageError: The garment is unknown.
        """
        values = {each: value for each, value in self._values(garment).items() if each != name}
        self._try(garment, values, f"{GARMENT[name].label} as authored")

    def set_as_authored(self, garment: str) -> None:
        """Return a garment's values and maps to the shot's; the level is kept.

        Raises:
            UsageError: The garment is unknown.
        """
        values = {name: value for name, value in self._values(garment).items() if name not in TUNABLES}
        painted = {path: maps for path, maps in self.setting.painted.items() if path != garment}
        kept = painted if garment in self.setting.painted else self.setting.painted
        self._try(garment, values, "all as authored", painted=kept)

    def set_preset(self, garment: str, preset: str) -> None:
        """Replace the tried fabric values by a preset's.

        Raises:
            UsageError: The garment or the fabric is unknown.
        """
        check_known("preset", preset, sorted(PRESETS))
        self.set_fabric(garment, fabric_values(PRESETS[preset]), preset)

    def set_fabric(self, garment: str, values: Mapping[str, float], name: str) -> None:
        """Replace the tried fabric values by others; ``name`` is the name of the step of undo.

        Raises:
            UsageError: The garment is unknown, or a value cannot be used.
        """
        kept = {each: value for each, value in self._values(garment).items() if GARMENT[each].group != FABRIC}
        self._try(garment, kept | _rounded(values), name)

    def paint(self, garment: str, name: str, values: np.ndarray) -> None:
        """Try a painted map of `MAPS` on a garment, a value for each vertex of its cage, shape (V,).

        Raises:
            UsageError: The garment or the map is unknown.
            SchemaError: A value is outside the map's limits.
        """
        check_known("map", name, MAPS)
        maps = {**self.setting.painted.get(garment, {}), name: np.array(values, np.float32)}
        painted = {**self.setting.painted, garment: maps}
        self._try(garment, self._values(garment), GARMENT[name].label, painted=painted)

    def set_level(self, garment: str, level: float) -> None:
        """Set the number of subdivisions.

        Raises:
            UsageError: The garment is unknown, or the level is outside its limits.
        """
        index = self._index(garment)
        if level < 0:
            raise UsageError(f"level {level:g}: give 0 or more")
        levels = tuple(int(level) if k == index else each for k, each in enumerate(self.setting.levels))
        values = {**self._values(garment), "refine:level": float(level)}
        self._try(garment, values, GARMENT["refine:level"].label, levels=levels)

    def set_contact(self, on: bool) -> None:
        """Let cloth feel bodies and cloth, or nothing."""
        self.put(replace(self.setting, contact=on), "contact on" if on else "contact off")

    def put(self, setting: Setting, change: str, *, joins: bool = False) -> None:
        """Make a setting the present one by a change, in words; an invalid setting changes nothing."""
        self.shot = self._tried.read(setting)
        self.history.put(setting, change, joins=joins)

    def undo(self) -> None:
        """Undo the last change."""
        self._go(-1)

    def redo(self) -> None:
        """Redo the last undone change."""
        self._go(1)

    def _go(self, way: int) -> None:
        self.shot = self._tried.read(self.history.at(way))
        self.history.go(way)

    def _index(self, garment: str) -> int:
        if garment not in self.garments:
            raise UsageError(f"no garment <{garment}>; garments: {', '.join(self.garments)}")
        return self.garments.index(garment)

    def _values(self, garment: str) -> dict[str, float]:
        self._index(garment)
        return dict(self.setting.values.get(garment, {}))

    def _try(
        self, garment: str, values: Mapping[str, float], change: str, *, joins: bool = False, **others: object
    ) -> None:
        """Go on to a garment's values, and ``others`` of the setting."""
        setting = replace(self.setting, values={**self.setting.values, garment: values}, **others)
        self.put(setting, change, joins=joins)


def _rounded(values: Mapping[str, float]) -> dict[str, float]:
    """Values rounded to single precision, as in a layer."""
    return {name: float(np.float32(value)) for name, value in values.items()}
