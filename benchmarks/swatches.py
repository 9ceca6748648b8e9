"""The pictures of docs/swatches.md: every preset draped, gathered and pinched.

    python -m benchmarks.swatches docs/pictures [PRESET...]
    python -m benchmarks.swatches physgraph_usd/studio/swatches --thumbnails

Each is simulated by the potential and inertia of `benchmarks.fidelity` for a second, without contact, in triangles of
5 mm. Draped: a square of 30 cm over a round support of 18. Gathered: 30 cm hang from 19. Pinched: two points of a
hanging square, 8 cm apart, are brought together to 3. Printed: the total absolute mean curvature of each, the waves of
its hem, and the pairs of presets that differ in no test by a tenth or more in either.
With ``--thumbnails`` each draped preset alone, as a small WebP: those that `tune` shows beside its presets.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.signal import find_peaks

from benchmarks.drawing import Thing, drawn, framing, upright
from benchmarks.fidelity import Judge, garment_of, level_at, simulated
from benchmarks.fidelity_stages import Stage, grid
from benchmarks.rows import say
from physgraph_usd.shot.page.drawing import draw
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS

SIDE, QUADS, FRAMES = 0.3, 30, 24
LEAST_WAVE = 2e-3
"""Least height of a wave of a hem above the higher of its valleys [m]."""
PANEL, COLUMNS = (250, 230), 4
THUMBNAIL, SHARPER, QUALITY = (192, 144), 3, 82
"""Size of a thumbnail [pixels], drawn pixels a side for each of its own, and quality of WebP."""


def draped() -> Stage:
    """A square over a round support."""
    faces, uv = grid(QUADS, QUADS)
    rest = np.stack([SIDE * (uv[:, 0] - 0.5), SIDE * (0.5 - uv[:, 1]), 0.0 * uv[:, 0]], axis=1)
    held = np.linalg.norm(rest, axis=1) < 0.09
    return Stage(faces, SIDE * uv, rest, held, lambda _: rest, camera=(20.0, 28.0))


def hanging() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quads, material coordinates and rest positions of a square that hangs."""
    faces, uv = grid(QUADS, QUADS)
    return faces, SIDE * uv, SIDE * np.stack([uv[:, 0] - 0.5, 0.0 * uv[:, 0], -uv[:, 1]], axis=1)


def gathered() -> Stage:
    """A square whose upper side is gathered to 63%."""
    faces, flat, rest = hanging()

    def motion(time: float) -> np.ndarray:
        part = min(time / 0.5, 1.0)
        waves = 0.006 * part * np.sin(2.0 * np.pi * 4.5 * flat[:, 0] / SIDE)
        return rest * [1.0 - 0.37 * part, 1.0, 1.0] + np.stack([0 * waves, waves, 0 * waves], axis=1)

    return Stage(faces, flat, rest, flat[:, 1] == 0.0, motion)


def pinched() -> Stage:
    """A hanging square with two points that are brought together."""
    faces, flat, rest = hanging()
    points = [np.array([side * 0.04, 0.0, -0.5 * SIDE]) for side in (-1.0, 1.0)]
    found = [int(np.linalg.norm(rest - point, axis=1).argmin()) for point in points]
    held = flat[:, 1] == 0.0
    held[found] = True

    def motion(time: float) -> np.ndarray:
        moved = rest.copy()
        part = min(time / 0.5, 1.0)
        moved[found, 0] *= 1.0 - 0.625 * part
        moved[found, 1] -= 0.015 * part
        return moved

    return Stage(faces, flat, rest, held, motion)


TESTS: dict[str, Callable[[], Stage]] = {"draped": draped, "gathered": gathered, "pinched": pinched}


def swatch(task: tuple[str, str]) -> np.ndarray:
    """Positions in the last frame of a test of a preset [m], shape (V, 3)."""
    prepare_device("cpu")
    torch.set_num_threads(1)
    *_, last = simulated(TESTS[task[0]](), PRESETS[task[1]], 1, frames=FRAMES)
    return last


