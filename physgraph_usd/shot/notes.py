"""Notes for the report and `inspect`, beside warnings: nothing is wrong, but the cloth could look different."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from shlex import join
from typing import Any

from ..errors import counted, named_time
from ..solver.fabric import NAMED, PRESETS, WORN, Fabric
from ..solver.resolution import SHARP_FRACTION, LevelChoice
from ..solver.scene import GIVEN_UP
from ..usd.lookup import PRESET
from ..usd.schema import GARMENT
from ..usd.stage import GarmentSource, at_time
from .options import options_of
from .report import RefineReport, is_first
from .settled import COLLAPSED, LIMITED, UNSOLVED, in_words

EASE = 4
"""Weft ease proposed by the note on slack [percent]: of the values in docs/fabrics.md, the one to fold every cage."""
ENERGY_ROUNDING = 1e-3
"""Relative energy increase below which an energy counts as unchanged: sums are in single precision."""
MATERIALS = "stretchStiffness", "bendStiffness", "density"
"""Fabric values set by every preset."""


def of_slack(garments: Sequence[str], choices: Sequence[LevelChoice]) -> list[str]:
    """A note of the garments whose cages have no slack.

    Args:
        garments: Prim paths.
        choices: The level chosen for each garment.
    """
    tight = [f"<{path}>" for path, choice in zip(garments, choices, strict=True) if choice.is_tight]
    if not tight:
        return []
    cages = "this cage has" if len(tight) == 1 else "these cages have"
    words = f"{cages} no slack: expect what subdivision gives; for folds give --set weftEase={EASE}"
    return [f"{', '.join(tight)}: {words}"]


def of_trims(garment_of: Mapping[str, str]) -> list[str]:
    """A note of meshes that could follow garments.

    Args:
        garment_of: For each mesh that lies on a garment and moves with it, the garment.
    """
    if not garment_of:
        return []
    cloth = ", ".join(f"<{path}>" for path in dict.fromkeys(garment_of.values()))
    stay, them = ("stays as it is", "it") if len(garment_of) == 1 else ("stay as they are", "them")
    listed, options = ", ".join(f"<{path}>" for path in garment_of), join(options_of("--bind", garment_of))
    return [f"{listed} {stay} beside the refined {cloth}; {options} carries {them} along"]


def of_fabrics(sources: Iterable[GarmentSource]) -> list[str]:
    """A note for each preset whose fabric is named in garments without authored fabric values.

    Args:
        sources: Where the garments come from.
    """
    named: dict[str, list[tuple[GarmentSource, str]]] = {}
    for source, word, preset in _named(sources):
        named.setdefault(preset, []).append((source, word))
    notes = []
    for preset, matches in named.items():
        listed = ", ".join(f"<{source.path}> ({word})" for source, word in matches)
        options = join(options_of("--set", preset_overrides(source for source, _ in matches)))
        notes.append(f"named like {preset}: {listed}; {options} refines {'it' if len(matches) == 1 else 'them'} so")
    return notes


def of_subsets(sources: Iterable[GarmentSource]) -> list[str]:
    """A note for each subset of faces with a fabric of its own."""
    return [
        f"<{source.path.AppendChild(name) if name else source.path}>: {words}"
        for source in sources
        for name, words in source.fabrics.items()
    ]


def preset_overrides(sources: Iterable[GarmentSource]) -> list[str]:
    """Values of ``--set`` that choose presets for garments by words in the garments' names."""
    return [f"{source.path}.{PRESET}={preset}" for source, _, preset in _named(sources)]


def _named(sources: Iterable[GarmentSource]) -> Iterator[tuple[GarmentSource, str, str]]:
    """The garments without authored fabric values and named like a preset, with the word and the preset."""
    for source in sources:
        named = ((word, table[word]) for table in (NAMED, WORN) for word in source.words if word in table)
        word, preset = next(named, ("", ""))
        if preset and PRESETS[preset] != Fabric() and all(source.sources[name] == "fallback" for name in MATERIALS):
            yield source, word, preset


def of_rest(unsettled: Sequence[Mapping[str, Any]], frames: int) -> list[str]:
    """A note of the frames not at rest when the solver stopped, with the worst frame.

    Args:
        unsettled: A report's unsettled frames.
        frames: Number of frames.
    """
    moving = [entry for entry in unsettled if entry["stopped"] not in (LIMITED, COLLAPSED, UNSOLVED)]
    if not moving:
        return []
    worst = max(moving, key=lambda entry: entry["remaining_move"])
    count, location = len({entry["time"] for entry in moving}), f"<{worst['path']}>{at_time(worst['time'])}"
    return [f"{count} of {counted(frames, 'frame')} did not settle, {location} the least: {in_words(worst)}"]


