"""Describes a shot before the first frame: garments, values, sources, active terms. Completes the report at the end."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from shlex import join
from typing import Any

import numpy as np

from ..errors import GarmentError, StageError, counted, named_time
from ..solver.fabric import Fabric
from ..solver.mesh.defects import defects, in_brief
from ..solver.resolution import LevelChoice, choose_levels, sample_frames
from ..solver.scene import Frame, Garment, GarmentFrame
from ..solver.strain import StrainedPart, strained_parts
from ..usd.read.reader import Shot, open_shot
from ..usd.read.survey import survey
from ..usd.read.targets import DETAIL, FOLLOW, Target
from ..usd.stage import GarmentSource
from ..usd.times import within
from ..usd.view import Stage
from .estimate import cannot_fit, estimate
from .findings.table import Facts, preset_overrides, warnings_and_notes
from .findings.untagged import FAR, find_candidates
from .findings.up_axis import pull_of
from .options import INTEGRATORS, RefineOptions, scene_words, why_not_posed
from .report import RefineReport, levels_of, of_a_kind

MOST_ASKED = 32
"""Most open meshes tried as garments."""


def begin_report(report: RefineReport, opened: Shot, options: RefineOptions) -> list[str]:
    """Fill in a report before the first frame: choose the levels and check a few sample frames.

    Args:
        report: An empty report.

    Returns:
        Warnings for the user.
    """
    first, frames = _first_frame(opened), sample_frames(opened.every_time, opened.frame)
    choices = choose_levels(opened.scene, frames)
    written = "--velocities" if options.velocities else "none"
    report.garments = [
        _garment(reader.garment, reader.source, first.garments[index], choices[index])
        | {"colliders": _felt(opened, reader.garment)}
        | {"velocities": "written anew, as the shot has them" if reader.source.velocities else written}
        | {"bound": [_bound(target) for target in opened.targets if target.garment == index]}
        for index, reader in enumerate(opened.readers)
    ]
    size = estimate(
        opened.scene.garments,
        levels_of(report.garments),
        frames=_frame_count(opened, options),
        workers=options.workers,
        bound=sum(len(target.points) for target in opened.targets),
    )
    report.estimate = size.plain()
    facts = _facts(opened, report, options, sampled=frames, choices=choices)
    warnings, notes = warnings_and_notes(facts, before=True)
    report.note(*notes)
    report.modelled = _modelled(opened, report, options)
    report.left_out = _left_out(opened, report)
    report.variants = list(opened.selections)
    refined = {None, *opened.scene.times}  # Frames outside the run may be broken.
    return [str(notice) for notice in opened.warnings if notice.time in refined] + [*warnings]


def _facts(
    opened: Shot,
    report: RefineReport,
    options: RefineOptions,
    *,
    sampled: Sequence[Frame],
    choices: Sequence[LevelChoice],
) -> Facts:
    """Facts before the first frame; the report gets those about candidates and about each garment."""
    strained, candidates = _strained_parts(opened, sampled), find_candidates(opened)
    facts = Facts(
        report=report,
        options=options,
        shot=opened,
        sources=opened.sources,
        sampled=sampled,
        choices=choices,
        candidates=candidates,
        strained=strained,
    )
    for garment in report.garments:
        garment["strained"] = [dataclasses.asdict(part) for part in strained[garment["path"]]]
        if options.contact != "off":
            garment["unfelt"] = [body.path for body in facts.unfelt if garment["path"] in body.shares]
    report.candidates = {
        candidate.path: f"{'taken' if candidate.is_taken else 'left'}: {candidate.reason}"
        for candidate in candidates
        if not candidate.reason.startswith(FAR)
    }
    return facts


def say_what_was(report: RefineReport) -> None:
    """Report who made the steps, and list self contact as left out if no frame needed it."""
    entries = [entry for _, _, entry in report.entries()]
    _say_who_integrated(report, entries)
    if any(entry.get("contact", {}).get("cloth", {}).get("near") for entry in entries):
        return
    if report.modelled.pop("self contact", None):
        report.left_out["self contact"] = "no two parts of the cloth came near one another in any frame"


def _say_who_integrated(report: RefineReport, entries: Sequence[dict[str, Any]]) -> None:
    """Report the learned integrator's share of the steps as modelled, or the reason for its absence."""
    movers: Counter[str] = Counter()
    for entry in entries:
        for level in entry.get("levels", ()):
            movers.update(level["movers"])
    integrator, learned = str(report.options["integrator"]), INTEGRATORS[0]
    if movers[learned]:
        part = movers[learned] / movers.total()
        report.modelled["network"] = f"{learned} made {part:.0%} of the steps (--integrator {integrator})"
    else:
        report.left_out["network"] = f"--integrator {integrator}"


