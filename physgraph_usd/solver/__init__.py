"""Cloth and its physics, without USD: a scene and its frames in, positions out.

    refiner = Refiner(Scene((Garment.of("/Sheet", faces, rest),), gravity), SolveSettings())
    fine = refiner.solve(Frame(1.0, (GarmentFrame(points, PRESETS["jersey"]),))).garments[0].points

Names are looked up when they are first used, so importing this package imports neither torch nor Warp. docs/api.md has
a whole example.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .colliders.pose import Collider, Pose
    from .colliders.primitives import primitive
    from .fabric import PRESETS, Fabric
    from .frame.refiner import Refiner
    from .frame.settings import SolveSettings
    from .scene import Frame, Garment, GarmentFrame, GarmentResult, Result, Scene

__all__ = [
    "PRESETS",
    "Collider",
    "Fabric",
    "Frame",
    "Garment",
    "GarmentFrame",
    "GarmentResult",
    "Pose",
    "Refiner",
    "Result",
    "Scene",
    "SolveSettings",
    "primitive",
]
_MODULES = {
    "colliders.pose": ("Collider", "Pose"),
    "colliders.primitives": ("primitive",),
    "fabric": ("PRESETS", "Fabric"),
    "frame.refiner": ("Refiner",),
    "frame.settings": ("SolveSettings",),
    "scene": ("Frame", "Garment", "GarmentFrame", "GarmentResult", "Result", "Scene"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> object:
    """Import the module that has a public name when the name is first used.

    Raises:
        AttributeError: There is no such name.
    """
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(importlib.import_module(f".{_MODULE_OF[name]}", __name__), name)
