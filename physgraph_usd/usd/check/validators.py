"""Registers the rules of `validate` with UsdValidation, for usdchecker and host programs.

The validators check refined layers in a stage's layer stack, as composed; rules comparing with the shot below stay in
`validate`. Registering from Python needs USD 26.5; the plugInfo.json in plugins/usdvalidation names each rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from ..provenance import read_record
from ..stage import at_time
from ..write.track import extent_of
from .rules import LAYER_RULES, RULES, Fine, Problem, extent

PLUGIN = "physgraph_validators"
"""Name of the plug-in; prefix of the rules' names and of entries in its plugInfo.json."""
EXTENT_FIXER = "recomputeExtent"


def register() -> bool:
    """Register every rule as ``PLUGIN:RULE``; False if this USD cannot register validators from Python."""
    try:
        from pxr import UsdValidation  # type: ignore[attr-defined] # noqa: PLC0415 - not in every host
    except ImportError:
        return False
    registry = UsdValidation.ValidationRegistry()
    if not hasattr(registry, "RegisterPluginPrimValidator"):
        return False
    for rule in LAYER_RULES:
        registry.RegisterPluginLayerValidator(f"{PLUGIN}:{rule.__name__}", _layer_task(UsdValidation, rule))
    purpose = "Writes the extent of the points, at the times of the points, into the refined layer."
    fixer = UsdValidation.ValidationFixer(EXTENT_FIXER, purpose, _fix_extent, _can_fix_extent, [], extent.__name__)
    for rule in RULES:
        name, task = f"{PLUGIN}:{rule.__name__}", _prim_task(UsdValidation, rule)
        registry.RegisterPluginPrimValidator(name, task, [fixer] if rule is extent else [])
    return True


def _layer_task(module: Any, rule: Callable[[Sdf.Layer], Iterator[Problem]]) -> Callable[[Sdf.Layer], list[Any]]:
    """A validator for layers; a layer without our record has no problems."""

    def task(layer: Sdf.Layer) -> list[Any]:
        if read_record(layer) is None:
            return []
        return _errors(module, rule.__name__, rule(layer), lambda path: module.ValidationErrorSite(layer, path))

    return task


def _prim_task(module: Any, rule: Callable[[Fine], Iterator[Problem]]) -> Callable[[Usd.Prim, Any], list[Any]]:
    """A validator for garments; a prim not named by a refined layer of the stage has no problems."""

    def task(prim: Usd.Prim, _times: Any) -> list[Any]:
        fine = refined(prim)
        stage = prim.GetStage()
        problems = rule(fine) if fine else ()
        return _errors(module, rule.__name__, problems, lambda path: module.ValidationErrorSite(stage, path))

    return task


def _errors(module: Any, name: str, problems: Iterable[Problem], site: Callable[[Sdf.Path], Any]) -> list[Any]:
    """Convert problems to UsdValidation errors, with the rule's name."""
    kinds = {"error": module.ValidationErrorType.Error, "warning": module.ValidationErrorType.Warn}
    errors = []
    for problem in problems:
        message = f"<{problem.path}>{at_time(problem.time)}: {problem.message}"
        errors.append(module.ValidationError(name, kinds[problem.severity], [site(Sdf.Path(problem.path))], message))
    return errors


def refined(prim: Usd.Prim) -> Fine | None:
    """A mesh named by a refined layer of its stage, or None."""
    if not UsdGeom.Mesh(prim):
        return None
    path = prim.GetPath()
    for layer in prim.GetStage().GetLayerStack(includeSessionLayers=False):
        if str(path) in map(str, (read_record(layer) or {}).get("garments", ())):
            return Fine(prim, layer, (None, *layer.ListTimeSamplesForPath(path.AppendProperty("points"))))
    return None


def _at(error: Any, target: Usd.EditTarget) -> Fine | None:
    """The garment of an error, if the edit target is the refined layer."""
    sites = error.GetSites()
    prim = sites[0].GetProperty().GetPrim() if sites and sites[0].IsProperty() else Usd.Prim()
    fine = refined(prim) if prim else None
    return fine if fine and target.GetLayer() == fine.layer else None


def _can_fix_extent(error: Any, target: Usd.EditTarget, _time: Usd.TimeCode) -> bool:
    """Whether the layer has points to compute the extent from, all finite."""
    fine = _at(error, target)
    if fine is None or not fine.layer.permissionToEdit:
        return False
    arrays = [np.asarray(value) for value in _points(fine).values()]
    return bool(arrays) and all(len(array) and np.isfinite(array).all() for array in arrays)


def _fix_extent(error: Any, target: Usd.EditTarget, _time: Usd.TimeCode) -> bool:
    """Write the extent at the default and at every sample of the points; drop samples at other times."""
    fine = _at(error, target)
    if fine is None:
        return False
    path = fine.prim.GetPath().AppendProperty("extent")
    with Sdf.ChangeBlock():
        prim = fine.layer.GetPrimAtPath(fine.prim.GetPath())
        spec = fine.layer.GetAttributeAtPath(path) or Sdf.AttributeSpec(prim, "extent", Sdf.ValueTypeNames.Float3Array)
        for time in set(fine.written("extent")) - set(fine.written("points")):
            fine.layer.EraseTimeSample(path, time)
        for time, value in _points(fine).items():
            box = Vt.Vec3fArray.FromNumpy(extent_of(np.asarray(value)))
            if time is None:
                spec.default = box
            else:
                fine.layer.SetTimeSample(path, time, box)
    return True


def _points(fine: Fine) -> dict[float | None, Any]:
    """The layer's own points by time, the default under None."""
    path = fine.prim.GetPath().AppendProperty("points")
    spec = fine.layer.GetAttributeAtPath(path)
    default = {None: spec.default} if spec and spec.HasDefaultValue() else {}
    return default | {time: fine.layer.QueryTimeSample(path, time) for time in fine.written("points")}
