"""The view of an open stage, so that a second stage can show the same and be changed without touching the first."""

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
    """An open stage's layers as they are in memory, and how they are composed.

    Attributes:
        root: Root layer, the stage's own: edits that are not saved are in it and in the layers that it names.
        session: A copy of the session layer.
        muted: Identifiers of muted layers.
        load: Rules for loading payloads.
        population: Prims on the stage.
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
        """Look at a stage; it is not changed."""
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
        """A shot as it is opened from its root layer."""
        nothing = Usd.Stage.OpenMasked(root, Usd.StagePopulationMask())
        return replace(cls.of(nothing), population=Usd.StagePopulationMask.All())

    def open(self, *, over: Sequence[Sdf.Layer] = (), mask: Usd.StagePopulationMask | None = None) -> Usd.Stage:
        """Open a second stage that shows the same; sublayers of its session go over the first one's session.

        Args:
            over: Layers to lay over everything, strongest first; keep them alive as long as the stage.
            mask: Prims to compose; None for all that the first stage has.
        """
        session = root_over(self.session, [layer.identifier for layer in (*over, self.session)])
        population = self.population if mask is None else mask
        stage = Usd.Stage.OpenMasked(self.root, session, self.context, population, Usd.Stage.LoadNone)
        stage.SetInterpolationType(self.interpolation)
        stage.MuteAndUnmuteLayers(list(self.muted), [])
        stage.SetLoadRules(self.load)
        return stage


def _session_of(stage: Usd.Stage) -> Sdf.Layer:
    """A copy of a stage's session layer, empty where it is muted; the files that it names are found from anywhere."""
    copy = Sdf.Layer.CreateAnonymous("session.usda")
    session = stage.GetSessionLayer()
    if session is not None and not stage.IsLayerMuted(session.identifier):
        copy.TransferContent(session)
        if not session.anonymous:
            UsdUtils.ModifyAssetPaths(copy, session.ComputeAbsolutePath)
    # As a sublayer without its own rate it would have 24 time codes per second, and USD would rescale its samples.
    copy.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    return copy


def root_over(source: Sdf.Layer, below: list[str]) -> Sdf.Layer:
    """Make an anonymous root layer with the stage metadata of a shot's root and the sublayers ``below``."""
    root = Sdf.Layer.CreateAnonymous(".usda")
    for key in source.pseudoRoot.ListInfoKeys():
        if key not in _NOT_FOR_ROOT and "elocates" not in key:
            root.pseudoRoot.SetInfo(key, source.pseudoRoot.GetInfo(key))
    root.timeCodesPerSecond = source.timeCodesPerSecond
    for identifier in below:
        root.subLayerPaths.append(identifier)
    return root
