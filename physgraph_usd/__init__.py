"""Refine coarse animated garments in USD shots into fine cloth with physical wrinkles.

    import physgraph_usd as pg

    report = pg.refine_shot("shot.usda", "shot.refined.usdc", pg.RefineOptions(frames=(1, 24)))

Names are looked up when they are first used, so importing this package imports neither torch nor Warp.
Where pxr can be imported the schemas are registered at once: USD accepts them only before the first stage is read.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import TYPE_CHECKING

from .version import __version__ as __version__

if TYPE_CHECKING:
    from .errors import (
        AbsentError,
        GarmentError,
        LayerError,
        PhysGraphError,
        SchemaError,
        SolveError,
        StageError,
        UsageError,
    )
    from .shot.options import RefineOptions
    from .shot.refine import inspect_shot, refine_shot, refine_shots, refine_stage
    from .shot.report import RefineReport
    from .shot.stitch import stitch
    from .solver.fabric import PRESETS, Fabric
    from .usd.check.validate import validate_layer
    from .usd.read.reader import Shot, open_shot
    from .usd.schema import schema_path
    from .usd.write.tag import tag

__all__ = [
    "PRESETS",
    "AbsentError",
    "Fabric",
    "GarmentError",
    "LayerError",
    "PhysGraphError",
    "RefineOptions",
    "RefineReport",
    "SchemaError",
    "Shot",
    "SolveError",
    "StageError",
    "UsageError",
    "inspect_shot",
    "open_shot",
    "refine_shot",
    "refine_shots",
    "refine_stage",
    "schema_path",
    "stitch",
    "tag",
    "validate_layer",
]

_ROOMS = {
    "errors": (
        "AbsentError",
        "GarmentError",
        "LayerError",
        "PhysGraphError",
        "SchemaError",
        "SolveError",
        "StageError",
        "UsageError",
    ),
    "solver.fabric": ("PRESETS", "Fabric"),
    "shot.options": ("RefineOptions",),
    "shot.report": ("RefineReport",),
    "shot.refine": ("inspect_shot", "refine_shot", "refine_shots", "refine_stage"),
    "usd.read.reader": ("Shot", "open_shot"),
    "usd.schema": ("schema_path",),
    "shot.stitch": ("stitch",),
    "usd.write.tag": ("tag",),
    "usd.check.validate": ("validate_layer",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> object:
    """Import the module that has a public name when the name is first used.

    Args:
        name: One of ``__all__``.

    Returns:
        The object of that name.

    Raises:
        AttributeError: If the package has no such public name.
    """
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(importlib.import_module(f".{_ROOM_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__})


def _register_schemas() -> None:
    if find_spec("pxr") is not None:
        from .usd.schema import register

        register()


_register_schemas()
