"""In place of usdview, which usd-core does not bring: the base class of its plug-ins, and how it loads them."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from pxr import Plug, Tf


class Registry:
    def registerCommandPlugin(self, name: str, title: str, call: Callable[[Any], None]) -> tuple[str, str, Any]:
        return name, title, call


class Builder:
    """Makes menus; its items by the menu's name."""

    def __init__(self) -> None:
        self.menus: dict[str, list[Any]] = {}

    def findOrCreateMenu(self, name: str) -> Any:
        menu, items = ModuleType(name), self.menus.setdefault(name, [])
        vars(menu)["addItem"] = items.append
        return menu


def install() -> type:
    """Make pxr.Usdviewq.plugin importable; returns the base class, a type of Tf as in usdview."""
    if "pxr.Usdviewq.plugin" not in sys.modules:
        package, module = ModuleType("pxr.Usdviewq"), ModuleType("pxr.Usdviewq.plugin")
        container = type("PluginContainer", (), {"__module__": "pxr.Usdviewq.plugin"})
        vars(module)["PluginContainer"] = container
        sys.modules |= {"pxr.Usdviewq": package, "pxr.Usdviewq.plugin": module}
        Tf.Type.Define(container)
    return sys.modules["pxr.Usdviewq.plugin"].PluginContainer


def menus(plugins: Path) -> dict[str, list[Any]]:
    """Load what derives from usdview's container as usdview does, by libplug and the types' Python classes alone."""
    base = install()
    Plug.Registry().RegisterPlugins(str(plugins))
    builder = Builder()
    for found in Plug.Registry.GetAllDerivedTypes(Tf.Type.Find(base)):
        Plug.Registry().GetPluginForType(found).Load()
        if found.pythonClass is not None:  # usdview warns and goes on
            container = found.pythonClass()
            container.registerPlugins(Registry(), None)
            container.configureView(Registry(), builder)
    return builder.menus
