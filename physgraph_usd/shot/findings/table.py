"""All findings of a run in one table: warnings and notes, each with its test; docs/trouble.md is made from the table.

A finding is one entry of `FINDINGS` and the function that tests it. To add one, write both here. The tests run before
the first frame or after the last one, by `warnings_and_notes`. An entry without a test is reported where it happens, by
``report.warn(FINDINGS[id](...))``.

Odd or repaired contents of a stage are reported by the stage's reader, as `usd.stage.Notice`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from shlex import join
from typing import TYPE_CHECKING, Any

from ...errors import counted, named_time
from ...solver.fabric import NAMED, PRESETS, WORN, Fabric
from ...solver.resolution import SHARP_FRACTION, LevelChoice
from ...solver.scene import GIVEN_UP, Frame
from ...solver.strain import MOST_STRETCHED, StrainedPart
from ...usd.lookup import PRESET
from ...usd.read.find import GRAVITY_OPTION
from ...usd.read.reader import Shot
from ...usd.read.rest import FITTED
from ...usd.schema import GARMENT
from ...usd.stage import GarmentSource, at_time
from ..options import RefineOptions, options_of, why_not_posed
from ..report import MOST_NAMED, RefineReport, faults_of, is_first
from .unsettled import COLLAPSED, LIMITED, UNSOLVED, in_words
from .untagged import AUTO, NEAR, Candidate, percent
from .up_axis import across_gravity, pull_of

if TYPE_CHECKING:
    from .drawn import Shown

WARNING, NOTE, STRICT = "warning", "note", "note, and a warning with --strict"
"""Levels: something is wrong; nothing is wrong, but the cloth could look different; and a note that --strict raises."""
EASE = 4
"""Weft ease proposed by the note on slack [percent]: of the values in docs/fabrics.md, the one to fold every cage."""
ENERGY_ROUNDING = 1e-3
"""Relative energy increase below which an energy counts as unchanged: sums are in single precision."""
MATERIALS = "stretchStiffness", "bendStiffness", "density"
"""Fabric values set by every preset."""

Figures = Mapping[str, Any]
"""Arguments of a `Finding`: its path and times, if any, and the values of its sentence and remedy."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Facts:
    """Facts about a run that findings are tested on; a test passes over those that are not known yet.

    Attributes:
        report: The report so far.
        shot: The shot, open, or None.
        sources: Where the tested garments come from.
        sampled: A few readable frames of the shot.
        choices: The level chosen for each of the report's garments.
        candidates: Bodies that are neither garments nor colliders.
        strained: Parts of each garment not sized like their rest shape, largest first, by path.
        depths: Depths [m] inside bodies of the surface that renderers draw, by time code and path.
        shown: Bodies whose polygons stand above the cloth.
        gaps: Distance [m] between the ends of each garment whose loop does not close, by path.
    """

    report: RefineReport = field(default_factory=lambda: RefineReport("", None, {}))
    options: RefineOptions = field(default_factory=RefineOptions)
    shot: Shot | None = None
    sources: Sequence[GarmentSource] = ()
    sampled: Sequence[Frame] = ()
    choices: Sequence[LevelChoice] = ()
    candidates: Sequence[Candidate] = ()
    strained: Mapping[str, Sequence[StrainedPart]] = field(default_factory=dict)
    depths: Mapping[float | None, Mapping[str, float]] = field(default_factory=dict)
    shown: Sequence[Shown] = ()
    gaps: Mapping[str, float] = field(default_factory=dict)

    @property
    def unfelt(self) -> list[Candidate]:
        """Bodies touched by garments but not used as colliders."""
        return [candidate for candidate in self.candidates if candidate.is_taken]


Test = Callable[[Facts], Iterable[Figures]]
"""Yields the figures of each occurrence of a finding."""


