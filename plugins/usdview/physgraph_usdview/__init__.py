"""A usdview plug-in: a menu that refines the current frame and shows heat maps.

usdview imports this package alone, and finds in it the container that plugInfo.json declares.
"""

from __future__ import annotations

from .container import PhysGraphContainer as PhysGraphContainer
