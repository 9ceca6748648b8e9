"""Effects of numbers beyond the noise of ripples, and the page of `benchmarks.numbers` about them."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.constants import ROUND_CONTACT, Number, counts
from benchmarks.rows import commit, table
from benchmarks.verdicts import BETTER, EQUAL, WORSE, Values, compare, noise_of_means, pooled_deviation

BASE_RIPPLES = 9
"""Ripples of the unchanged solver, more than of variants: every comparison uses their mean."""
SHOWN = {
    "energy": "energy",
    "crossings": "crossings",
    "jumps": "jumps",
    "still": "still motion",
}
"""Figures of the table; crossings are those of cloth with cloth and with bodies."""
COUNTS, TIMES = ("crossings", "jumps"), ("warm", "first")
INTRODUCTION = """\
Written by `python -m benchmarks.numbers`, whose head says how, at commit {commit}.

Mean change over the scenes at half and at double a number: energy and still motion (of cloth whose cage stands) in
percent; crossings and jumps in counts per run, summed over the scenes. In brackets the scenes where the change is more
than three standard errors of the ripples' noise, + for worse and - for better. Less is better everywhere. Times are
not judged: a number that sizes a buffer has no effect here."""


def key_of(scene: str, number: Number | None, kind: str) -> str:
    """Identity of a variant in a file of figures; `kind` is "half", "double", or "base" with a number."""
    if number is None:
        return f"{scene}: {kind}"
    return f"{scene}: {number.file} {number.label} {kind} {number.variants[kind]:g}"


@dataclass(frozen=True)
class Change:
    """What a variant does to a figure of a scene.

    Attributes:
        relative: Difference of the means over the mean of the solver as it is; of counts, the difference itself.
        verdict: Better, worse or equal within the noise.
    """

    relative: float
    verdict: str


def figures_of(run: Values) -> dict[str, float | None]:
    """The table's figures of a run."""
    return dict(run) | {"crossings": (run["cloth"] or 0) + (run["bodies"] or 0)}


def noise_of(runs: Sequence[Sequence[Values]], base: Sequence[Values]) -> dict[str, float]:
    """Standard deviation over ripples of each figure of a scene.

    Args:
        runs: Runs of each variant that has several.
        base: Runs of the solver as it is.
    """
    noise = {}
    for name in SHOWN:
        own = _known(base, name)
        least = max(1.0, abs(statistics.fmean(own))) if name in COUNTS and own else 0.0
        noise[name] = pooled_deviation([own, *(_known(each, name) for each in runs)], least)
    return noise


def _known(runs: Sequence[Values], name: str) -> list[float]:
    return [value for run in runs if (value := figures_of(run).get(name)) is not None]


def change_of(name: str, runs: Sequence[Values], base: Sequence[Values], noise: float) -> Change | None:
    """What a variant does to a figure; None if the scene has no such figure."""
    now, before = _known(runs, name), _known(base, name)
    if not now or not before:
        return None
    if now == before[: len(now)]:
        return Change(0.0, EQUAL)
    mean = statistics.fmean(before)
    difference = statistics.fmean(now) - mean
    relative = difference if name in COUNTS else difference / abs(mean) if mean else 0.0
    return Change(relative, compare(mean, statistics.fmean(now), noise_of_means(noise, len(now), len(before))))


class Effects:
    """Effects of variants in all scenes.

    Attributes:
        scenes: Names of the scenes.
    """

    def __init__(self, found: Mapping[str, Any], scenes: Sequence[str]) -> None:
        """Measure the noise of each scene in all its variants."""
        self.scenes, self._found = list(scenes), found
        self._base = {name: [found[f"{name}: base {k}"][0] for k in range(BASE_RIPPLES)] for name in scenes}
        self._noise = {
            name: noise_of([each for key, each in found.items() if _is_changed(key, name, each)], self._base[name])
            for name in scenes
        }

    def runs(self, number: Number, kind: str) -> dict[str, Any]:
        """Runs of a variant in each scene, or the reason why there are none."""
        return {name: self._found[key_of(name, number, kind)] for name in self.scenes}

    def changes(self, number: Number, kind: str) -> dict[str, dict[str, Change]]:
        """Changes of each figure in each scene; scenes without effect and failed runs are left out."""
        found = {}
        for scene, runs in self.runs(number, kind).items():
            if not isinstance(runs, str) and len(runs) > 1:
                base, noise = self._base[scene], self._noise[scene]
                each = {name: change_of(name, runs, base, noise[name]) for name in SHOWN}
                found[scene] = {name: change for name, change in each.items() if change is not None}
        return found

    def failures(self, number: Number, kind: str) -> dict[str, str]:
        """Reasons of failed runs by scene."""
        return {scene: runs for scene, runs in self.runs(number, kind).items() if isinstance(runs, str)}

    def touched(self, number: Number) -> list[str]:
        """Scenes where a variant of a number is better or worse, or fails."""
        found = set()
        for kind in number.variants:
            found |= set(self.failures(number, kind))
            for scene, changes in self.changes(number, kind).items():
                if any(change.verdict != EQUAL for change in changes.values()):
                    found.add(scene)
        return [scene for scene in self.scenes if scene in found]

    def kind_of(self, number: Number) -> str:
        """A number's class, from "no effect here" to "matters in several scenes"."""
        if not number.variants:
            return f"fixed: {number.fixed or 'zero'}"
        if touched := self.touched(number):
            return f"matters in {touched[0]} only" if len(touched) == 1 else "matters in several scenes"
        moved = any(self.moves(number, kind) for kind in number.variants)
        return "equal within the noise" if moved else "no effect here"

    def improves(self, number: Number, kind: str) -> bool:
        """Whether a variant is better in a figure of a scene, and worse in none."""
        changes = [change for each in self.changes(number, kind).values() for change in each.values()]
        verdicts = {change.verdict for change in changes}
        return BETTER in verdicts and WORSE not in verdicts and not self.failures(number, kind)

    def moves(self, number: Number, kind: str) -> bool:
        """Whether a variant changes any figure of any scene."""
        return any(change.relative for changes in self.changes(number, kind).values() for change in changes.values())


