"""The artist's loop: raise bendStiffness tenfold on the T-shirt, refine again, and see larger folds.

    python -m benchmarks.artist_loop [docs/pictures/bending.png]

Prints the folds' wavelength, 2 pi sqrt(|grad d|^2 / |laplacian d|^2) with both at the 90th percentile over the cloth,
of the detail d, for each stiffness, and draws both. Slopes and curvatures are weighed, not heights: heights are those
of the sag and of the lifted sleeve. The percentile takes the folds, not the armpit, pinched sharp at any stiffness.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from pxr import Usd, UsdGeom

from benchmarks.rows import say
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.page.preview import preview
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.usd.read.reader import Shot, open_shot

STIFFNESSES = (4.7e-6, 47e-6)
TIME = 36.0


def main() -> None:
    """Refine twice, print the wavelengths and draw the pictures one above the other."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_sample("tshirt", Path(folder))
        shot = open_shot(path)
        refinements = refine_garments(shot.scene.garments, [garment.level for garment in shot.scene.garments])
        level = build_levels(shot.scene.garments, refinements)[-1]
        pictures = []
        for stiffness in STIFFNESSES:
            layer = Path(folder) / f"{stiffness}.usdc"
            refine_shot(path, layer, RefineOptions(overrides=(f"physgraph:material:bendStiffness={stiffness}",)))
            wave = wavelength(level, detail(shot, level, layer))
            say(f"bendStiffness {stiffness:.2g} N m: folds of {1e3 * wave:.0f} mm")
            pictures.append(preview(layer, layer.with_suffix(".png"), times=[TIME], size=(1280, 640)))
        if len(sys.argv) > 1:
            stack(pictures, Path(sys.argv[1]))


def detail(shot: Shot, level: Level, layer: Path) -> np.ndarray:
    """Fine positions minus the smoothly upsampled cage [m], shape (V, 3)."""
    stage = Usd.Stage.Open(str(layer))
    points = np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath(shot.sources[0].path)).GetPointsAttr().Get(TIME))
    matrix = shot.to_metres(0, TIME)
    fine = points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return fine - level.smooth_from_coarse @ shot.frame(TIME).garments[0].points


def wavelength(level: Level, field: np.ndarray) -> float:
    """Wavelength [m] of a vector field by the ratio of its gradient to its Laplacian.

    Springs of weight 2 a_e / l^2 are the Laplacian of an equilateral mesh.
    """
    ends, length = level.springs.numpy(), level.spring_length.double().numpy()
    weight = 2.0 * level.spring_area.double().numpy() / length**2
    rise = field[ends[:, 1]] - field[ends[:, 0]]
    pull = np.zeros_like(field)
    np.add.at(pull, ends[:, 0], weight[:, None] * rise)
    np.add.at(pull, ends[:, 1], -weight[:, None] * rise)
    area = np.maximum(level.vertex_area.double().numpy(), 1e-12)
    slope = np.bincount(ends.ravel(), np.repeat(0.5 * weight * (rise**2).sum(axis=1), 2), len(field)) / area
    curvature = (pull**2).sum(axis=1) / area**2
    return float(2.0 * np.pi * np.sqrt(np.percentile(slope, 90) / np.percentile(curvature, 90)))


def stack(pictures: list[Path], out: Path) -> None:
    """Put pictures one above the other."""
    images = [Image.open(picture).convert("RGB") for picture in pictures]
    width, height = images[0].size
    sheet = Image.new("RGB", (width, height * len(images)))
    for row, image in enumerate(images):
        sheet.paste(image, (0, row * height))
    sheet.save(out, optimize=True)
    say(f"picture {out}")


if __name__ == "__main__":
    main()
