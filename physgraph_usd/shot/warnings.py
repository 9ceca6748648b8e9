"""All kinds of warnings given by a run, with sentence and remedy, in one table; docs/trouble.md is made from the table.

Odd or repaired contents of a stage are reported by the stage's reader, as `usd.stage.Notice`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from shlex import join
from typing import Any

from ..errors import counted, named_time
from ..solver.strain import MOST_STRETCHED, StrainedPart
from ..usd.read.rest import FITTED
from ..usd.stage import at_time
from .options import options_of
from .report import MOST_NAMED, RefineReport, faults_of, is_first
from .settled import COLLAPSED, LIMITED, UNSOLVED, in_words
from .untagged import AUTO, NEAR, Candidate, percent

Entries = Mapping[float | None, Mapping[str, Any]]
"""A garment's telemetry by time code."""


class Warned(str):
    """The text of a warning of a kind.

    Attributes:
        kind: Title of the kind.
        options: Options of `RefineOptions` that mend the cause.
    """

    kind = ""
    options: Mapping[str, str] = {}


@dataclass(frozen=True)
class Kind:
    """A kind of warning.

    Attributes:
        title: Title in docs/trouble.md.
        advice: Advice in docs/trouble.md.
        sentence: The warning, with figures in braces.
        remedy: The remedy in brief, or "".
        options: The options of the remedy, with figures in braces.
    """

    title: str
    advice: str
    sentence: str
    remedy: str = ""
    options: Mapping[str, str] = field(default_factory=dict)

    def __call__(self, path: str = "", times: Sequence[float | None] = (), **figures: Any) -> str:
        """The warning.

        Args:
            path: The garment, or "".
            times: The time code of the figures, then other affected time codes.
            figures: Values for the sentence and the remedy.
        """
        first, *later = times or (None,)
        location = (f"<{path}>" if path else "") + at_time(first)
        parts = [self.sentence.format(**figures), self.remedy.format(**figures), _also(later)]
        warning = Warned((f"{location}: " if location else "") + "; ".join(filter(None, parts)))
        warning.kind = self.title
        warning.options = {name: value.format(**figures) for name, value in self.options.items()}
        return warning