def too_large(opened: Shot, report: RefineReport, options: RefineOptions) -> GarmentError | None:
    """The error naming a run too large for this machine's memory, or None."""
    frames, levels = _frame_count(opened, options), levels_of(report.garments)
    return cannot_fit(opened.scene.garments, levels, frames=frames, workers=options.workers)


def _frame_count(opened: Shot, options: RefineOptions) -> int:
    """Number of frames of a run."""
    times = opened.scene.times if options.preroll is None else within(opened.scene.times, options.frames)
    return max(len(times), 1)


def describe(opened: Shot, options: RefineOptions) -> dict[str, Any]:
    """Plan of a refinement: garments, values and their sources, and every defect found, as plain values."""
    report = RefineReport(opened.path, None, options.plain())
    warnings = begin_report(report, opened, options)
    large = too_large(opened, report, options)
    unfelt = dict.fromkeys(path for garment in report.garments for path in garment.get("unfelt", ()))
    with_bodies = dataclasses.replace(options, colliders=[*opened.colliders, *unfelt]) if unfelt else options
    return {
        "shot": opened.path,
        **({"problem": str(large)} if large else {}),
        "metres_per_unit": opened.metres_per_unit,
        "times": list(opened.scene.times),
        "estimate": report.estimate,
        "garments": report.garments,
        "colliders": list(opened.colliders),
        "candidates": report.candidates,
        "modelled": report.modelled,
        "left_out": report.left_out,
        "variants": report.variants,
        "defects": {garment.path: in_brief(defects(garment.mesh, garment.rest)) for garment in opened.scene.garments},
        "warnings": [*of_a_kind(warnings)],
        "notes": report.notes,
        "command": _command(opened, opened.sources, with_bodies, warnings),
    }


def _command(opened: Shot, garments: Sequence[GarmentSource], options: RefineOptions, warnings: Iterable[str]) -> str:
    """The command to refine garments of a shot with some options, those of the warnings, and the presets named."""
    mended = {name: value for warning in warnings for name, value in getattr(warning, "options", {}).items()}
    complete = dataclasses.replace(options, overrides=[*options.overrides, *preset_overrides(garments)], **mended)
    out = str(Path(opened.path).with_suffix(".refined.usdc"))
    return join(["physgraph-usd", "refine", opened.path, "-o", out, *scene_words(complete)])


def _proposal(shot: str | Stage, meshes: Sequence[str], options: RefineOptions) -> str:
    """The command for a shot without tags.

    Of meshes that look like cloth, the largest first, those that lie on others are the garments; if none does, those
    that are animated.
    "" if no garment is found or the meshes cannot be read together.
    """
    try:
        reading = {name: getattr(options, name) for name in ("frames", "gravity", "rest_frame")}
        with closing(open_shot(shot, garments=meshes[:MOST_ASKED], **reading)) as opened:
            sampled = sample_frames(opened.every_time, opened.frame)
            candidates = find_candidates(opened)
            lying = {path for body in candidates for path in body.shares}
            moving = {str(source.path) for source in opened.sources if len(source.times) > 1}
            garments = [source for source in opened.sources if str(source.path) in (lying or moving)]
            if not garments:
                return ""
            strained, paths = _strained_parts(opened, sampled), [str(source.path) for source in garments]
            facts = Facts(
                shot=opened,
                sources=garments,
                sampled=sampled,
                candidates=candidates,
                strained={path: strained[path] for path in paths},
            )
            named = dataclasses.replace(options, garments=paths, colliders=[body.path for body in facts.unfelt])
            return _command(opened, garments, named, warnings_and_notes(facts, before=True)[0])
    except StageError:
        return ""


