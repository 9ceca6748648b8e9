"""Fabric parameters in SI units, and named presets.

Sources and their spread are in docs/fabrics.md; trust ranges over points.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fabric:
    """One fabric's parameters.

    Attributes:
        stretch: In-plane Young's modulus of the sheet, Y = E h [N/m]; along the warp where the weft's differs.
        bend: Bending stiffness D = E h^3 / 12 (1 - nu^2) [N m]; along the warp where the weft's differs.
        density: Areal density [kg/m^2].
        thickness: Sheet thickness [m].
        shear: Shear stiffness G h [N/m]; None is 0.375 Y, that of an isotropic sheet.
        weft_stretch: Young's modulus along the weft [N/m]; None is the warp's.
        weft_bend: Bending stiffness along the weft [N m]; None is the warp's.
        stretch_limit: Strain from which the cloth stiffens; None is never.
        warp_ease: Length along the warp that the cloth has and its rest shape does not show, as a fraction.
        weft_ease: The same along the weft.
    """

    stretch: float = 30.0
    bend: float = 4.7e-6
    density: float = 0.187
    thickness: float = 1e-3
    shear: float | None = None
    weft_stretch: float | None = None
    weft_bend: float | None = None
    stretch_limit: float | None = None
    warp_ease: float = 0.0
    weft_ease: float = 0.0

    @property
    def has_membrane(self) -> bool:
        """Whether it needs a membrane: edge springs have a single stiffness and no stretch limit."""
        return any(value is not None for value in (self.shear, self.weft_stretch, self.stretch_limit))

    @property
    def is_eased(self) -> bool:
        """Whether its cloth is longer than the rest shape."""
        return bool(self.warp_ease or self.weft_ease)


PRESETS: dict[str, Fabric] = {
    "paper": Fabric(3.85, 0.29e-6, 0.187),
    "silk": Fabric(100.0, 2.2e-6, 0.083, shear=20.0),
    "cotton": Fabric(261.0, 12e-6, 0.150),
    "wool": Fabric(97.0, 16e-6, 0.235),
    "polyester": Fabric(120.0, 3.6e-6, 0.165),
    "denim": Fabric(1054.0, 41e-6, 0.324, shear=69.0, weft_stretch=226.0, weft_bend=28e-6),
    "jersey": Fabric(30.0, 4.7e-6, 0.187),
    "rib": Fabric(50.0, 9.3e-6, 0.276),
    "leather": Fabric(640.0, 60e-6, 0.65),
    "worn-denim": Fabric(1054.0, 14e-6, 0.324, shear=69.0, weft_stretch=226.0, weft_ease=0.02),
    "crisp-cotton": Fabric(261.0, 23e-6, 0.150, weft_ease=0.01),
    "soft-jersey": Fabric(30.0, 3.6e-6, 0.187, weft_ease=0.03),
}
"""Fabrics by name. Those whose shear stiffness lies within a fifth of an isotropic sheet's are edge springs."""

NAMED: dict[str, str] = {
    **dict.fromkeys(("leather", "suede"), "leather"),
    **dict.fromkeys(("denim", "jeans"), "denim"),
    **dict.fromkeys(("wool", "woollen", "woolen", "tweed", "tartan", "cashmere"), "wool"),
    **dict.fromkeys(("silk", "satin", "chiffon"), "silk"),
    **dict.fromkeys(("cotton", "linen", "poplin"), "cotton"),
    **dict.fromkeys(("polyester", "nylon"), "polyester"),
    **dict.fromkeys(("rib", "knit", "knitted", "knitwear", "fleece"), "rib"),
    **{name: name for name in ("jersey", "paper")},
}
"""Preset that a word for a fabric in the name of a prim, material or subset stands for."""
WORN: dict[str, str] = {
    "belt": "leather",
    **dict.fromkeys(("coat", "overcoat", "scarf", "kilt"), "wool"),
    **dict.fromkeys(("sweater", "pullover", "cardigan", "hoodie", "sweatshirt"), "rib"),
}
"""Preset that a word for a garment stands for, where no name says the fabric. Skirts, dresses, shirts and trousers are
of any fabric."""
