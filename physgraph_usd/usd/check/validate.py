"""Checks a refined layer with our rules, alone and over its shot, and with USD's own validators."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import LayerError, counted
from ..provenance import read_record, recorded_shot
from ..read.targets import FOLLOWERS
from ..resolve import is_there
from ..stage import USD_ERRORS, bad_rate, open_layer, paths_in, pxr_errors, quiet
from ..view import StageView
from .rules import (
    BOUND_INSTANCER_RULES,
    BOUND_MESH_RULES,
    BOUND_RULES,
    LAYER_RULES,
    RULES,
    Fine,
    Problem,
    against_shot,
    other_meshes,
    prim_fault,
    same_metadata,
    same_variants,
    subsets,
    times_with_values,
)
from .validators import PLUGIN

__all__ = ["Problem", "check_layer", "validate_layer"]
_COUNTS = "InvalidSubsetFamily"
"""USD rule whose message lists indices: the same fault has a different message on the fine mesh."""


def validate_layer(layer: str | Path | Sdf.Layer, shot: str | Path | Usd.Stage | None = None) -> list[Problem]:
    """Check a refined layer, alone and over its shot.

    Args:
        layer: The layer, a file or in memory.
        shot: The shot below the layer, a file or an open stage; by default the shot named in the layer's record.

    Returns:
        Problems, errors first; each names path and time. A missing recorded shot is a problem.

    Raises:
        AbsentError: The layer or the shot does not exist.
        LayerError: The layer or the shot cannot be opened or read.
    """
    opened = layer if isinstance(layer, Sdf.Layer) else open_layer(layer)
    below = shot if shot is not None else recorded_shot(opened)
    is_missing = isinstance(below, str) and shot is None and not is_there(below)
    view = None
    if below is not None and not is_missing:
        view = StageView.of(below) if isinstance(below, Usd.Stage) else StageView.of_layer(open_layer(below))
    with pxr_errors(f"cannot read {layer} over {below}", LayerError):
        nothing = Usd.StagePopulationMask()
        stages = [Usd.Stage.OpenMasked(opened, nothing)] + ([] if view is None else [view.open(mask=nothing)])
        if fault := next(filter(None, map(bad_rate, stages)), ""):
            return [Problem("error", "/", None, fault, "time_scale")]
        problems = check_layer(opened, view)
        if is_missing:
            message = f"the shot that its record names is not at {below}; give it with --shot, or bring the layer back"
            problems.append(Problem("error", "/", None, message, "record"))
        elif view is not None and not any(problem.rule == "composition" for problem in problems):
            problems += _on_whole_stage(opened, view)
    return sorted(problems, key=lambda problem: problem.severity != "error")


def what_was_checked(layer: str | Path, shot: str | Path | None = None) -> str:
    """The prims, the samples and the rules that `validate_layer` goes through, in words.

    Args:
        layer: As for `validate_layer`, a file.
        shot: As for `validate_layer`, a file.
    """
    opened = open_layer(layer)
    below = shot or recorded_shot(opened)
    times = {time for path in _refined(opened) for time in _times(opened, path, None) if time is not None}
    samples = f"at {counted(len(times), 'time code')}" if times else "in one pose"
    over = f"alone and over {Path(below).name}" if below else "alone"
    rules = "the rules of this package" + (" and USD's validators" if below and _usd_validation() else "")
    return f"{counted(len(_refined(opened)), 'prim')} {samples}, {over}, by {rules}"


def check_layer(layer: Sdf.Layer, shot: StageView | None, *, samples: int | None = None) -> list[Problem]:
    """Run our rules on a layer, and over its shot if given.

    Args:
        layer: The refined layer.
        shot: The shot, or None to check the layer alone.
        samples: Number of time samples to check, spread over the range; None for all.
    """
    problems = [replace(problem, rule=rule.__name__) for rule in LAYER_RULES for problem in rule(layer)]
    if shot is None:
        return problems
    paths, bound = _garments(layer), [str(path) for path in (read_record(layer) or {}).get("bound") or ()]
    # Only the garments are composed: the surrounding set may be large.
    mask = Usd.StagePopulationMask([*bound, *(path for name in paths for path in {name, _coarse_path(layer, name)})])
    with quiet():
        problems += _named("same_variants", same_variants(layer, shot, [_coarse_path(layer, name) for name in paths]))
        composed, shot_stage = shot.open(over=[layer], mask=mask), shot.open(mask=mask)
    problems += _named("same_metadata", same_metadata(layer, shot_stage))
    for path in paths:
        fault = prim_fault(path, composed)
        if fault:
            problems.append(Problem("error", path, None, fault, "composition"))
            continue
        coarse = shot_stage.GetPrimAtPath(_coarse_path(layer, path))
        problems += _check_garment(composed.GetPrimAtPath(path), layer, samples, coarse=coarse)
        if coarse:
            problems += _named("against_shot", against_shot(layer, coarse, Sdf.Path(path)))
    for path in bound:
        fault = prim_fault(path, composed, FOLLOWERS)
        fine = None if fault else Fine(composed.GetPrimAtPath(path), layer, _times(layer, path, samples))
        if fine is None:
            problems.append(Problem("error", path, None, fault, "composition"))
            continue
        rules = BOUND_INSTANCER_RULES if UsdGeom.PointInstancer(fine.prim) else BOUND_RULES
        for rule in BOUND_MESH_RULES if UsdGeom.Mesh(fine.prim) else rules:
            problems += _named(rule.__name__, rule(fine))
    return problems


def _times(layer: Sdf.Layer, path: str, samples: int | None) -> tuple[float | None, ...]:
    """The default and time codes of a prim's points or positions to check, spread over the range."""
    written = times_with_values(layer, f"{path}.points") or times_with_values(layer, f"{path}.positions")
    if samples is not None and len(written) > samples:
        written = [written[i] for i in np.linspace(0, len(written) - 1, samples).astype(int)]
    return (None, *written)


