"""The menu, by usdview's own classes."""

from __future__ import annotations

from typing import Any

from pxr import Tf
from pxr.Usdviewq.plugin import PluginContainer

from .actions import Actions


class PhysGraphContainer(PluginContainer):
    """Registers the commands and puts them into a menu."""

    def registerPlugins(self, plugRegistry: Any, plugCtx: Any) -> None:
        """Register the commands."""
        del plugCtx
        actions = Actions()
        commands = {
            "refine": ("Refine Current Frame", actions.refine_frame),
            "penetration": ("Show Depth in Bodies", lambda api: actions.show_heat(api, "penetration")),
            "crossing": ("Show Crossings", lambda api: actions.show_heat(api, "crossing")),
            "clear": ("Show Coarse Cloth", actions.clear),
        }
        self._commands = [
            plugRegistry.registerCommandPlugin(f"physgraph.{name}", title, call)
            for name, (title, call) in commands.items()
        ]

    def configureView(self, plugRegistry: Any, plugUIBuilder: Any) -> None:
        """Make the menu."""
        del plugRegistry
        menu = plugUIBuilder.findOrCreateMenu("PhysGraph")
        for command in self._commands:
            menu.addItem(command)


Tf.Type.Define(PhysGraphContainer)
