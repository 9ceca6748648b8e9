"""Whether one version's figures differ from another's by more than their noise.

A shot is refined several times by each version, every time with another ripple (`benchmarks.judge_shot`). What figures
of one version differ by between ripples is noise. One version is better or worse than another where the means differ by
more than the noise of their difference and by more than 1% (`compare`); else they are equal within the noise. For all
figures less is better.

The noise of a difference is the sum of both spreads, half the ranges over the ripples. Of three values each from one
normal distribution, one comparison in eleven passes that test by chance: a single verdict says little, and many of one
sign, or one that a second run repeats, say much. Where many variants of one version share a scene, their variances are
pooled, and the noise is `ERRORS` standard errors (`noise_of_means`): one comparison in 370 passes by chance.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from benchmarks.rows import table

LEAST = 0.01
"""Least relative difference that counts."""
ERRORS = 3.0
"""Standard errors that are noise, where variances are pooled."""
BETTER, WORSE, EQUAL, UNKNOWN = "better", "worse", "equal", "-"


@dataclass(frozen=True)
class Figure:
    """A figure of a run.

    Attributes:
        head: Name and unit.
        scale: Factor from the stored value to the unit of the name.
        is_time: Whether the figure is a time, whose ratios have a geometric mean over the shots.
    """

    head: str
    scale: float = 1.0
    is_time: bool = False


FIGURES = {
    "warm": Figure("warm frame [ms]", is_time=True),
    "first": Figure("first frame [ms]", is_time=True),
    "energy": Figure("energy [mJ]"),
    "cloth": Figure("crossings, cloth with cloth"),
    "bodies": Figure("crossings, cloth with bodies"),
    "inside": Figure("vertices in bodies"),
    "jumps": Figure("jumps"),
    "remaining": Figure("remaining move [1/1000 edge]", 1e3),
    "rest_angle": Figure("angle to own rest, median [degrees]"),
    "rest_angle90": Figure("angle to own rest, 90th percentile [degrees]"),
    "still": Figure("motion over a still cage [mm]"),
    "sharp": Figure("sharp folds where the smooth cage has none [1/10,000 edges]", 1e4),
}
"""Figures of `judge_shot.judged` by name; angles of normals to own rest are those of a run's last frames."""

Values = Mapping[str, float | None]
"""Figures of one run by name."""


@dataclass(frozen=True)
class Band:
    """Mean of a figure over the ripples, and half its range."""

    mean: float
    spread: float

    @classmethod
    def of(cls, values: Sequence[float | None]) -> Band | None:
        """The band of some values, or None if a value is missing."""
        known = [value for value in values if value is not None]
        if not known or len(known) < len(values):
            return None
        return cls(statistics.fmean(known), 0.5 * (max(known) - min(known)))

    def text(self, scale: float = 1.0) -> str:
        """Mean and spread in the given unit, the spread with two digits and the mean as exact as the spread."""
        mean, spread = scale * self.mean, scale * self.spread
        if not spread:
            return f"{mean:,.0f}" if float(mean).is_integer() else f"{mean:.4g}"
        digits = max(0, 1 - math.floor(math.log10(spread)))
        return f"{mean:,.{digits}f} ± {spread:,.{digits}f}"


def bands(runs: Sequence[Values]) -> dict[str, Band | None]:
    """Bands of all figures, from runs of one version with several ripples."""
    return {name: Band.of([run.get(name) for run in runs]) for name in FIGURES}


def verdict(before: Band | None, after: Band | None) -> str:
    """Whether a figure is better, worse or equal within the noise; "-" if a version has no such figure."""
    if before is None or after is None:
        return UNKNOWN
    return compare(before.mean, after.mean, before.spread + after.spread)


def compare(before: float, after: float, noise: float) -> str:
    """Whether a mean is better, worse or equal within the noise of their difference."""
    if abs(after - before) <= max(noise, LEAST * abs(before)):
        return EQUAL
    return BETTER if after < before else WORSE


def pooled_deviation(groups: Sequence[Sequence[float]], least: float = 0.0) -> float:
    """Standard deviation of a figure over ripples, pooled over variants without the tenth that varies most.

    Args:
        groups: Values of each variant.
        least: Least variance.
    """
    variances = sorted(statistics.variance(each) for each in groups if len(each) > 1)
    kept = variances[: max(1, len(variances) - len(variances) // 10)]
    return math.sqrt(max(least, statistics.fmean(kept) if kept else 0.0))


def noise_of_means(deviation: float, *counts: int) -> float:
    """Noise of the difference of two means of so many values each."""
    return ERRORS * deviation * math.sqrt(sum(1.0 / count for count in counts))


def ratio(before: Band | None, after: Band | None) -> float | None:
    """Quotient of two means; None if a mean is missing or not positive."""
    if before is None or after is None or before.mean <= 0 or after.mean <= 0:
        return None
    return after.mean / before.mean


def shot_table(versions: Mapping[str, Mapping[str, Band | None]]) -> str:
    """A shot's table, one row per figure: mean ± spread of each version, then the last version against each other."""
    *others, last = versions
    head = ["figure", *versions]
    for name in others:
        head += [f"{last} / {name}", "verdict"]
    rows = []
    for key, figure in FIGURES.items():
        each = {name: found.get(key) for name, found in versions.items()}
        row = [figure.head, *("-" if band is None else band.text(figure.scale) for band in each.values())]
        for name in others:
            quotient = ratio(each[name], each[last])
            row += ["-" if quotient is None else f"{quotient:.3f}", verdict(each[name], each[last])]
        rows.append(row)
    return table(head, rows)


def overall(pairs: Mapping[str, tuple[Mapping[str, Band | None], Mapping[str, Band | None]]]) -> str:
    """The table over all shots, one row per figure, from the bands before and after of each shot."""
    rows = []
    for key, figure in FIGURES.items():
        found = {shot: verdict(before.get(key), after.get(key)) for shot, (before, after) in pairs.items()}
        counts = Counter(found.values())
        named = [", ".join(shot for shot, each in found.items() if each == kind) or "-" for kind in (BETTER, WORSE)]
        quotients = [ratio(before.get(key), after.get(key)) for before, after in pairs.values()]
        known = [each for each in quotients if each is not None]
        mean = f"{statistics.geometric_mean(known):.3f}" if figure.is_time and known else "-"
        rows.append([figure.head, mean, counts[BETTER], counts[WORSE], counts[EQUAL], *named])
    head = ["figure", "geometric mean of ratios", "better", "worse", "equal", "shots that are better", "worse"]
    return table(head, rows)
