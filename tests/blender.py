"""Marks of tests that run in a process of Blender's own Python, and the add-on's modules that need none."""

import os
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ADDON = Path(__file__).parents[1] / "plugins" / "blender"

NEEDS_BLENDER = [
    pytest.mark.blender,
    pytest.mark.slow,
    pytest.mark.skipif(
        not os.environ.get("PHYSGRAPH_BPY_PYTHON"),
        reason="PHYSGRAPH_BPY_PYTHON does not name a Python that has Blender's bpy",
    ),
]


def addon_module(name: str) -> ModuleType:
    """A module of the add-on that needs no Blender; the add-on's own start, which does, is left out."""
    package = ModuleType("blender_addon")
    package.__path__ = [str(ADDON)]
    sys.modules.setdefault(package.__name__, package)
    return import_module(f"{package.__name__}.{name}")
