"""A session's file beside its layer, read at the next start: presets of one's own, and how it was looked at."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import UsageError
from ..usd.write.atomic import write_text

KIND = "physgraph tune"


class Notes:
    """A JSON file beside a layer; it is written by `save` alone.

    Attributes:
        path: The file.
        presets: Values [SI] of each preset of one's own, by the schema's short names.
        looked: How the session was looked at: plain values by name.
    """

    def __init__(self, layer: Path) -> None:
        """Read the notes beside a layer, if there are any.

        Raises:
            UsageError: The file there is not a session's.
        """
        self.path = layer.with_suffix(".json")
        remedy = "move it away, or choose another layer with -o"
        try:
            found: Any = json.loads(self.path.read_text()) if self.path.exists() else {"kind": KIND}
            if found["kind"] != KIND:
                raise UsageError(f"{self.path} holds no notes of a tuning session; {remedy}")
            self.presets: dict[str, dict[str, float]] = {
                name: {key: float(value) for key, value in values.items()}
                for name, values in found.get("presets", {}).items()
            }
            self.looked: dict[str, Any] = dict(found.get("looked", {}))
        except (OSError, ValueError, AttributeError, TypeError, LookupError) as error:
            raise UsageError(f"{self.path} cannot be read: {error}; {remedy}") from error

    def save(self, looked: Mapping[str, Any]) -> None:
        """Write the presets, and how the session is looked at."""
        self.looked = dict(looked)
        notes = {"kind": KIND, "presets": self.presets, "looked": self.looked}
        write_text(self.path, json.dumps(notes, indent=1) + "\n")