def of_energy(report: RefineReport) -> list[str]:
    """A note of the frames whose energy exceeds the upsampled cage's, with the frame of the largest excess.

    A descent never raises the energy, but a frame starts from the previous frame's detail, and push-out and untangling
    cost energy.
    """
    above = []
    for frame, garment, entry in report.entries():
        sides = (entry.get("energy_joules") or {}) if is_first(garment["path"], entry) else {}
        before, after = (sum(sides.get(side, {}).values()) for side in ("input", "output"))
        if after > (1.0 + ENERGY_ROUNDING) * before:
            above.append((after - before, garment["path"], frame["time"], before, after))
    if not above:
        return []
    _, path, time, before, after = max(above, key=lambda entry: entry[0])
    count, energies = len({entry[2] for entry in above}), f"{after:.3g} J, the cage's {before:.3g} J"
    text = f"{counted(count, 'frame')} ended with more energy than the upsampled cage"
    return [f"{text}, <{path}>{at_time(time)}: {energies}"]


def of_folds(report: RefineReport) -> list[str]:
    """A note of the garment with most sharp folds, if sharp folds show the mesh."""
    folded = [(entry.get("sharp_folds", 0.0), frame["time"], garment) for frame, garment, entry in report.entries()]
    share, time, worst = max(folded, key=lambda entry: entry[0], default=(0.0, None, {}))
    if share <= SHARP_FRACTION:
        return []
    further = len({id(garment) for fraction, _, garment in folded if fraction > SHARP_FRACTION}) - 1
    level, location = worst["level"], f"<{worst['path']}>{at_time(time)}"
    text = f"level: {share:.0%} of the edges of {location} fold by more than 45 degrees, so the mesh shows"
    text += f", and in {counted(further, 'other garment')}" if further else ""
    finer = f"--level {level + 1} halves the edges of {worst['fine_edge_mm']:.1f} mm, for up to 4 times the time"
    return [text + (f"; {finer}" if level < (GARMENT["refine:level"].maximum or 0) else "")]


def of_following(report: RefineReport) -> list[str]:
    """A note of the frames in which cloth follows its subdivided cage, with the frame of the largest part."""
    pushed = [
        (entry["follows_cage"], garment["path"], frame["time"])
        for frame, garment, entry in report.entries()
        if entry.get("follows_cage") and is_first(garment["path"], entry)
    ]
    if not pushed:
        return []
    part, path, time = max(pushed, key=lambda entry: entry[0]["vertices"])
    when, vertices = (
        counted(len({entry[2] for entry in pushed}), "frame"),
        counted(part["vertices"], "vertex", "vertices"),
    )
    text = f"in {when} part of the cloth follows its subdivided cage, where the solution crosses more often: "
    text += f"{vertices} of <{path}>{at_time(time)}, with {part['left']:,} crossings"
    return [f"{text} for {part['solved']:,} as solved"]


def of_given_up(report: RefineReport) -> list[str]:
    """A note of the frames in which no cloth is solved, since it is given up."""
    times = [
        (garment["path"], frame["time"]) for frame, garment, entry in report.entries() if entry.get("start") == GIVEN_UP
    ]
    if not times:
        return []
    path, time = times[0]
    text = f"in {counted(len({time for _, time in times}), 'frame')} cloth is its subdivided cage, without folds: the"
    return [f"{text} cage crosses itself too often to be solved (<{path}>, first{at_time(time)})"]


def of_poses(report: RefineReport) -> list[str]:
    """A note of a first frame for which poses from the bind pose on were solved without a request."""
    first = report.frames[0] if report.frames else {}
    if not first.get("poses"):
        return []
    poses = f"{counted(first['poses'], 'pose')} from the bind pose on"
    return [
        f"time code {named_time(first['time'])} is solved after {poses}, since cloth crossed itself without the poses"
    ]


def of_inertia(report: RefineReport) -> list[str]:
    """A note of the frames in which cloth feels the acceleration of its cage, with the largest."""
    entries = [
        (entry["inertia"], garment["path"], frame["time"])
        for frame, garment, entry in report.entries()
        if entry.get("inertia")
    ]
    if not entries:
        return []
    most, path, time = max(entries, key=lambda felt: felt[0])
    when = counted(len({felt[2] for felt in entries}), "frame")
    text = f"inertia: in {when} cloth feels the acceleration of its animation, up to {most:.2g} times gravity beyond it"
    return [f"{text} (<{path}>{at_time(time)}); --set inertia=0 leaves it out"]