def describe_meshes(shot: str | Stage, problem: str, options: RefineOptions) -> dict[str, Any]:
    """Describe a stage not ready for refining: its meshes, the problem, and a command to try.

    Raises:
        StageError: The file cannot be opened at all.
    """
    overview, command = survey(shot), ""
    if not options.garments and not any(mesh.garment for mesh in overview.meshes):
        cloth = [mesh for mesh in overview.meshes if mesh.looks_like_cloth and not mesh.problem]
        cloth = [mesh for mesh in cloth if mesh.deforms] or cloth
        cloth.sort(key=lambda mesh: -mesh.faces)
        command = _proposal(shot, [mesh.path for mesh in cloth], options)
    return {
        "shot": overview.path,
        "metres_per_unit": overview.metres_per_unit,
        "problem": problem,
        **({"command": command} if command else {}),
        "meshes": [
            {
                "path": mesh.path,
                "garment": mesh.garment,
                "points": mesh.points,
                "faces": mesh.faces,
                "form": "open" if mesh.is_open else "closed",
                "samples": len(mesh.times),
                "problem": mesh.problem or "none",
                "notices": [str(notice) for notice in mesh.notices],
            }
            for mesh in overview.meshes
        ],
        "warnings": [str(notice) for notice in overview.notices],
    }


def _first_frame(opened: Shot) -> Frame:
    """The first readable frame.

    Raises:
        StageError: No frame can be read.
    """
    *earlier, last = opened.scene.times or (None,)
    for time in earlier:
        try:
            return opened.frame(time)
        except StageError:
            continue
    return opened.frame(last)


def _garment(garment: Garment, source: GarmentSource, frame: GarmentFrame, choice: LevelChoice) -> dict[str, Any]:
    size = np.ptp(garment.rest, axis=0) if len(garment.rest) else np.zeros(3)
    return {
        "path": garment.path,
        "points": garment.mesh.vertex_count,
        "faces": len(garment.mesh.counts),
        "size_m": [round(float(length), 4) for length in size],
        "samples": len(source.times),
        "samples_left_out": len(source.left_out),
        "level": choice.level,
        "level_reason": choice.reason,
        "fine_edge_mm": round(1e3 * choice.edge, 2),
        "wavelength_mm": round(1e3 * choice.wavelength, 2),
        "level_for_finest_wrinkles": choice.needed,
        "bending_raised": [round(factor, 2) for factor in choice.raised],
        "fine_points": choice.vertices[0],
        "fine_points_at_that_level": choice.vertices[1],
        "fabric": dataclasses.asdict(frame.fabric) | {"guide": frame.guide, "detail": frame.detail},
        "sources": dict(source.sources),
        "self_contact": garment.self_contact,
        "apart_from": dict(source.apart_from),
        "skinned": source.skinned,
        "pinned_points": int((garment.pin > 0).sum()),
    }


def _bound(target: Target) -> dict[str, Any]:
    """A target of a garment, as plain values."""
    return {
        "path": str(target.path),
        "points": len(target.points),
        "rigid_parts": target.parts,
        "distance_mm": round(1e3 * target.distance, 2),
        "pose": named_time(target.time),
        "mode": DETAIL if target.detail else FOLLOW,
    }


def _strained_parts(opened: Shot, frames: Sequence[Frame]) -> dict[str, list[StrainedPart]]:
    """By path of each garment, the parts not sized like the rest shape."""
    return {
        reader.garment.path: strained_parts(
            reader.garment,
            [frame.garments[index].points for frame in frames],
            reader.source.subsets,
            up=-opened.scene.gravity,
        )
        for index, reader in enumerate(opened.readers)
    }


