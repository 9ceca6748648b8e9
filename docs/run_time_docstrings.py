"""Extension for the site's Python page: `RefineOptions` makes its docstring of its fields as it is imported."""

from __future__ import annotations

from typing import Any

import griffe

from physgraph_usd.shot.options import RefineOptions


class RunTimeDocstrings(griffe.Extension):
    """Gives `RefineOptions` the docstring that it has at run time."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Replace the docstring once the class is read."""
        if cls.name == RefineOptions.__name__:
            cls.docstring = griffe.Docstring(RefineOptions.__doc__ or "", parent=cls)