class Text(str):
    """The text of a finding.

    Attributes:
        kind: Sentence of the finding, with figures in braces.
        options: Options of `RefineOptions` that mend the cause.
    """

    kind = ""
    options: Mapping[str, str] = {}


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A kind of warning or note.

    Attributes:
        level: `WARNING`, `NOTE` or `STRICT`.
        before: Test before the first frame.
        after: Test after the last frame. A finding with neither test is reported where it happens.
        advice: Advice in docs/trouble.md.
        sentence: The text, with figures in braces.
        remedy: The remedy in brief, with figures in braces, or "".
        options: The options of the remedy, with figures in braces.
        title: The sentence in docs/trouble.md; "" for the sentence itself, without figures.
    """

    level: str = WARNING
    before: Test | None = None
    after: Test | None = None
    advice: str
    sentence: str
    remedy: str = ""
    options: Mapping[str, str] = field(default_factory=dict)
    title: str = ""

    def __call__(self, path: str = "", times: Sequence[float | None] = (), **figures: Any) -> Text:
        """The text of one occurrence.

        Args:
            path: The garment, or "".
            times: The time code of the figures, then other affected time codes.
            figures: Values for the sentence and the remedy.
        """
        first, *later = times or (None,)
        location = (f"<{path}>" if path else "") + at_time(first)
        parts = [self.sentence.format(**figures), self.remedy.format(**figures), _also(later)]
        text = Text((f"{location}: " if location else "") + "; ".join(filter(None, parts)))
        text.kind = self.sentence
        text.options = {name: value.format(**figures) for name, value in self.options.items()}
        return text


def warnings_and_notes(facts: Facts, *, before: bool = False) -> tuple[list[Text], list[Text]]:
    """Warnings and notes of all findings tested before the first frame or after the last, in the table's order."""
    warnings, notes = list[Text](), list[Text]()
    for name, finding in FINDINGS.items():
        is_warning = finding.level == WARNING or (finding.level == STRICT and facts.options.strict)
        if finding.before if before else finding.after:
            (warnings if is_warning else notes).extend(texts(name, facts))
    return warnings, notes


def texts(name: str, facts: Facts) -> list[Text]:
    """The texts of all occurrences of one finding."""
    finding = FINDINGS[name]
    test = finding.before or finding.after
    return [finding(**figures) for figures in (test(facts) if test else ())]


def advice_tables() -> str:
    """All warnings and all notes with advice, as two tables in Markdown."""
    tables = []
    for levels, heading in (((WARNING,), ""), ((NOTE, STRICT), "Notes say that nothing is wrong:\n\n")):
        rows = [f"| {_constant(entry)} | {entry.advice} |" for entry in FINDINGS.values() if entry.level in levels]
        tables.append(heading + "\n".join(["| it says | do |", "|---|---|", *rows]) + "\n")
    return "\n".join(tables)


def _constant(finding: Finding) -> str:
    """The sentence of a finding without its figures."""
    dotted = re.sub(r"<?\{[^}]*\}>?", "...", finding.sentence)
    return finding.title or re.sub(r"\.\.\.(:? ?\.\.\.)+", "...", dotted)


def preset_overrides(sources: Iterable[GarmentSource]) -> list[str]:
    """Values of ``--set`` that choose presets for garments by words in the garments' names."""
    return [f"{source.path}.{PRESET}={preset}" for source, _, preset in _named_like(sources)]


def _also(times: Sequence[float | None]) -> str:
    """Text listing the other time codes of a finding; "" without any."""
    if len(times) > MOST_NAMED:
        return f"also in {counted(len(times), 'other frame')}"
    names = [*map(named_time, times)]
    listed = " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
    return f"also at time code{'s' if len(names) > 1 else ''} {listed}" if names else ""


def _listed(names: Sequence[str]) -> str:
    """Some names, the rest as a number."""
    return ", ".join([*names[:MOST_NAMED], *([f"{len(names) - MOST_NAMED} more"] if len(names) > MOST_NAMED else [])])


def _strained(facts: Facts) -> Iterator[Figures]:
    """Garments larger than their rest shape in most frames, or far smaller, on more than `MOST_STRETCHED`.

    Rest shapes fitted to the shot are passed over.
    """
    named = []
    rests = {str(source.path): source.sources["rest"] for source in facts.sources}
    for path, parts in facts.strained.items():
        large = [part for part in parts if part.needs_rest and not rests[path].startswith(FITTED)]
        if sum(part.share for part in large) > MOST_STRETCHED:
            size = f"{large[0].area_ratio:.0%} of its area on {counted(large[0].faces, 'face')} {large[0].where}"
            named.append(f"<{path}> ({rests[path]}) {size}")
    if named:
        yield {"parts": ", ".join(named)}


