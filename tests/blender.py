"""Marks of tests that run in a process of Blender's own Python."""

from __future__ import annotations

import os

import pytest

NEEDS_BLENDER = [
    pytest.mark.blender,
    pytest.mark.slow,
    pytest.mark.skipif(
        not os.environ.get("PHYSGRAPH_BPY_PYTHON"),
        reason="PHYSGRAPH_BPY_PYTHON does not name a Python that has Blender's bpy",
    ),
]