def _modelled(opened: Shot, report: RefineReport, options: RefineOptions) -> dict[str, str]:
    angles = "rest shape" if any(garment.bent_rest for garment in opened.scene.garments) else "flat"
    folded = [garment.path for garment in opened.scene.garments if garment.pressed is not None]
    angles += "".join(f"; pressed folds of <{path}>" for path in folded)
    modelled = {
        **_in_plane(report),
        "bending": f"dihedral angles, {angles}",
        "gravity": f"{pull_of(opened.scene.gravity)}, by {opened.gravity_source}",
        "guide": "ties the local average to the coarse animation",
    }
    if _touching(opened) and options.contact != "off":
        bodies = ", ".join(_touching(opened))
        modelled["contact"] = f"{options.contact} form, with {bodies}, in frames where it is near"
    if options.self_contact != "off":
        condition = "where parts come near one another; garments that do are solved together"
        modelled["self contact"] = f"pairs of points, {condition}"
    if options.temporal == "tether" and len(opened.scene.times) > 1:
        modelled["tether"] = "ties each frame to the last one's detail"
    if options.pose_in and not why_not_posed(opened, options):
        modelled["pose in"] = f"{counted(options.pose_in, 'pose')} between the bind pose and the first frame"
    return modelled


def _in_plane(report: RefineReport) -> dict[str, str]:
    """Garments modelled by edge springs, garments modelled by triangles, and garments with ease."""
    fields = {field.name for field in dataclasses.fields(Fabric)}
    woven = {g["path"]: Fabric(**{k: v for k, v in g["fabric"].items() if k in fields}) for g in report.garments}
    springs = [path for path, fabric in woven.items() if not fabric.has_membrane]
    triangles = [path for path, fabric in woven.items() if fabric.has_membrane]
    modelled = {"stretch": "edge springs" + (f" for {', '.join(springs)}" if triangles else "")} if springs else {}
    modelled |= {"membrane": f"triangle membrane for {', '.join(triangles)}"} if triangles else {}
    eased = [
        f"{path} by {100.0 * fabric.warp_ease:g}% along the warp and {100.0 * fabric.weft_ease:g}% along the weft"
        for path, fabric in woven.items()
        if fabric.is_eased
    ]
    return modelled | ({"ease": f"cloth longer than the rest shape: {'; '.join(eased)}"} if eased else {})


def _touching(opened: Shot) -> list[str]:
    """Paths of the colliders felt by some garment, each with the chosen side, if any."""
    colliding = {path for garment in opened.scene.garments for path in _felt(opened, garment)}
    return [
        collider.path + ("" if collider.side == "auto" else f" (side: {collider.side})")
        for collider in opened.scene.colliders
        if collider.path in colliding
    ]


def _felt(opened: Shot, garment: Garment) -> list[str]:
    return [opened.scene.colliders[index].path for index in garment.colliders]


def _why_no_contact(opened: Shot) -> str:
    if _touching(opened):
        return "switched off by --contact"
    if set(opened.colliders) & {path for source in opened.sources for path in source.apart_from}:
        return "every collider is excluded by physgraph:contact:exclude"
    return "no collider is tagged or named"


def _left_out(opened: Shot, report: RefineReport) -> dict[str, str]:
    left_out = {
        "friction": "out of scope: shapes at rest under pressure alone; the guide and the tether hold cloth in place",
    }
    held_samples = [f"{source.path}: {source.left_out_words}" for source in opened.sources if source.left_out]
    if held_samples:
        left_out["samples"] = (
            f"outside the frame range, where the layer holds the cloth still: {'; '.join(held_samples)}"
        )
    if "self contact" not in report.modelled:
        left_out["self contact"] = "switched off by --self-contact"
    if "contact" not in report.modelled:
        left_out["contact"] = _why_no_contact(opened)
    if "membrane" not in report.modelled:
        left_out["triangle membrane"] = (
            "no garment has a shear stiffness, weft or limit of its own: edge springs have G = 0.375 Y"
        )
    return left_out