def _unfelt(facts: Facts) -> Iterator[Figures]:
    bodies = facts.unfelt if facts.options.contact != "off" else []
    if bodies:
        names = [f"<{body.path}> ({percent(body.shares[body.garment])} of <{body.garment}>)" for body in bodies]
        options = join(options_of("--collider", [body.path for body in bodies[:MOST_NAMED]]))
        nouns = ("a body", "it is no collider") if len(bodies) == 1 else ("bodies", "they are no colliders")
        figures = {"named": _listed(names), "options": options, "near": 1e3 * NEAR, "auto": AUTO}
        yield {"bodies": nouns[0], "why": nouns[1], **figures}


def _unread(facts: Facts) -> Iterator[Figures]:
    names = [f"<{body.path}> ({body.unread})" for body in facts.candidates if body.unread]
    if names and facts.options.contact != "off":
        are, them, their = ("is", "it", "its") if len(names) == 1 else ("are", "them", "their")
        yield {"named": _listed(names), "are": are, "them": them, "their": their}


def _across_gravity(facts: Facts) -> Iterator[Figures]:
    """A garment and a body inside it that stand across gravity, unless somebody chose the axis of gravity."""
    if facts.shot is None:
        return
    source, scene = facts.shot.gravity_source, facts.shot.scene
    chosen = source == GRAVITY_OPTION or source.endswith(GARMENT["gravity"].name)
    axes = None if chosen else across_gravity(scene, facts.sampled, facts.unfelt)
    if axes is not None:
        path, body, axis = axes
        yield {"path": path, "body": body, "axis": axis, "pull": pull_of(scene.gravity), "source": source}


def _unposed(facts: Facts) -> Iterator[Figures]:
    if facts.options.pose_in and facts.shot and (reason := why_not_posed(facts.shot, facts.options)):
        yield {"reason": reason}


def _tight(facts: Facts) -> Iterator[Figures]:
    pairs = zip(facts.report.garments, facts.choices, strict=False)
    paths = [f"<{garment['path']}>" for garment, choice in pairs if choice.is_tight]
    if paths:
        cages = "this cage has" if len(paths) == 1 else "these cages have"
        yield {"garments": ", ".join(paths), "cages": cages, "ease": EASE}


def _named_like(sources: Iterable[GarmentSource]) -> Iterator[tuple[GarmentSource, str, str]]:
    """The garments without authored fabric values and named like a preset, with the word and the preset."""
    for source in sources:
        named = ((word, table[word]) for table in (NAMED, WORN) for word in source.words if word in table)
        word, preset = next(named, ("", ""))
        if preset and PRESETS[preset] != Fabric() and all(source.sources[name] == "fallback" for name in MATERIALS):
            yield source, word, preset


def _like_presets(facts: Facts) -> Iterator[Figures]:
    """Each preset whose fabric is named in garments."""
    named: dict[str, list[tuple[GarmentSource, str]]] = {}
    for source, word, preset in _named_like(facts.sources):
        named.setdefault(preset, []).append((source, word))
    for preset, matches in named.items():
        garments = ", ".join(f"<{source.path}> ({word})" for source, word in matches)
        options = join(options_of("--set", preset_overrides(source for source, _ in matches)))
        them = "it" if len(matches) == 1 else "them"
        yield {"preset": preset, "garments": garments, "options": options, "them": them}


def _fabrics_of_faces(facts: Facts) -> Iterator[Figures]:
    """Each subset of faces with a fabric of its own."""
    for source in facts.sources:
        for name, fabric in source.fabrics.items():
            yield {"path": source.path.AppendChild(name) if name else source.path, "fabric": fabric}


def _trims(facts: Facts) -> Iterator[Figures]:
    """Trims: meshes lying on a garment and moving along."""
    garment_of = {candidate.path: candidate.follows for candidate in facts.candidates if candidate.follows}
    if garment_of:
        stay, them = ("stays as it is", "it") if len(garment_of) == 1 else ("stay as they are", "them")
        trims, cloth = (
            ", ".join(f"<{path}>" for path in dict.fromkeys(paths)) for paths in (garment_of, garment_of.values())
        )
        yield {
            "trims": trims,
            "stay": stay,
            "cloth": cloth,
            "options": join(options_of("--bind", garment_of)),
            "them": them,
        }