def _is_changed(key: str, scene: str, runs: Any) -> bool:
    """Whether a file's entry is a variant of a scene with several ripples."""
    return key.startswith(f"{scene}: ") and not isinstance(runs, str) and len(runs) > 1


def page(numbers: Sequence[Number], found: Mapping[str, Any], scenes: Sequence[str]) -> str:
    """The page in Markdown: a table of all variants, then numbers by class."""
    effects = Effects(found, scenes)
    rows = [row for number in numbers for row in rows_of(number, effects)]
    head = ["file", "number", "value", "at", *SHOWN.values(), "effect"]
    classes: dict[str, list[str]] = {}
    for number in numbers:
        classes.setdefault(effects.kind_of(number), []).append(f"`{number.file} {number.label}`")
    better = [(number, kind) for number in numbers for kind in number.variants if effects.improves(number, kind)]
    if better:
        names = [f"`{number.file} {number.label}` at {kind}" for number, kind in better]
        classes["better in something and worse in nothing"] = names
    lists = [f"**{kind}** ({len(each)}): {', '.join(each)}" for kind, each in sorted(classes.items())]
    title = "# What each number of the solver does"
    return "\n\n".join([title, INTRODUCTION.format(commit=commit()), table(head, rows), "## By class", *lists])


def rows_of(number: Number, effects: Effects) -> Iterator[list[str]]:
    """A row per variant of a number; one row for a number that cannot be changed."""
    name = [number.file, f"`{number.label}`", f"{number.value:g}"]
    if not number.variants:
        yield [*name, "-", *["-"] * len(SHOWN), number.fixed or "zero"]
    for kind, value in number.variants.items():
        changes, failures = effects.changes(number, kind), effects.failures(number, kind)
        cells = [_cell(key, {scene: each[key] for scene, each in changes.items() if key in each}) for key in SHOWN]
        failed = "; ".join(f"fails in {scene}: {reason[:60]}" for scene, reason in failures.items())
        some = any(change.verdict != EQUAL for each in changes.values() for change in each.values())
        within = "equal within the noise" if effects.moves(number, kind) else "no effect here"
        effect = "" if some or failures else within
        yield [*name, f"{kind}: {value:g}", *cells, failed or effect]


def _cell(figure: str, changes: Mapping[str, Change]) -> str:
    """Mean change of a figure over scenes, or the sum of counts, and the scenes where the change exceeds the noise."""
    if not changes:
        return ""
    values = [each.relative for each in changes.values()]
    text = f"{sum(values):+.3g}" if figure in COUNTS else f"{100.0 * statistics.fmean(values):+.1f}%"
    signs = {WORSE: "+", BETTER: "-"}
    named = [f"{signs[each.verdict]}{scene}" for scene, each in changes.items() if each.verdict != EQUAL]
    return f"{text} ({', '.join(named)})" if named else text


def counted(numbers: Sequence[Number]) -> str:
    """Numbers by room, those round contact, and of the whole solver."""
    rooms = counts(numbers)
    rows = [[room, count] for room, count in sorted(rooms.items(), key=lambda each: -each[1])]
    rows += [["round contact: " + " + ".join(ROUND_CONTACT), sum(rooms[each] for each in ROUND_CONTACT)]]
    rows += [["solver", len(numbers)]]
    return "## Numbers by room\n\n" + table(["room", "numbers"], rows)