WARNINGS = {
    "failed": Kind(
        "no sample is written at time code",
        "that frame failed, for the reason that follows; mend the input and run again",
        "no sample is written at time code {name}: {error}",
    ),
    LIMITED: Kind(
        "the frame reached its limit of time",
        "the frame took over 20 times the processor time of the others, or more than `--frame-limit`, and was stopped. "
        "The cloth is valid but has not converged, and depends on the processor's speed. On a graphics card wall time "
        "counts, and other programs change it too. The next frame continues from there. Look at the cage and the "
        "bodies; `--frame-limit SECONDS` sets the limit",
        "the frame was not solved to its end: it reached its limit of time",
        "--frame-limit sets it, in processor time, on cuda in wall time",
    ),
    UNSOLVED: Kind(
        "it follows its cage there, not solved",
        "the text before it says why; mend the animation there, or leave the frame out with `--frames`",
        "{how}; it follows its cage there, not solved",
        "cache that frame again, or leave it out with --frames",
    ),
    "contact": Kind(
        "crossings or vertices inside a body are left",
        "`--heat-map` writes where, so that you can mend the cage there; `physgraph:collider:side` corrects a side "
        "that was guessed wrong. Some frames come out clean if they are refined alone (`--frames`)",
        "{left} {are} left{together}",
        "--heat-map shows where, to mend the cage there",
    ),
    "more": Kind(
        "more crossings and vertices inside bodies are left than there are in the subdivided cage",
        "the last line of a run. The cloth is worse there than plain subdivision: look at it before you use it. "
        "`--heat-map` writes where; mend the cage there, or refine those frames alone (`--frames`)",
        "{left:,} crossings and vertices inside bodies are left{together}, {before:,} in the subdivided cage: "
        "more than by subdivision alone",
        "look at these frames",
    ),
    "unposed": Kind(
        "`--pose-in` has no effect",
        "it bends cloth from the bind pose of a skeleton to the first frame; leave it out for cloth that no skeleton "
        "moves, and with `--temporal off`",
        "--pose-in has no effect: {reason}",
        "leave it out",
    ),
    "drawn": Kind(
        "the surface that renderers draw enters a body",
        "renderers subdivide the refined cloth, and over a body's sharp edges the surface is rounder than the body. "
        "`--scheme none` writes polygons, which stay outside. This is measured only with `--report`",
        "the surface that renderers draw from it is up to {depth:.1f} mm inside a body",
        "--scheme none writes polygons, which stay outside",
        {"scheme": "none"},
    ),
    "open_loop": Kind(
        "cage and bodies close a loop, but the cloth does not",
        "if the shot is played as a loop, the cloth jumps there. `--temporal off` solves each frame by itself and "
        "closes the loop, with less continuity between frames. A shot that plays once needs no change",
        "cage and bodies close a loop, but the cloth ends {gap:.1f} mm from where it begins",
        "if it is played as a loop, --temporal off closes it",
        {"temporal": "off"},
    ),
    "broken_before": Kind(
        "leaves its place for this frame alone",
        "mend the cage or the body in that frame; the next frame starts from the frame before it",
        "the garment or a body leaves its place for this frame alone",
        "mend it. Time code {next} starts from the frame before it",
    ),
    "jumped_from": Kind(
        "jumps from this first frame to the next",
        "if the first frame is broken, leave it out with `--frames`",
        "the garment or a body jumps from this first frame to the next",
        "if it is broken, leave it out with --frames. Time code {next} starts anew",
    ),
    "strained": Kind(
        "in most frames the cage has not its rest shape's size",
        "refined cloth takes the size of its rest shape. `--rest auto` fits one to the shot, or author "
        "`primvars:rest` in the cloth's own size",
        "in most frames the cage has not its rest shape's size, which refined cloth takes: {parts}",
        "give --rest auto, or author primvars:rest in the cloth's own size",
        {"rest_frame": "auto"},
    ),
    "unfelt": Kind(
        "cloth is inside or near a body that it does not feel",
        "use `--collider auto`, or the command that the warning names",
        "cloth is inside or within {near:.0f} mm of {bodies} that it does not feel, for {why}: {named}",
        "give --collider {auto}, or by name {options}",
    ),
    "unread": Kind(
        "a shape that is not read may touch cloth",
        "convert it to a mesh, or put a mesh in its place; curves and points that lie on the cloth can follow "
        "it by `--bind`",
        "{named} may touch cloth and {are} not read",
        "convert {them} to a Mesh, or put one in {their} place",
    ),
    "gravity": Kind(
        "gravity pulls across it",
        "correct the stage's `upAxis`, or give `--gravity` the axis. If the body lies down and gravity is "
        "right, no action is needed",
        "it and <{body}> inside it stand along {axis}, but gravity is {pull} by {source}",
        "give --gravity -{axis}, or mend the stage's upAxis",
        {"gravity": "-{axis}"},
    ),
    "solved_anew": Kind(
        "finished frames are solved anew",
        "`--resume` instead of `--overwrite` uses them",
        "{dropped} of a run that was interrupted {are} solved anew",
        "--resume would have used {them}",
    ),
    "resumed": Kind(
        "frames are those of a run that was interrupted",
        "no action needed; folds may differ slightly from an uninterrupted run",
        "{kept} are those of a run that was interrupted; the others are solved{again}",
        "folds that can lie in several ways may lie otherwise there than in an undisturbed run",
    ),
    "partial": Kind(
        "the layer has a part of the frames",
        "`stitch --partial` leaves out the frames that are not finished. `refine --resume` solves them",
        "the layer has {count} of {frames}; not finished: {missing}",
        "refine --resume solves them",
    ),
    "undrawn": Kind(
        "the first frame is not drawn",
        "the text after it says why; the frames are refined without the picture",
        "the first frame is not drawn into {picture}: {error}",
    ),
    "slower": Kind(
        "cholespy is not installed",
        "install it, if it has a wheel for your system; solves then take less time",
        "cholespy is not installed: matrices are factorised by scipy, which is slower",
    ),
}


def advice_table() -> str:
    """All kinds with advice, as a table in Markdown."""
    rows = [f"| {kind.title} | {kind.advice} |" for kind in WARNINGS.values()]
    return "\n".join(["| it says | do |", "|---|---|", *rows]) + "\n"