def _check_garment(prim: Usd.Prim, layer: Sdf.Layer, samples: int | None, *, coarse: Usd.Prim) -> Iterator[Problem]:
    """Run the rules for one garment; subsets already faulty in the shot give a warning."""
    fine = Fine(prim, layer, _times(layer, str(prim.GetPath()), samples))
    in_shot = bool(coarse) and any(subsets(Fine(coarse, layer, (None,))))
    for rule in RULES:
        for problem in _named(rule.__name__, rule(fine)):
            if rule is subsets and in_shot:
                yield replace(problem, severity="warning", message=f"{problem.message}; so it is in the shot")
            else:
                yield problem


def _named(rule: str, problems: Iterable[Problem]) -> Iterator[Problem]:
    return (replace(problem, rule=rule) for problem in problems)


def _garments(layer: Sdf.Layer) -> Sequence[str]:
    """Fine meshes listed by the record, or else every prim with points."""
    named = (read_record(layer) or {}).get("garments")
    if named:
        return [str(path) for path in named]
    return sorted(str(path.GetPrimPath()) for path in paths_in(layer) if path.name == "points")


def _refined(layer: Sdf.Layer) -> list[str]:
    """Fine meshes, and prims that follow them."""
    return [*_garments(layer), *(str(path) for path in (read_record(layer) or {}).get("bound") or ())]


def _coarse_path(layer: Sdf.Layer, path: str) -> str:
    """The coarse mesh of a fine one: the prim itself, or the sibling's reference."""
    spec = layer.GetPrimAtPath(path)
    references = list(spec.referenceList.prependedItems) if spec else []
    return str(references[0].primPath) if references else path


def _on_whole_stage(layer: Sdf.Layer, shot: StageView) -> list[Problem]:
    """Problems of the composed stage: of meshes that reference or inherit refined meshes, and by USD's validators."""
    shot_stage, composed = shot.open(), shot.open(over=[layer])
    with quiet():
        problems = [*_named("other_meshes", other_meshes(layer, composed, shot_stage, refined=_refined(layer)))]
    opened = _opened_instances(layer)
    return problems + _own_validators(layer, shot.open(over=[opened]), composed)