def _jumps(name: str) -> Callable[[Facts], Iterator[Figures]]:
    """Each frame from or at which a garment's input leaves its place, by an entry of the telemetry."""

    def test(facts: Facts) -> Iterator[Figures]:
        for garment, entries in _by_garment(facts.report):
            for time, entry in entries.items():
                if entry.get(name) is not None and time is not None:
                    yield {"path": garment["path"], "times": [entry[name]], "next": named_time(time)}

    return test


def _by_garment(report: RefineReport) -> Iterator[tuple[dict[str, Any], dict[float | None, dict[str, Any]]]]:
    """Each garment with its telemetry by time code."""
    for index, garment in enumerate(report.garments):
        yield garment, {frame["time"]: frame["garments"][index] for frame in report.frames if "garments" in frame}


def _left(facts: Facts) -> Iterator[Figures]:
    """Garments that cross cloth or bodies, or are inside a body, with the worst frame."""
    for garment, entries in _by_garment(facts.report):
        path = garment["path"]
        left = {
            time: [measure for measure in _measured(entry.get("contact", {})) if measure[1]]
            for time, entry in entries.items()
            if is_first(path, entry)
        }
        times = sorted(filter(left.get, left), key=lambda time: -sum(after for _, after, _ in left[time]))
        if times:
            counts = left[times[0]]
            named = ", ".join(f"{text} ({before:,} in the subdivided cage)" for text, _, before in counts)
            are = "is" if len(counts) == 1 and counts[0][1] == 1 else "are"
            together = _together(path, entries[times[0]])
            yield {"path": path, "times": times, "left": named, "are": are, "together": together}


def _measured(contact: Mapping[str, Any]) -> Iterator[tuple[str, int, int]]:
    """Measures of contact in words, with the count in the result and in the cage."""
    measures = [("crossing", "crossings", "of cloth", contact.get("cloth") or {}, "crossings")]
    for body, measured in contact.get("bodies", {}).items():
        measures.append(("crossing", "crossings", f"with <{body}>", measured, "crossings"))
        measures.append(("vertex", "vertices", f"inside <{body}>", measured, "inside"))
    for noun, plural, location, measured, name in measures:
        after, before = (int(measured.get(side, {}).get(name, 0)) for side in ("after", "before"))
        yield f"{counted(after, noun, plural)} {location}", after, before


def _together(path: str, entry: Mapping[str, Any]) -> str:
    """Text naming the other garments that figures of a garment count too; "" for a garment solved by itself."""
    paths = [f"<{garment}>" for garment in entry.get("together") or () if garment != path]
    return f", counted together with {', '.join(paths)}" if paths else ""


def _unsolved(*reasons: str) -> Callable[[Facts], Iterator[Figures]]:
    """Garments not solved in some frames, for one of some reasons, with the first frame."""

    def test(facts: Facts) -> Iterator[Figures]:
        entries_of: dict[str, list[dict[str, Any]]] = {}
        for entry in facts.report.unsettled:
            if entry["stopped"] in reasons:
                entries_of.setdefault(str(entry["path"]), []).append(entry)
        for path, entries in entries_of.items():
            times = [entry["time"] for entry in entries]
            yield {
                "path": path,
                "times": times,
                "how": in_words(entries[0]).removeprefix(f"<{path}>{at_time(times[0])}: "),
            }

    return test


def _drawn_inside(facts: Facts) -> Iterator[Figures]:
    """Garments whose drawn surface enters a body, with the worst frame."""
    for path in dict.fromkeys(path for depths in facts.depths.values() for path in depths):
        depths = {time: depth_of[path] for time, depth_of in facts.depths.items() if path in depth_of}
        times = sorted(depths, key=lambda time: -depths[time])
        yield {"path": path, "times": times, "depth": 1e3 * depths[times[0]]}


def _open_loops(facts: Facts) -> Iterator[Figures]:
    return ({"path": path, "gap": 1e3 * gap} for path, gap in facts.gaps.items())