def of_strain(parts_of: Mapping[str, Sequence[StrainedPart]], sources: Mapping[str, str]) -> list[str]:
    """A warning of parts larger than their rest shape in most frames, or far smaller, unless the shape is fitted.

    Parts of `MOST_STRETCHED` of a garment or less are passed over.

    Args:
        parts_of: Strained parts of each garment, largest first, by path.
        sources: Source of each garment's rest shape, by path.
    """
    named = []
    for path, parts in parts_of.items():
        large = [part for part in parts if part.needs_rest and not sources[path].startswith(FITTED)]
        for part in large[: sum(part.share for part in large) > MOST_STRETCHED]:
            size = f"{part.area_ratio:.0%} of its area on {counted(part.faces, 'face')} {part.where}"
            named.append(f"<{path}> ({sources[path]}) {size}")
    return [WARNINGS["strained"](parts=", ".join(named))] if named else []


def of_gravity(garment: str, body: str, axis: str, *, pull: str, source: str) -> str:
    """A warning of gravity pulling across the common axis of a garment and the body inside the garment."""
    return WARNINGS["gravity"](garment, body=body, axis=axis, pull=pull, source=source)


def of_unfelt(touching: Sequence[Candidate]) -> list[str]:
    """A warning of bodies touched by cloth but not used as colliders, with the options to type."""
    if not touching:
        return []
    named = [
        f"<{body.path}> ({percent(body.shares[body.garment])} of <{body.garment}>)" for body in touching[:MOST_NAMED]
    ]
    named += [f"{len(touching) - MOST_NAMED} more"] if len(touching) > MOST_NAMED else []
    options = join(options_of("--collider", [body.path for body in touching[:MOST_NAMED]]))
    single = len(touching) == 1
    bodies, reason = ("a body", "it is no collider") if single else ("bodies", "they are no colliders")
    warning = WARNINGS["unfelt"](
        bodies=bodies, why=reason, named=", ".join(named), options=options, near=1e3 * NEAR, auto=AUTO
    )
    return [warning]


def of_unread(candidates: Sequence[Candidate]) -> list[str]:
    """A warning of shapes near cloth that are not read."""
    named = [f"<{candidate.path}> ({candidate.unread})" for candidate in candidates if candidate.unread]
    if not named:
        return []
    unnamed = [f"{len(named) - MOST_NAMED} more"] if len(named) > MOST_NAMED else []
    are, them, their = ("is", "it", "its") if len(named) == 1 else ("are", "them", "their")
    return [WARNINGS["unread"](named=", ".join([*named[:MOST_NAMED], *unnamed]), are=are, them=them, their=their)]


def of_frames(report: RefineReport) -> list[str]:
    """Warnings from the frames' telemetry, kind by kind."""
    by_garment = [
        (garment, {frame["time"]: frame["garments"][index] for frame in report.frames if "garments" in frame})
        for index, garment in enumerate(report.garments)
    ]
    checks = (_of_jumps, of_contact)
    warnings = [warning for check in checks for garment, entries in by_garment for warning in check(garment, entries)]
    return [*warnings, *_of_unsolved(report.unsettled)]


def _of_jumps(garment: Mapping[str, Any], entries: Entries) -> Iterator[str]:
    """A warning for each frame in which a garment's input leaves its place, and for a jump from the first frame."""
    for name in ("broken_before", "jumped_from"):
        for time, entry in entries.items():
            if entry.get(name) is not None and time is not None:
                yield WARNINGS[name](garment["path"], [entry[name]], next=named_time(time))


def of_contact(garment: Mapping[str, Any], entries: Entries) -> Iterator[str]:
    """A warning if a garment's result crosses cloth or bodies, or is inside a body, with the worst frame."""
    remaining = {
        time: [measure for measure in _measured(entry.get("contact", {})) if measure[1]]
        for time, entry in entries.items()
        if is_first(garment["path"], entry)
    }
    remaining = {time: counts for time, counts in remaining.items() if counts}
    if remaining:
        times = sorted(remaining, key=lambda time: -sum(after for _, after, _ in remaining[time]))  # The worst first.
        counts = remaining[times[0]]
        named = [f"{text} ({before:,} in the subdivided cage)" for text, _, before in counts]
        are = "is" if len(counts) == 1 and counts[0][1] == 1 else "are"
        counted_with = _together(garment["path"], entries[times[0]])
        yield WARNINGS["contact"](garment["path"], times, left=", ".join(named), are=are, together=counted_with)