def _opened_instances(layer: Sdf.Layer) -> Sdf.Layer:
    """A layer that opens the same instances as a refined layer: USD's validators skip the contents of instances."""
    opened, paths = Sdf.Layer.CreateAnonymous(".usda"), list[Sdf.Path | str]()
    layer.Traverse(Sdf.Path.absoluteRootPath, paths.append)
    specs = (layer.GetPrimAtPath(path) for path in paths if Sdf.Path(path).IsPrimPath())
    for spec in specs:
        if spec is not None and spec.HasInfo("instanceable") and not spec.instanceable:
            Sdf.CreatePrimInLayer(opened, spec.path).instanceable = False
    return opened


def _own_validators(layer: Sdf.Layer, shot: Usd.Stage, composed: Usd.Stage) -> list[Problem]:
    """Problems found by USD's validators, as far as available, in the layer over its shot but not in the shot.

    Args:
        layer: The refined layer.
        shot: The shot, with the instances opened that the layer opens.
        composed: The layer over its shot.
    """
    module = _usd_validation()
    if module is None:
        return []
    # Both stages have an anonymous session layer; `_without_names` drops its name from the messages.
    (before, after), missing = _findings(module, [shot, composed])
    fine = {path: _coarse_path(layer, path) for path in _garments(layer)}
    sites = {key[:2] for key in before}
    new = [
        problem
        for key, problem in after.items()
        if _on_coarse(key, fine) not in before
        and not (problem.rule.endswith(_COUNTS) and _on_coarse(key, fine)[:2] in sites)
    ]
    return missing + [problem for problem in new if not _is_meant(problem, fine)]


def _usd_validation() -> Any:
    """The module of USD's validators, or None."""
    try:
        from pxr import UsdValidation  # type: ignore[attr-defined] # noqa: PLC0415 - not in every host
    except ImportError:
        return None
    return UsdValidation if hasattr(UsdValidation, "ValidationContext") else None


def _on_coarse(key: tuple[str, ...], fine: Mapping[str, str]) -> tuple[str, ...]:
    """A finding on a sibling, renamed to its coarse mesh: a sibling repeats the coarse mesh's faults."""
    for path, coarse in fine.items():
        key = tuple(part.replace(path, coarse) for part in key)
    return key


def _is_meant(problem: Problem, fine: Mapping[str, str]) -> bool:
    """Whether a finding is intended: a subset family whose faces were all left out."""
    return problem.path in fine and problem.rule.endswith(_COUNTS) and "No indices in family" in problem.message


def _findings(
    module: Any, stages: Sequence[Usd.Stage]
) -> tuple[list[dict[tuple[str, str, str], Problem]], list[Problem]]:
    """Findings on each stage by validator, place and message, and a warning naming the failed validators.

    Some builds of USD lack libraries or data of validators, so each validator runs separately.
    """
    registry, results, failed = module.ValidationRegistry(), [{} for _ in stages], []
    names = (str(metadata.name) for metadata in registry.GetAllValidatorMetadata())
    for name in sorted(name for name in names if not name.startswith(f"{PLUGIN}:")):  # Our own rules have already run.
        try:
            context = module.ValidationContext([registry.GetOrLoadValidatorByName(name)])
            reports = [[_as_problem(module, error) for error in context.Validate(stage)] for stage in stages]
        except USD_ERRORS:
            failed.append(name)
            continue
        for findings, problems in zip(results, reports, strict=True):
            findings.update({(p.rule, p.path, _without_names(p.message)): p for p in problems})
    message = f"{len(failed)} of USD's own validators do not run with this USD: {', '.join(failed)}"
    return results, [Problem("warning", "/", None, message, "validators")] if failed else []


def _as_problem(module: Any, error: Any) -> Problem:
    sites = error.GetSites()
    path = str(sites[0].GetProperty().GetPath() if sites and sites[0].IsProperty() else "")
    if sites and not path and sites[0].IsPrim():
        path = str(sites[0].GetPrim().GetPath())
    severity = "error" if error.GetType() == module.ValidationErrorType.Error else "warning"
    try:
        message = error.GetMessage()
    except UnicodeDecodeError:
        message = "a name in the shot is no text; its file is damaged"
    return Problem(severity, path or "/", None, message, str(error.GetIdentifier()))


def _without_names(message: str) -> str:
    """A message without the name of the anonymous root layer, because the name differs between stages."""
    return " ".join(word for word in message.split() if "anon:" not in word)
