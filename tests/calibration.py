"""Writes benchmarks/results/calibration.md: what the forces' constants turn out to be on each kind of mesh.

Run ``python tests/calibration.py benchmarks/results/calibration.md`` in an environment where the package is installed;
it takes about half a minute on two cores.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from probes import (
    Spread,
    bending_constants,
    bending_stiffness,
    cantilever,
    catenary_sag,
    cylinder_rigidity,
    elastica,
    hanging_chain,
    over_directions,
    plane_constants,
    plane_stiffness,
    rigidity_from,
    tensile_test,
)
from sheets import KINDS, level_of_kind

from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.forces.membrane import in_plane_terms

YOUNGS, RIGIDITY, DENSITY = 261.0, 5e-6, 0.15
SHEET = (0.16, 0.16, 0.01)
SHEAR = {"springs": None, "membrane, G = 0.375 Y": 0.375 * YOUNGS, "membrane, G = 0.1 Y": 0.1 * YOUNGS}
CHAIN = Fabric(2000.0, 1e-9, 0.2)
CHAIN_LENGTH, CHAIN_SPAN = 0.3, 0.24
BENDING_LENGTH = (RIGIDITY / (DENSITY * 9.81)) ** (1 / 3)
BENT = {"equilateral": -1 / 3, "irregular": -1 / 3, "quads": 0.0}
"""Poisson's ratio of bending by the kind of mesh."""


@dataclass(frozen=True)
class Plane:
    """In-plane constants over the given ones, and the pulled strip's."""

    youngs: Spread
    poisson: Spread
    shear: Spread
    pulled: float
    narrowed: float


@dataclass(frozen=True)
class Bend:
    """Bending constants over the given ones: let relax, and rolled onto a cylinder without relaxing."""

    rigidity: Spread
    poisson: Spread
    rolled: Spread


def measure_plane(kind: str, shear: float | None) -> Plane:
    level = level_of_kind(kind, SHEET)
    terms = in_plane_terms(level, [Fabric(YOUNGS, shear=shear)])
    constants = plane_constants(plane_stiffness(level, terms))
    pulled, narrowed = tensile_test(level, terms)
    return Plane(over(constants["Y"], YOUNGS), constants["nu"], over(constants["G"], YOUNGS), pulled / YOUNGS, narrowed)


def measure_bend(kind: str) -> Bend:
    level = level_of_kind(kind, SHEET)
    constants = bending_constants(bending_stiffness(level, RIGIDITY))
    rolled = over_directions(lambda angle: cylinder_rigidity(level, 10 * SHEET[2], angle))
    return Bend(over(constants["D"], RIGIDITY), constants["nu"], rolled)


def over(spread: Spread, unit: float) -> Spread:
    """A spread in units of a constant."""
    return Spread(spread.mean / unit, spread.low / unit, spread.high / unit)


def measure_cantilever(kind: str, shear: float | None = None) -> tuple[float, float]:
    """Angle [degrees] of a strip two bending lengths long, and the elastica's D for it over the given one."""
    length = 2 * BENDING_LENGTH
    angle = cantilever(kind, length, Fabric(YOUNGS, RIGIDITY, DENSITY, shear=shear))
    return float(np.degrees(angle)), rigidity_from(angle, length, DENSITY) / RIGIDITY


def expected_cantilever(poisson: float) -> float:
    """Angle [degrees] of the elastica of a strip with free long sides: its stiffness is D (1 - nu^2)."""
    return float(np.degrees(elastica(2 * BENDING_LENGTH, RIGIDITY * (1 - poisson**2), DENSITY)))


def cell(spread: Spread) -> str:
    """Mean and range."""
    if spread.high - spread.low < 0.005:
        return f"{spread.mean:.3f}"
    return f"{spread.mean:.2f} ({spread.low:.2f} to {spread.high:.2f})"


def plane_table() -> list[str]:
    rows = ["| mesh | in-plane term | Y | nu | G | pulled: Y | nu |", "|---|---|---|---|---|---|---|"]
    for kind in KINDS:
        for term, shear in SHEAR.items():
            found = measure_plane(kind, shear)
            cells = [cell(found.youngs), cell(found.poisson), cell(found.shear)]
            rows.append(f"| {kind} | {term} | {' | '.join(cells)} | {found.pulled:.3f} | {found.narrowed:.3f} |")
    return rows


def bend_table() -> list[str]:
    rows = ["| mesh | D | nu of bending | D, rolled without relaxing | strip's angle | its D |"]
    rows.append("|---|---|---|---|---|---|")
    for kind in KINDS:
        found = measure_bend(kind)
        angle, rigidity = measure_cantilever(kind)
        cells = " | ".join(cell(spread) for spread in (found.rigidity, found.poisson, found.rolled))
        rows.append(f"| {kind} | {cells} | {angle:.1f} | {rigidity:.2f} |")
    return rows


