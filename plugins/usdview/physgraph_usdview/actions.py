"""What the menu does, by the stage and the frame of usdview's API alone; only its session layer is changed."""

from __future__ import annotations

from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

import physgraph_usd as pg

FULL = {"penetration": 5.0, "crossing": 1.0}
"""The value that is drawn in full red: depth in a body [mm], and crossing or not."""
COLD, HOT = np.array([0.6, 0.6, 0.6]), np.array([0.9, 0.1, 0.05])


class Actions:
    """Commands; they hold the layers in memory that the stage names."""

    def __init__(self) -> None:
        """Show nothing yet."""
        self._refined: Sdf.Layer | None = None
        self._colours: Sdf.Layer | None = None

    def refine_frame(self, api: Any) -> None:
        """Refine the garments at the current frame, with heat maps, and show them."""
        self.clear(api)
        frames = None if api.frame.IsDefault() else (api.frame.GetValue(), api.frame.GetValue())
        try:
            self._refined = pg.refine_stage(api.stage, pg.RefineOptions(frames=frames, heat_map=True))
        except pg.PhysGraphError as error:
            api.PrintStatus(f"PhysGraph: {error}")
            return
        _show(api.stage, self._refined)
        api.PrintStatus("PhysGraph: refined")

    def show_heat(self, api: Any, name: str) -> None:
        """Colour the refined cloth by a heat map: grey where there is nothing, red where there is most."""
        if self._refined is None:
            self.refine_frame(api)
        if self._refined is None:
            return
        _hide(api.stage, self._colours)
        self._colours = Sdf.Layer.CreateAnonymous("heat.usda")
        for path in self._refined.customLayerData["physgraph"]["garments"]:
            values = UsdGeom.PrimvarsAPI(api.stage.GetPrimAtPath(path)).GetPrimvar(f"physgraph:{name}").Get(api.frame)
            _colour(self._colours, path, np.asarray([0.0] if values is None else values) / FULL[name])
        _show(api.stage, self._colours)

    def clear(self, api: Any) -> None:
        """Show the coarse cloth again."""
        for layer in (self._colours, self._refined):
            _hide(api.stage, layer)
        self._refined = self._colours = None


def _show(stage: Usd.Stage, layer: Sdf.Layer) -> None:
    """Lay a layer over the stage by its session layer."""
    layer.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    stage.GetSessionLayer().subLayerPaths.insert(0, layer.identifier)


def _hide(stage: Usd.Stage, layer: Sdf.Layer | None) -> None:
    """Take a layer off the stage, if it is there."""
    over = stage.GetSessionLayer().subLayerPaths
    if layer is not None and layer.identifier in over:
        over.remove(layer.identifier)


def _colour(layer: Sdf.Layer, path: str, heat: np.ndarray) -> None:
    """Author a display colour for each vertex, or one for all."""
    share = np.clip(heat, 0.0, 1.0)[:, None]
    spec = Sdf.CreatePrimInLayer(layer, path)
    primvar = Sdf.AttributeSpec(spec, "primvars:displayColor", Sdf.ValueTypeNames.Color3fArray)
    primvar.SetInfo("interpolation", UsdGeom.Tokens.vertex if len(heat) > 1 else UsdGeom.Tokens.constant)
    primvar.default = Vt.Vec3fArray.FromNumpy((COLD + share * (HOT - COLD)).astype(np.float32))
