"""The page docs/notes/fidelity.md: its table, and films of cage, Loop subdivision, refined and simulated side by side.

    python -m benchmarks.fidelity_films docs/films --newton PYTHON [--short] [--saved FOLDER] [--kept FOLDER]

Prints the table of all scenes and fabrics (--short: in jersey alone, ten frames) and writes fidelity_NAME.webp, loops
at two thirds of the speed. With --saved, what `python -m benchmarks.fidelity --save FOLDER` put there is filmed and
nothing is simulated. Without --newton the scenes are left out that Newton simulates.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image, ImageDraw

from benchmarks.fidelity import FABRICS, NEWTON, OURS, RATE, Task, garment_of, level_at, say_rows
from benchmarks.fidelity_stages import SCENES, Body, Stage
from benchmarks.rows import say
from physgraph_usd.shot.page.drawing import Surface, View, draw, fit_view
from physgraph_usd.shot.page.preview import label

PANEL, QUALITY = (300, 340), 60
"""A side's size [pixels], and the pictures' quality."""
STRIDE, SPEED = 2, 8
"""Frames from one picture to the next, and pictures a second."""
CLOTH, BODY = (0.30, 0.42, 0.50), (0.55, 0.48, 0.42)
"""Colours."""
SIDES = {"cage": "Cage", "loop": "Loop subdivision", "refined": "Refined", "simulated": "Simulated finely"}
"""Titles by what is saved."""
SHOWN = ("curtain_newton_jersey", "elbow_newton_silk", "ball_newton_denim", "flag_newton_denim")


@dataclass(frozen=True, eq=False)
class Thing:
    """Something drawn.

    Attributes:
        points: Positions [m], Y up, shape (V, 3).
        triangles: Corners, shape (T, 3).
        cloth: Whether it is cloth, which the camera looks at; or a body.
    """

    points: np.ndarray
    triangles: np.ndarray
    cloth: bool = True

    def surface(self) -> Surface:
        """To be drawn."""
        color = CLOTH if self.cloth else BODY
        return Surface(self.points, self.triangles, np.tile(color, (len(self.triangles), 1)))


def upright(points: np.ndarray) -> np.ndarray:
    """Positions whose up was z, with y up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def drawn(
    panels: Sequence[tuple[str, Sequence[Thing]]], view: View, *, size: tuple[int, int], floor: float
) -> Image.Image:
    """Panels side by side from one camera."""
    sheet = Image.new("RGB", (len(panels) * size[0], size[1]))
    pen = ImageDraw.Draw(sheet)
    for place, (title, things) in enumerate(panels):
        pixels = draw([thing.surface() for thing in things], view, size=size, floor=floor)
        sheet.paste(Image.fromarray(pixels), (place * size[0], 0))
        label(pen, (place * size[0], 0), size[1], lines=[title])
    return sheet


def framing(things: Sequence[Thing], size: tuple[int, int], camera: tuple[float, float]) -> tuple[View, float]:
    """A camera that sees all cloth, and the floor's height [m]."""
    points = np.concatenate([thing.points for thing in things if thing.cloth])
    view = fit_view(points, size[0] / size[1], azimuth=camera[0], elevation=camera[1])
    return view, float(points[:, 1].min()) - 0.02


def still(
    panels: Sequence[tuple[str, Sequence[Thing]]], out: Path, *, camera: tuple[float, float], size=(400, 460)
) -> None:
    """Write panels as one picture."""
    view, floor = framing([thing for _, things in panels for thing in things], size, camera)
    sheet = drawn(panels, view, size=size, floor=floor)
    out.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(128, kmeans=2, dither=Image.Dither.NONE).save(out, optimize=True)
    say(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


def body_at(body: Body, time: float) -> Thing:
    """A body's surface at a time [s]."""
    if body.half:
        mesh = trimesh.creation.capsule(height=2.0 * body.half, radius=0.97 * body.radius)
    else:
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.99 * body.radius)
    pose, points = body.pose(time), np.asarray(mesh.vertices)
    points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))
    return Thing(upright(points @ pose.turn.T + pose.centre), np.asarray(mesh.faces, np.int32), cloth=False)


def triangles_of(stage: Stage, subdivisions: int) -> np.ndarray:
    """Corners of the sheet's triangles, shape (T, 3)."""
    return level_at(garment_of(stage, subdivisions), subdivisions).triangles.numpy()


def panels_at(
    stage: Stage, sides: dict[str, np.ndarray], frame: int, *, meshes: tuple[np.ndarray, np.ndarray]
) -> list[tuple[str, list[Thing]]]:
    """Panels of a frame; meshes are the triangles of the cage and of what is fine."""
    bodies = [body_at(body, (frame + 1) / RATE) for body in stage.bodies]
    return [
        (title, [Thing(upright(sides[name][frame]), meshes[name != "cage"]), *bodies]) for name, title in SIDES.items()
    ]


def film(saved: Path, out: Path) -> None:
    """Draw what was saved as a loop."""
    stage, sides = SCENES[saved.stem.split("_")[0]](), dict(np.load(saved))
    meshes = triangles_of(stage, 0), triangles_of(stage, 2)
    frames = [panels_at(stage, sides, frame, meshes=meshes) for frame in range(1, len(sides["cage"]), STRIDE)]
    view, floor = framing([each for panels in frames for _, things in panels for each in things], PANEL, stage.camera)
    first, *others = [drawn(panels, view, size=PANEL, floor=floor) for panels in frames]
    moving = {"save_all": True, "append_images": others, "duration": 1000 // SPEED, "loop": 0}
    out.parent.mkdir(parents=True, exist_ok=True)
    first.save(out, quality=QUALITY, method=4, **moving)
    say(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Print the table and write the films."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", help="Films to write, such as curtain_newton_jersey.")
    parser.add_argument("--newton", default="", metavar="PYTHON", help="A Python that has newton.")
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--saved", type=Path, help="Film what is in this folder.")
    parser.add_argument("--kept", type=Path, help="Folder of Newton's problems and results, which are used again.")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        saved = given.saved or Path(folder)
        if not given.saved:
            fabrics, frames = (FABRICS[:1], 10) if given.short else (FABRICS, 24)
            foreign = product(NEWTON if given.newton else (), fabrics)
            tasks = [Task(*each, frames, 2, given.newton, given.kept) for each in foreign]
            tasks += [Task(*each, frames, 2) for each in product(OURS, fabrics)]
            say_rows(tasks, jobs=given.jobs, save=saved)
        for name in given.names or SHOWN:
            if (saved / f"{name}.npz").exists():
                film(saved / f"{name}.npz", given.out / f"fidelity_{name}.webp")


if __name__ == "__main__":
    main()
