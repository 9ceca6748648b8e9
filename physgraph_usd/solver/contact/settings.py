"""How contact is solved."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..level import Level


@dataclass(frozen=True)
class ContactSettings:
    """How contact is solved.

    Attributes:
        form: Against bodies: "quadratic" or "off".
        cloth: Of cloth with cloth: "pairs" of points, faces and edges, or "off".
        stiffness: k_c, in stretch stiffnesses over the square of the cage's mean edge.
        cloth_stiffness: The same of pairs.
        clearance: Part of the offset that the last projection leaves at least.
        projections: Most passes of the last projection.
        lifts: How often it moves faces outwards that a body comes through.
        way_out: How far vertices that get between overlapping parts of a body are pushed out at most, in the cage's
            mean edges. What the input has there stays.
        measured: Whether what is off is measured all the same.
    """

    form: str = "quadratic"
    cloth: str = "pairs"
    stiffness: float = 15.0
    cloth_stiffness: float = 15.0
    clearance: float = 0.25
    projections: int = 10
    lifts: int = 40
    way_out: float = 0.5
    measured: bool = False

    @property
    def sees_bodies(self) -> bool:
        """Whether bodies are looked for at all."""
        return self.form != "off" or self.measured

    def to_measure(self) -> ContactSettings | None:
        """Settings by which all is measured, where these leave out something that is to be; else None."""
        if not self.measured or (self.form != "off" and self.cloth != "off"):
            return None
        on = ContactSettings()
        return replace(self, form=on.form, cloth=on.cloth)

    def scaled(self, cage: Level, *, stretch: float) -> ContactSettings:
        """Settings with stiffnesses in SI [N/m^3].

        Args:
            cage: The cage.
            stretch: Stretch stiffness of the cloth [N/m].
        """
        per_area = stretch / float(cage.spacing.mean()) ** 2
        stiffness, cloth = self.stiffness * per_area, self.cloth_stiffness * per_area
        return replace(self, stiffness=stiffness, cloth_stiffness=cloth)