def _largest(
    report: RefineReport, figures_of: Callable[[dict[str, Any]], tuple[Any, ...] | None], *, grouped: bool = False
) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
    """The figures of all garments in all frames whose first is the largest, None without any.

    Args:
        report: The report.
        figures_of: Figures of a garment's telemetry in a frame, or None.
        grouped: Whether garments solved together share the figures.

    Returns:
        The figures, and the place and the number of frames with figures in words.
    """
    places = [
        (figures, f"<{garment['path']}>{at_time(frame['time'])}", frame["time"])
        for frame, garment, entry in report.entries()
        if (figures := figures_of(entry)) and (not grouped or is_first(garment["path"], entry))
    ]
    if not places:
        return None
    figures, place, _ = max(places, key=lambda entry: entry[0][0])
    return figures, {"place": place, "frames": counted(len({time for *_, time in places}), "frame")}


def _following(facts: Facts) -> Iterator[Figures]:
    def figures_of(entry: dict[str, Any]) -> tuple[int, int, int] | None:
        part = entry.get("follows_cage")
        return (part["vertices"], part["left"], part["solved"]) if part else None

    if largest := _largest(facts.report, figures_of, grouped=True):
        (vertices, left, solved), words = largest
        yield words | {"vertices": counted(vertices, "vertex", "vertices"), "left": left, "solved": solved}


def _given_up(facts: Facts) -> Iterator[Figures]:
    times = [(cloth["path"], f["time"]) for f, cloth, entry in facts.report.entries() if entry.get("start") == GIVEN_UP]
    if times:
        frames = counted(len({time for _, time in times}), "frame")
        yield {"frames": frames, "first": f"<{times[0][0]}>, first{at_time(times[0][1])}"}


def _inertia(facts: Facts) -> Iterator[Figures]:
    if largest := _largest(facts.report, lambda entry: (entry["inertia"],) if entry.get("inertia") else None):
        yield largest[1] | {"acceleration": largest[0][0]}


def _energy(facts: Facts) -> Iterator[Figures]:
    """Frames with more energy than the upsampled cage.

    A descent never raises the energy, but a frame starts from the previous frame's detail, and push-out and untangling
    cost energy.
    """

    def figures_of(entry: dict[str, Any]) -> tuple[float, float, float] | None:
        energies = entry.get("energy_joules") or {}
        before, after = (sum(energies.get(side, {}).values()) for side in ("input", "output"))
        return (after - before, before, after) if after > (1.0 + ENERGY_ROUNDING) * before else None

    if largest := _largest(facts.report, figures_of, grouped=True):
        (_, before, after), words = largest
        yield words | {"before": before, "after": after}


def _poses(facts: Facts) -> Iterator[Figures]:
    """A first frame for which poses from the bind pose on were solved without a request."""
    first = facts.report.frames[0] if facts.report.frames else {}
    if first.get("poses") and facts.options.pose_in is None:
        yield {"time": named_time(first["time"]), "poses": counted(first["poses"], "pose")}


def _folds(facts: Facts) -> Iterator[Figures]:
    """The garment with most sharp folds, if they show the mesh."""
    entries = facts.report.entries()
    folded = [(entry.get("sharp_folds", 0.0), frame["time"], garment) for frame, garment, entry in entries]
    share, time, worst = max(folded, key=lambda entry: entry[0], default=(0.0, None, {}))
    if share > SHARP_FRACTION:
        further = len({id(garment) for fraction, _, garment in folded if fraction > SHARP_FRACTION}) - 1
        level, edges = worst["level"], f"halves the edges of {worst['fine_edge_mm']:.1f} mm"
        finer = f"--level {level + 1} {edges}, for up to 4 times the time"
        yield {
            "share": share,
            "place": f"<{worst['path']}>{at_time(time)}",
            "further": f", and in {counted(further, 'other garment')}" if further else "",
            "finer": finer if level < (GARMENT["refine:level"].maximum or 0) else "",
        }


_NO_OFFSET = "a contact offset that hides it would hide the cloth's folds too; draw the body subdivided"
"""Remedy where the cloth would have to stand far off."""