def chain_table() -> list[str]:
    expected = catenary_sag(CHAIN_LENGTH, CHAIN_SPAN)
    rows = ["| mesh | sag mm | catenary mm |", "|---|---|---|"]
    for kind in KINDS:
        sag = hanging_chain(kind, CHAIN_LENGTH, CHAIN_SPAN, CHAIN)
        rows.append(f"| {kind} | {1e3 * sag:.1f} | {1e3 * expected:.1f} |")
    return rows


PAGE = """# Calibration

What a sheet of cloth shows to an experiment, over what was asked for, on four kinds of mesh. Written by
`python tests/calibration.py benchmarks/results/calibration.md`; `tests/stability/test_forces_analytic.py` holds the
figures in bounds.

The meshes: equilateral triangles; Delaunay triangles of a jittered lattice (quality over 0.4); squares that
came to us as quads; squares that were triangulated before they came to us, all diagonals one way.

## In the plane

The rim of a sheet of 16 by 16 edges is strained uniformly and its inside relaxes; the stiffness matrix read from the
energies gives Y, Poisson's ratio nu and the shear stiffness G for every direction. Y and G are in units of the Y asked
for; isotropic cloth with nu = 1/3 has 1, 0.333 and 0.375. Mean, and range over directions where there is one. The last
columns are a strip pulled along x with its long sides free.

{plane}

- **Springs** are exact on equilateral triangles and on quads that are squares. A quad has springs along its sides and
  both diagonals, of the factors 0.75 and 1.5 (`elements.QUAD_SPRING`). Without these Y would run from 0.75 to 1.20, nu
  from 0.20 to 0.50 and G from 0.25 to 0.50.
- On irregular triangles springs are a little soft: the mesh relaxes into its irregularities.
- **One-way diagonals** cannot be isotropic with three directions of springs: Y is a third along the diagonal's normal.
  Author the quads as quads, or a shear stiffness.
- **The membrane** is exact but for capped slivers of irregular triangles. With G other than 0.375 Y the cloth is not
  isotropic: Y is as asked for along
  warp and weft, softer on the bias, as in woven cloth. That range is the same on every mesh.

## Bending

The rim takes a uniform curvature, the inside relaxes; D in units of the D asked for. Then the sheet is rolled onto a
cylinder of ten edges' radius with every vertex held on it; in both the energy is weighed by a bump that vanishes at the
rim. Then a strip is clamped at one end and hangs under its own
weight: two bending lengths (D / density g)^(1/3) long, 24 edges, a third as wide, hinges at the clamp twice as stiff,
for it leaves one of their two faces to bend. Its chord's angle is compared with the heavy elastica of stiffness
D (1 - nu^2), for the sides are free: {narrow:.1f} degrees for nu = 1/3 or -1/3, and {wide:.1f} degrees for nu = 0.
The last column is the D with which the elastica would hang at the angle found.

{bend}

- Hinges on equilateral triangles have D in every direction, and a Poisson's ratio of bending of -1/3, not +1/3: a sheet
  bent one way bends the same way across, where paper bends back (Seung and Nelson 1988). For cylindrical folds it plays
  no part. A narrow strip with free sides is softer than D by 1 - nu^2 = 0.89 for either sign, which is what the
  strip test of a fabric laboratory sees as well: to reproduce a measured strip on triangles, ask for 1.12 times its D.
  (Peirce's own formula gives 6% more than the elastica at 41.5 degrees.)
- Quads have D in every direction, and a Poisson's ratio of bending of 0: hinges at their sides measure the curvature
  along both sides, and hinges round both diagonals of each quad the twist. A strip hangs as a beam of stiffness D.
- One-way diagonals are three times too stiff about one diagonal and a quarter too soft about the other.

## Hanging

A strip of 30 edges, nearly inextensible and nearly without bending stiffness, pinned at both ends: 300 mm between ends
240 mm apart. On equilateral triangles the pinned ends are jagged, which shortens the strip by half an edge.

{chain}
"""


def page() -> str:
    narrow, wide = expected_cantilever(1 / 3), expected_cantilever(0.0)
    tables = {"plane": plane_table(), "bend": bend_table(), "chain": chain_table()}
    return PAGE.format(narrow=narrow, wide=wide, **{name: "\n".join(rows) for name, rows in tables.items()})


if __name__ == "__main__":
    prepare_device("cpu")
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
