"""How cloth is shown: columns side by side, and the label over each."""

from __future__ import annotations

from dataclasses import dataclass

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
