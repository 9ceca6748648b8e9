"""The paper's material figure: one coarse frame in 4 x 4 stiffnesses of stretch and bending over two decades each.

Draws docs/pictures/material_grid.png. The sample `sleeve`, whose coarse tube is compressed by a fifth and twisted,
without cloth on cloth, solved by the learned integrator: one file of weights in all sixteen. A cell's wavelength is
where the spectrum of the detail's slope has its peak: the energies of `loose.py` between neighbouring low-pass filters,
over the square of their wavelength, a parabola through the logarithms of the highest three; an eighth of the tube at
either rim does not count. Thin sheets under a given strain have wrinkles as long as (bending / stretch)^(1/4), or
^(1/2) where nothing but the strain chooses (Cerda and Mahadevan 2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.drawing import Thing
from benchmarks.rows import Row
from benchmarks.shots import frames_of, opened, problem_of
from benchmarks.waves import lowpass, vertex_area
from physgraph_usd.lab.chart.problem import COLD, Problem, with_garments
from physgraph_usd.shot.page.drawing import draw, fit_view
from physgraph_usd.shot.page.preview import label
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.level import Level
from physgraph_usd.solver.scene import Frame

TIME = 24.0
STRETCHES = tuple(20.0 * 100.0 ** (step / 3.0) for step in range(4))
BENDS = tuple(4e-6 * 100.0 ** (step / 3.0) for step in range(4))
"""Stretch [N/m] and bending stiffnesses [N m]."""
LAW = (0.25, 0.5)
"""Exponents of the laws."""
WAVES = np.geomspace(6e-3, 0.16, 14)
"""Cut-off wavelengths of the filters [m]."""
RIM = 0.12
"""Part of the tube's length at either end that does not count."""
STEPS = {True: 12, False: 100}
"""Steps of each cell, by whether the form is the short one."""
PICTURE = Path("docs/pictures/material_grid.png")
PANEL, BAND = (300, 280), 40
"""A cell's size and the height of its label [pixels]."""
AXES = (20.0, 8.0)
"""Camera's azimuth and elevation [degrees]."""


@dataclass(frozen=True)
class Cell:
    """One material.

    Attributes:
        stretch: [N/m].
        bend: [N m].
        wave: Wavelength of the folds [m].
        points: Fine positions [m].
    """

    stretch: float
    bend: float
    wave: float
    points: np.ndarray


def measure(short: bool, picture: Path = PICTURE) -> list[Row]:
    """The grid's rows and its picture."""
    shot = opened("sleeve", 2)
    problem = problem_of(shot)
    [frame] = frames_of(shot, [TIME])
    level = problem.refiner.groups[0].levels[-1]
    spectrum = Spectrum(level)
    own = {"method": method_named("physgraph"), "steps": STEPS[short], "tolerance": 0.0}
    settings = replace(COLD, **own, contact=replace(COLD.contact, cloth="off"))
    grid = [[solved(problem, frame, settings, spectrum, fabric) for fabric in row] for row in fabrics()]
    columns = list(zip(*grid, strict=True))
    rising = sum(all(b.wave > a.wave for a, b in pairwise(column)) for column in columns)
    ratios = [column[-1].wave / column[0].wave for column in columns]
    bend, stretch = exponents([cell for row in grid for cell in row])
    paint(grid, level.triangles.cpu().numpy(), picture)
    return [
        Row(
            "columns in which folds grow with every step of bending", f"{rising} of 4", "bigger folds", "4", rising == 4
        ),
        Row("folds of a hundred times the bending, least and most", f"{min(ratios):.2f} to {max(ratios):.2f} times"),
        Row("exponent of bending", f"{bend:.3f}", "-", f"{LAW[0]:g} to {LAW[1]:g}", LAW[0] <= bend <= LAW[1]),
        Row("exponent of stretch", f"{stretch:.3f}", "-", f"-{LAW[1]:g} to -{LAW[0]:g}", LAW[0] <= -stretch <= LAW[1]),
    ]


def fabrics() -> list[list[Fabric]]:
    """The materials, a row for each bending stiffness."""
    return [[replace(PRESETS["jersey"], stretch=stretch, bend=bend) for stretch in STRETCHES] for bend in BENDS]


def solved(problem: Problem, frame: Frame, settings: SolveSettings, spectrum: Spectrum, fabric: Fabric) -> Cell:
    """One cell."""
    here = with_garments(frame, lambda each: replace(each, fabric=fabric))
    points = problem.solve(here, settings).points[0]
    detail = points - problem.upsampled(here, smooth=True)[0]
    return Cell(fabric.stretch, fabric.bend, spectrum.dominant(detail), points)


class Spectrum:
    """The spectrum of fields on a tube."""

    def __init__(self, level: Level) -> None:
        """Factorise the filters."""
        rest = level.rest.double().cpu().numpy()
        along = rest[:, int(np.argmax(np.ptp(rest, axis=0)))]
        place = (along - along.min()) / np.ptp(along)
        self._inner = (place > RIM) & (place < 1.0 - RIM)
        self._area, self._filters = vertex_area(level)[self._inner, None], lowpass(level, WAVES.tolist())

    def dominant(self, detail: np.ndarray) -> float:
        """Wavelength that carries the most slope of a field [m].

        Args:
            detail: One vector a vertex [m], shape (V, 3).
        """
        low = [smoothed(detail)[self._inner] for smoothed in self._filters]
        middle = np.sqrt(WAVES[:-1] * WAVES[1:])
        energy = np.array([(self._area * (b - a) ** 2).sum() for a, b in pairwise(low)])
        return peak(energy / middle**2, middle)


def peak(values: np.ndarray, places: np.ndarray) -> float:
    """Where a curve has its highest value; places are evenly spaced logarithms."""
    top, shift = int(np.argmax(values)), 0.0
    if 0 < top < len(values) - 1:
        a, b, c = np.log(values[top - 1 : top + 2])
        shift = 0.5 * (a - c) / (a - 2.0 * b + c)
    return float(np.exp(np.interp(top + shift, range(len(places)), np.log(places))))


def exponents(cells: list[Cell]) -> tuple[float, float]:
    """Powers of bending and of stretch that fit the wavelengths best."""
    x = np.array([[1.0, np.log(cell.bend), np.log(cell.stretch)] for cell in cells])
    fit = np.linalg.lstsq(x, np.log([cell.wave for cell in cells]), rcond=None)[0]
    return float(fit[1]), float(fit[2])


def paint(grid: list[list[Cell]], triangles: np.ndarray, out: Path) -> None:
    """Draw the cells: stretch grows to the right, bending downwards."""
    view = fit_view(grid[-1][-1].points, PANEL[0] / PANEL[1], azimuth=AXES[0], elevation=AXES[1])
    height = PANEL[1] + BAND
    sheet = Image.new("RGB", (len(grid[0]) * PANEL[0], len(grid) * height), "white")
    pen = ImageDraw.Draw(sheet)
    for row, cells in enumerate(grid):
        for column, cell in enumerate(cells):
            corner = column * PANEL[0], row * height
            floor = float(cell.points[:, 1].min()) - 0.02
            pixels = draw([Thing(cell.points, triangles).surface()], view, size=PANEL, floor=floor)
            sheet.paste(Image.fromarray(pixels), (corner[0], corner[1] + BAND))
            title = f"stretch {cell.stretch:.3g} N/m, bending {cell.bend:.2g} N m"
            label(pen, corner, 12 * BAND, lines=["", title, f"folds of {1e3 * cell.wave:.0f} mm"])
    out.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(96, kmeans=2, dither=Image.Dither.NONE).save(out, optimize=True)
