"""Captures the view of an open stage, to open an equal second stage without changing the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from pxr import Sdf, Usd, UsdUtils

Stage: TypeAlias = Usd.Stage
Layer: TypeAlias = Sdf.Layer
"""Names of USD's types for the modules above `usd`."""
_NOT_FOR_ROOT = {"subLayers", "subLayerOffsets", "customLayerData", "documentation", "comment", "hasOwnedSubLayers"}


@dataclass(frozen=True, eq=False)
class StageView:
    """An open stage's in-memory layers and composition settings.

    Attributes:
        root: The stage's own root layer; the root and its sublayers include unsaved edits.
        session: A copy of the session layer.
        muted: Identifiers of muted layers.
        load: Rules for loading payloads.
        context: Context of asset paths, an ``Ar.ResolverContext``.
        interpolation: Interpolation between samples.
    """

    root: Sdf.Layer
    session: Sdf.Layer
    muted: tuple[str, ...]
    load: Usd.StageLoadRules
    population: Usd.StagePopulationMask
    context: Any
    interpolation: Usd.InterpolationType

    @classmethod
    def of(cls, stage: Usd.Stage) -> StageView:
        """Capture a stage without changing the stage."""
        return cls(
            stage.GetRootLayer(),
            _session_of(stage),
            tuple(stage.GetMutedLayers()),
            stage.GetLoadRules(),
            stage.GetPopulationMask(),
            stage.GetPathResolverContext(),
            stage.GetInterpolationType(),
        )

    @classmethod
    def of_layer(cls, root: Sdf.Layer) -> StageView:
        """The view of a shot freshly opened from its root layer."""
        nothing = Usd.Stage.OpenMasked(root, Usd.StagePopulationMask())
        return replace(cls.of(nothing), population=Usd.StagePopulationMask.All())

    def open(self, *, over: Sequence[Sdf.Layer] = (), mask: Usd.StagePopulationMask | None = None) -> Usd.Stage:
        """Open a second stage with equal contents; sublayers of its session go over the first stage's session.

        Args:
            over: Layers to lay over everything, strongest first; keep the layers alive as long as the stage.
            mask: Prims to compose; None for all prims of the first stage.
        """
        session = root_over(self.session, [layer.identifier for layer in (*over, self.session)])
        population = self.population if mask is None else mask
        stage = Usd.Stage.OpenMasked(self.root, session, self.context, population, Usd.Stage.LoadNone)
        stage.SetInterpolationType(self.interpolation)
        stage.MuteAndUnmuteLayers(list(self.muted), [])
        stage.SetLoadRules(self.load)
        return stage


def _session_of(stage: Usd.Stage) -> Sdf.Layer:
    """A copy of a stage's session layer, empty if muted, with absolute asset paths."""
    copy = Sdf.Layer.CreateAnonymous("session.usda")
    session = stage.GetSessionLayer()
    if session is not None and not stage.IsLayerMuted(session.identifier):
        copy.TransferContent(session)
        if not session.anonymous:
            UsdUtils.ModifyAssetPaths(copy, session.ComputeAbsolutePath)
    # A sublayer without authored rate has 24 time codes per second, and USD would rescale its samples.
    copy.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    return copy


def root_over(source: Sdf.Layer, below: list[str]) -> Sdf.Layer:
    """An anonymous root layer with the stage metadata of a shot's root and the sublayers ``below``."""
    root = Sdf.Layer.CreateAnonymous(".usda")
    for key in source.pseudoRoot.ListInfoKeys():
        if key not in _NOT_FOR_ROOT and "elocates" not in key:
            root.pseudoRoot.SetInfo(key, source.pseudoRoot.GetInfo(key))
    root.timeCodesPerSecond = source.timeCodesPerSecond
    for identifier in below:
        root.subLayerPaths.append(identifier)
    return root
