"""How cloth is shown: columns side by side, and the label over each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from .maps import PLAIN

CAGE, SUBDIVISION, KEPT, FINE = "cage", "subdivision", "A", "refined"
BESIDE_A = "B"
"""Label of the refined cloth beside A."""
SHOWS: dict[str, tuple[str, ...]] = {
    "refined": (FINE,),
    "cage | refined": (CAGE, FINE),
    "cage | subdivision | refined": (CAGE, SUBDIVISION, FINE),
    "subdivision | refined": (SUBDIVISION, FINE),
    "A | B": (KEPT, FINE),
}
"""Columns of each choice, from left to right."""


@dataclass(frozen=True)
class View:
    """How cloth is shown.

    Attributes:
        show: A name of `SHOWS`.
        wiped: Whether the first and the last column stand at one place, the first left of the wipe.
        wipe: Where the wipe stands, 0 to 1 from left to right.
        wires: Whether the edges of the meshes are drawn.
        map: A name of `maps.NAMES`.
    """

    show: str = next(iter(SHOWS))
    wiped: bool = False
    wipe: float = 0.5
    wires: bool = False
    map: str = PLAIN

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns, from left to right."""
        found = SHOWS[self.show]
        return (found[0], found[-1]) if self.wiped and len(found) > 1 else found


class Labels:
    """Names over the columns of a scene."""

    def __init__(self, scene: viser.SceneApi) -> None:
        """Draw no label."""
        self._scene = scene
        self._drawn: dict[str, viser.LabelHandle] = {}

    def draw(self, places: Mapping[str, np.ndarray]) -> None:
        """Label columns, unless there is only one; the present refined cloth beside A is `BESIDE_A`.

        Args:
            places: Middle of the lower edge of each column's label in the scene [m], shape (3,).
        """
        texts = {name: BESIDE_A if name == FINE and KEPT in places else name for name in places if len(places) > 1}
        wanted = {text: tuple(places[name].tolist()) for name, text in texts.items()}
        for text in self._drawn.keys() - wanted.keys():
            self._drawn.pop(text).remove()
        for text, place in wanted.items():
            if text not in self._drawn:
                look: dict[str, Any] = {"position": place, "anchor": "bottom-center"}
                self._drawn[text] = self._scene.add_label(f"label/{text}", text, **look)
            elif tuple(self._drawn[text].position) != place:
                self._drawn[text].position = place
