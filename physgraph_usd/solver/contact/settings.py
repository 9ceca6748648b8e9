"""Contact settings."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ContactSettings:
    """Contact settings.

    Attributes:
        form: Contact with bodies: "quadratic" or "off".
        cloth: Contact of cloth with cloth: "pairs" of points, faces and edges, or "off".
        stiffness: k_c of bodies and of cloth pairs, in stretch stiffnesses over the square of the cage's mean edge.
        clearance: Fraction of the offset to which cloth inside bodies is moved out after the solve.
        way_out: Longest push of vertices that get between overlapping parts of a body, in the cage's mean edges.
            Vertices between such parts in the input stay.
        measured: True measures contact even if it is off.
    """

    form: str = "quadratic"
    cloth: str = "pairs"
    stiffness: float = 15.0
    clearance: float = 0.25
    way_out: float = 0.5
    measured: bool = False

    @property
    def sees_bodies(self) -> bool:
        """True if distances to bodies are needed."""
        return self.form != "off" or self.measured

    def to_measure(self) -> ContactSettings | None:
        """Settings with all contact on, to measure contact that is switched off; None if nothing has to be measured."""
        if not self.measured or (self.form != "off" and self.cloth != "off"):
            return None
        on = ContactSettings()
        return replace(self, form=on.form, cloth=on.cloth)

    def scaled(self, edge: float, *, stretch: float) -> ContactSettings:
        """Settings with stiffnesses in SI [N/m^3].

        Args:
            edge: Mean edge of the cage [m].
            stretch: Stretch stiffness of the cloth [N/m].
        """
        return replace(self, stiffness=self.stiffness * stretch / edge**2)