def of_more(report: RefineReport) -> list[str]:
    """A warning for each garment with more faults in a frame than its subdivided cage, with the first such frame.

    Faults are crossings and vertices inside bodies together, as the solver compares patches of cloth: cloth that comes
    out of a body may cross it more often than cloth that lies in it.
    """
    figures_of: dict[str, list[tuple[float | None, int, int, str]]] = {}
    for frame, garment, entry in report.entries():
        after, before = (faults_of(entry.get("contact") or {}, side) for side in ("after", "before"))
        if after > before and is_first(garment["path"], entry):
            figures = frame["time"], after, before, _together(garment["path"], entry)
            figures_of.setdefault(garment["path"], []).append(figures)
    warnings = []
    for path in [garment["path"] for garment in report.garments if garment["path"] in figures_of]:
        frames = figures_of[path]
        _, after, before, counted_with = frames[0]
        times = [time for time, *_ in frames]
        warnings.append(WARNINGS["more"](path, times, left=after, before=before, together=counted_with))
    return warnings


def _together(path: str, entry: Mapping[str, Any]) -> str:
    """Text naming the other garments that figures of a garment count too; "" for a garment solved by itself."""
    paths = [f"<{garment}>" for garment in entry.get("together") or () if garment != path]
    return f", counted together with {', '.join(paths)}" if paths else ""


def of_drawn(depths_at: Mapping[float | None, Mapping[str, float]]) -> list[str]:
    """A warning for each garment whose drawn surface enters a body, given depths [m] by time code and path."""
    warnings = []
    for path in dict.fromkeys(path for depths in depths_at.values() for path in depths):
        depths = {time: depth_of[path] for time, depth_of in depths_at.items() if path in depth_of}
        times = sorted(depths, key=lambda time: -depths[time])  # The worst first.
        warnings.append(WARNINGS["drawn"](path, times, depth=1e3 * depths[times[0]]))
    return warnings


def of_loops(gaps: Mapping[str, float]) -> list[str]:
    """A warning for each garment whose loop does not close, given the distance between its ends [m] by path."""
    return [WARNINGS["open_loop"](path, gap=1e3 * gap) for path, gap in gaps.items()]


def _measured(contact: Mapping[str, Any]) -> Iterator[tuple[str, int, int]]:
    """Measures of contact in words, with the count in the result and in the cage."""
    measures = [("crossing", "crossings", "of cloth", contact.get("cloth") or {}, "crossings")]
    for body, measured in contact.get("bodies", {}).items():
        measures.append(("crossing", "crossings", f"with <{body}>", measured, "crossings"))
        measures.append(("vertex", "vertices", f"inside <{body}>", measured, "inside"))
    for noun, plural, location, measured, name in measures:
        after, before = (int(measured.get(side, {}).get(name, 0)) for side in ("after", "before"))
        yield f"{counted(after, noun, plural)} {location}", after, before


def _of_unsolved(unsettled: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Warnings of frames stopped by the time limit, and of unsolved frames, by garment."""
    kinds = {LIMITED: LIMITED, COLLAPSED: UNSOLVED, UNSOLVED: UNSOLVED}
    stopped = [(str(entry["path"]), kinds[entry["stopped"]], entry) for entry in unsettled if entry["stopped"] in kinds]
    for path, kind in dict.fromkeys((path, kind) for path, kind, _ in stopped):
        entries = [entry for *of, entry in stopped if of == [path, kind]]
        reason = in_words(entries[0])
        prefix = f"<{path}>{at_time(entries[0]['time'])}: "
        yield WARNINGS[kind](path, [entry["time"] for entry in entries], how=reason.removeprefix(prefix))


def _also(times: Sequence[float | None]) -> str:
    """Text listing the other time codes of a warning; "" without any."""
    if len(times) > MOST_NAMED:
        return f"also in {counted(len(times), 'other frame')}"
    names = [*map(named_time, times)]
    listed = " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
    return f"also at time code{'s' if len(names) > 1 else ''} {listed}" if names else ""