def _shown(facts: Facts) -> Iterator[Figures]:
    """Bodies shown through garments by viewports without subdivision, with sufficient offsets."""
    if facts.shown:
        worst = max(facts.shown, key=lambda surface: surface.height)
        offsets: dict[str, float] = {}
        for surface in facts.shown:
            offsets[surface.garment] = max(offsets.get(surface.garment, 0.0), surface.offset)
        further, name = len(offsets) - 1, GARMENT["contact:offset"].short
        values = [f"{path}.{name}={offset:.4g}" for path, offset in offsets.items() if offset < math.inf]
        hides = f"{join(options_of('--set', values))} hides it" if len(values) == len(offsets) else _NO_OFFSET
        yield {
            "body": worst.body,
            "garments": f"<{worst.garment}>" + (f" and {counted(further, 'other garment')}" if further else ""),
            "height": 1e3 * worst.height,
            "when": at_time(worst.time),
            "hides": hides,
        }


def _moving(facts: Facts) -> Iterator[Figures]:
    """Frames not at rest when the solver stopped, with the worst frame."""
    moving = [entry for entry in facts.report.unsettled if entry["stopped"] not in (LIMITED, COLLAPSED, UNSOLVED)]
    if moving:
        worst = max(moving, key=lambda entry: entry["remaining_move"])
        yield {
            "count": len({entry["time"] for entry in moving}),
            "frames": counted(len(facts.report.frames), "frame"),
            "place": f"<{worst['path']}>{at_time(worst['time'])}",
            "how": in_words(worst),
        }


def _more(facts: Facts) -> Iterator[Figures]:
    """Garments with more faults in a frame than their subdivided cage, with the first such frame.

    Faults are crossings and vertices inside bodies together, as the solver compares patches of cloth: cloth that comes
    out of a body may cross it more often than cloth that lies in it.
    """
    for garment, entries in _by_garment(facts.report):
        worse = []
        for time, entry in entries.items():
            after, before = (faults_of(entry.get("contact") or {}, side) for side in ("after", "before"))
            if after > before and is_first(garment["path"], entry):
                worse.append((time, after, before, _together(garment["path"], entry)))
        if worse:
            _, after, before, together = worse[0]
            times = [time for time, *_ in worse]
            yield {"path": garment["path"], "times": times, "left": after, "before": before, "together": together}