def waves(test: str, x: np.ndarray) -> int:
    """Waves of a swatch's hem, higher than `LEAST_WAVE`: around the draped square, along the others' lower side."""
    rest = level_at(garment_of(TESTS[test](), 1), 1).rest.double().numpy()
    rest = rest - 0.5 * (rest.min(axis=0) + rest.max(axis=0))
    is_draped = test == "draped"
    down, across = (1, 2) if is_draped else (2, 1)
    side = np.abs(rest[:, [0, down]]).max(axis=1) if is_draped else -rest[:, down]
    hem = np.flatnonzero(side > side.max() - 1e-4 * SIDE)
    order = np.arctan2(rest[hem, down], rest[hem, 0]) if is_draped else rest[hem, 0]
    height = x[hem[np.argsort(order)], across]
    peaks, _ = find_peaks(np.tile(height, 3 if is_draped else 1), prominence=LEAST_WAVE)
    return int(((peaks >= len(height)) & (peaks < 2 * len(height))).sum()) if is_draped else len(peaks)


def alike(a: Sequence[tuple[float, int]], b: Sequence[tuple[float, int]]) -> bool:
    """Whether two presets differ in no test by a tenth or more of the larger curvature or number of waves."""
    return all(
        abs(one - other) < 0.1 * max(one, other, 1e-9)
        for each in zip(a, b, strict=True)
        for one, other in zip(*each, strict=True)
    )


def paint(test: str, shapes: dict[str, np.ndarray], out: Path) -> None:
    """Draw a test of each preset from one camera."""
    stage = TESTS[test]()
    triangles = level_at(garment_of(stage, 1), 1).triangles.numpy()
    things = {name: Thing(upright(x), triangles) for name, x in shapes.items()}
    view, floor = framing(list(things.values()), PANEL, stage.camera)
    names = list(things)
    rows = [names[at : at + COLUMNS] for at in range(0, len(names), COLUMNS)]
    sheet = Image.new("RGB", (COLUMNS * PANEL[0], len(rows) * PANEL[1]), "white")
    for number, row in enumerate(rows):
        strip = drawn([(name, [things[name]]) for name in row], view, size=PANEL, floor=floor)
        sheet.paste(strip, (0, number * PANEL[1]))
    out.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(96, kmeans=2, dither=Image.Dither.NONE).save(out, optimize=True)


def paint_thumbnails(shapes: dict[str, np.ndarray], out: Path) -> None:
    """Draw each draped preset into a file of its own, from one camera."""
    stage, size = TESTS["draped"](), (SHARPER * THUMBNAIL[0], SHARPER * THUMBNAIL[1])
    triangles = level_at(garment_of(stage, 1), 1).triangles.numpy()
    things = {name: Thing(upright(x), triangles) for name, x in shapes.items()}
    view, floor = framing(list(things.values()), size, stage.camera)
    out.mkdir(parents=True, exist_ok=True)
    for name, thing in things.items():
        pixels = Image.fromarray(draw([thing.surface()], view, size=size, floor=floor))
        pixels.resize(THUMBNAIL, Image.Resampling.LANCZOS).save(out / f"{name}.webp", quality=QUALITY, method=6)


def main() -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("presets", nargs="*", default=list(PRESETS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--thumbnails", action="store_true")
    given = parser.parse_args()
    names, tests = given.presets, ["draped"] if given.thumbnails else [*TESTS]
    found: dict[str, dict[str, np.ndarray]] = {test: {} for test in tests}
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        tasks = [(test, name) for name in names for test in tests]
        for (test, name), shape in zip(tasks, pool.map(swatch, tasks), strict=True):
            found[test][name] = shape
    if given.thumbnails:
        return paint_thumbnails(found["draped"], given.out)
    say("| preset | " + " | ".join(f"{test}, m; waves" for test in TESTS) + " |\n|---|---|---|---|")
    judges = {test: Judge(level_at(garment_of(TESTS[test](), 1), 1), np.zeros((0, 2))) for test in TESTS}
    judged = {
        name: [(judges[test].curvature(x[name]), waves(test, x[name])) for test, x in found.items()] for name in names
    }
    for name, each in judged.items():
        say(f"| {name} | " + " | ".join(f"{curvature:.2f}; {count}" for curvature, count in each) + " |")
    pairs = [f"{a} and {b}" for a, b in combinations(names, 2) if alike(judged[a], judged[b])]
    say(f"\nPairs that differ by under a tenth in both: {', '.join(pairs) or 'none'}.")
    for test, shapes in found.items():
        paint(test, shapes, given.out / f"swatches_{test}.png")


if __name__ == "__main__":
    main()