FINDINGS = {
    "strained": Finding(
        before=_strained,
        advice="refined cloth takes the size of its rest shape. `--rest auto` fits one to the shot, or author "
        "`primvars:rest` in the cloth's own size",
        sentence="in most frames the cage has not its rest shape's size, which refined cloth takes: {parts}",
        remedy="give --rest auto, or author primvars:rest in the cloth's own size",
        options={"rest_frame": "auto"},
    ),
    "unfelt": Finding(
        before=_unfelt,
        advice="use `--collider auto`, or the command that the warning names",
        sentence="cloth is inside or within {near:.0f} mm of {bodies} that it does not feel, for {why}: {named}",
        remedy="give --collider {auto}, or by name {options}",
    ),
    "unread": Finding(
        before=_unread,
        advice="convert it to a mesh, or put a mesh in its place; curves and points that lie on the cloth can "
        "follow it by `--bind`",
        sentence="{named} may touch cloth and {are} not read",
        remedy="convert {them} to a Mesh, or put one in {their} place",
    ),
    "gravity": Finding(
        before=_across_gravity,
        advice="correct the stage's `upAxis`, or give `--gravity` the axis. If the body lies down and gravity is "
        "right, no action is needed",
        sentence="it and <{body}> inside it stand along {axis}, but gravity is {pull} by {source}",
        remedy="give --gravity -{axis}, or mend the stage's upAxis",
        options={"gravity": "-{axis}"},
    ),
    "unposed": Finding(
        before=_unposed,
        advice="it bends cloth from the bind pose of a skeleton to the first frame; leave it out for cloth that no "
        "skeleton moves, and with `--temporal off`",
        sentence="--pose-in has no effect: {reason}",
        remedy="leave it out",
    ),
    "slower": Finding(
        advice="install it, if it has a wheel for your system; solves then take less time",
        sentence="cholespy is not installed: matrices are factorised by scipy, which is slower",
    ),
    "taken_as_done": Finding(
        advice="no action needed; `--overwrite` instead of `--resume` refines the shot again",
        sentence="{out} is taken as done: the same files, options and version made it",
    ),
    "solved_anew": Finding(
        advice="`--resume` instead of `--overwrite` uses them",
        sentence="{dropped} of a run that was interrupted {are} solved anew",
        remedy="--resume would have used {them}",
    ),
    "resumed": Finding(
        advice="no action needed; folds may differ slightly from an uninterrupted run",
        sentence="{kept} are those of a run that was interrupted; the others are solved{again}",
        remedy="folds that can lie in several ways may lie otherwise there than in an undisturbed run",
    ),
    "partial": Finding(
        advice="`stitch --partial` leaves out the frames that are not finished. `refine --resume` solves them",
        sentence="the layer has {count} of {frames}; not finished: {missing}",
        remedy="refine --resume solves them",
    ),
    "undrawn": Finding(
        advice="the text after it says why; the frames are refined without the picture",
        sentence="the first frame is not drawn into {picture}: {error}",
    ),
    "failed": Finding(
        advice="that frame failed, for the reason that follows; mend the input and run again",
        sentence="no sample is written at time code {name}: {error}",
    ),
    "seam_jump": Finding(
        advice="the text after it says why the two solutions cannot be blended; refine the frames again with a "
        "longer pre-roll or with fewer `--workers`",
        sentence="the cloth jumps after time code {last}, where the work of two processes meets: {why}",
    ),
    "broken_before": Finding(
        after=_jumps("broken_before"),
        advice="mend the cage or the body in that frame; the next frame starts from the frame before it",
        sentence="the garment or a body leaves its place for this frame alone",
        remedy="mend it. Time code {next} starts from the frame before it",
    ),
    "jumped_from": Finding(
        after=_jumps("jumped_from"),
        advice="if the first frame is broken, leave it out with `--frames`",
        sentence="the garment or a body jumps from this first frame to the next",
        remedy="if it is broken, leave it out with --frames. Time code {next} starts anew",
    ),
    "contact": Finding(
        after=_left,
        title="crossings or vertices inside a body are left",
        advice="`--heat-map` writes where, so that you can mend the cage there; `physgraph:collider:side` corrects "
        "a side that was guessed wrong. Some frames come out clean if they are refined alone (`--frames`)",
        sentence="{left} {are} left{together}",
        remedy="--heat-map shows where, to mend the cage there",
    ),
    "limited": Finding(
        after=_unsolved(LIMITED),
        advice="the frame took over 20 times the processor time of the others, or more than `--frame-limit`, and "
        "was stopped. The cloth is valid but has not converged, and depends on the processor's speed. On a "
        "graphics card wall time counts, and other programs change it too. The next frame continues from there. "
        "Look at the cage and the bodies; `--frame-limit SECONDS` sets the limit",
        sentence="the frame was not solved to its end: it reached its limit of time",
        remedy="--frame-limit sets it, in processor time, on cuda in wall time",
    ),
    "unsolved": Finding(
        after=_unsolved(COLLAPSED, UNSOLVED),
        advice="the text before it says why; mend the animation there, or leave the frame out with `--frames`",
        sentence="{how}; it follows its cage there, not solved",
        remedy="cache that frame again, or leave it out with --frames",
    ),
    "drawn": Finding(
        after=_drawn_inside,
        advice="renderers subdivide the refined cloth, and over a body's sharp edges the surface is rounder than "
        "the body. `--scheme none` writes polygons, which stay outside. This is measured only with `--report`",
        sentence="the surface that renderers draw from it is up to {depth:.1f} mm inside a body",
        remedy="--scheme none writes polygons, which stay outside",
        options={"scheme": "none"},
    ),
    "open_loop": Finding(
        after=_open_loops,
        advice="if the shot is played as a loop, the cloth jumps there. `--temporal off` solves each frame by "
        "itself and closes the loop, with less continuity between frames. A shot that plays once needs no change",
        sentence="cage and bodies close a loop, but the cloth ends {gap:.1f} mm from where it begins",
        remedy="if it is played as a loop, --temporal off closes it",
        options={"temporal": "off"},
    ),
    "slack": Finding(
        level=NOTE,
        before=_tight,
        advice="the cage is as long as the cloth, so refined cloth has no folds of its own. "
        "[Ease](fabrics.md#ease-folds-that-the-cage-does-not-show) makes the cloth longer than the cage",
        sentence="{garments}: {cages} no slack: expect what subdivision gives",
        remedy="for folds give --set weftEase={ease}",
        title="this cage has no slack",
    ),
    "preset": Finding(
        level=NOTE,
        before=_like_presets,
        advice="no fabric is authored; the options of the note choose the preset",
        sentence="named like {preset}: {garments}",
        remedy="{options} refines {them} so",
    ),
    "subset": Finding(
        level=NOTE,
        before=_fabrics_of_faces,
        title="faces of another fabric",
        advice="these faces have the values of their own material",
        sentence="{fabric}",
    ),
    "trims": Finding(
        level=NOTE,
        before=_trims,
        advice="a mesh, curves or points that lie on the garment keep their own animation; `--bind` makes them "
        "follow the refined cloth",
        sentence="{trims} {stay} beside the refined {cloth}",
        remedy="{options} carries {them} along",
        title="stays as it is beside the refined cloth",
    ),
    "follows_cage": Finding(
        level=NOTE,
        after=_following,
        advice="the solution had more crossings there than the subdivided cage; `--heat-map` writes where",
        sentence="in {frames} part of the cloth follows its subdivided cage, where the solution crosses more often: "
        "{vertices} of {place}, with {left:,} crossings for {solved:,} as solved",
    ),
    "given_up": Finding(
        level=NOTE,
        after=_given_up,
        advice="the cage crosses itself too often to be solved; mend the animation there",
        sentence="in {frames} cloth is its subdivided cage, without folds: the cage crosses itself too often to be "
        "solved ({first})",
    ),
    "inertia": Finding(
        level=NOTE,
        after=_inertia,
        advice="fast animation pulls the cloth back; the option of the note leaves the pull out",
        sentence="inertia: in {frames} cloth feels the acceleration of its animation, up to {acceleration:.2g} times "
        "gravity beyond it ({place})",
        remedy="--set inertia=0 leaves it out",
    ),
    "poses": Finding(
        level=NOTE,
        after=_poses,
        advice="the first frame crossed itself; `--pose-in 0` leaves the poses out",
        sentence="time code {time} is solved after {poses} from the bind pose on, since cloth crossed itself "
        "without the poses",
    ),
    "folds": Finding(
        level=NOTE,
        after=_folds,
        advice="give the `--level` that the note names, or accept that folds are polygons",
        sentence="level: {share:.0%} of the edges of {place} fold by more than 45 degrees, so the mesh shows{further}",
        remedy="{finer}",
    ),
    "energy": Finding(
        level=NOTE,
        after=_energy,
        advice="cloth was pushed out of bodies or untangled there, or did not converge; look at these frames",
        sentence="{frames} ended with more energy than the upsampled cage, {place}: {after:.3g} J, the cage's "
        "{before:.3g} J",
    ),
    "shown": Finding(
        level=NOTE,
        after=_shown,
        advice="renderers that subdivide the body do not; the note has the contact offset that hides the body "
        "everywhere, if there is one that leaves the cloth its folds",
        sentence="viewports that draw <{body}> unsubdivided show it through {garments} by up to {height:.1f} mm{when}",
        remedy="{hides}",
    ),
    "unsettled": Finding(
        level=STRICT,
        after=_moving,
        advice="the frame kept its last state before it was at rest; more `--steps` bring it nearer. With `--strict` "
        "this is a warning",
        sentence="{count} of {frames} did not settle, {place} the least: {how}",
    ),
    "more": Finding(
        after=_more,
        advice="the last line of a run. The cloth is worse there than plain subdivision: look at it before you use "
        "it. `--heat-map` writes where; mend the cage there, or refine those frames alone (`--frames`)",
        sentence="{left:,} crossings and vertices inside bodies are left{together}, {before:,} in the subdivided "
        "cage: more than by subdivision alone",
        remedy="look at these frames",
    ),
}
"""Findings by id, in reporting order."""
