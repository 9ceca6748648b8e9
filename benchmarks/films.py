"""The films of docs/gallery.md: smooth subdivision of a sample's cage beside the refined cloth.

    python -m benchmarks.films docs/films [NAME...]

Refines some frames of a sample at level 2 and writes NAME.mp4, a loop, and NAME.jpg, one of its frames. Prints how
many frames did not settle, the median time a frame, and the edges through faces of cloth and of bodies in all frames of
both sides, counted by `benchmarks.crossing_count`. Takes the program ffmpeg with libx264. The dancer is also written as
an animated picture, for README.md.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.crossing_count import crossing_count
from benchmarks.rows import say
from benchmarks.shots import opened, problem_of
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.page.drawing import View, draw, fit_view
from physgraph_usd.shot.page.preview import label
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.usd.read.meshes import DrawnMesh, DrawnStage

LEVEL, PANEL, QUALITY = 2, (480, 540), "25"
"""Subdivisions, one side's size [pixels], and x264's rate factor."""
LOOP, QUADS = "Cage, Loop subdivision", "Cage, Catmull-Clark subdivision"
"""Titles of the left side: `solver/mesh/subdivide.py` has one rule of both, the pure one among one kind of face."""


@dataclass(frozen=True)
class Shown:
    """What of a sample is filmed.

    Attributes:
        frames: First and last time code.
        camera: Azimuth and elevation [degrees].
        still: Time code of the picture that stands for the film.
        title: Of the left side.
        rate: Frames a second; shots have 24.
    """

    frames: tuple[float, float]
    camera: tuple[float, float]
    still: float
    title: str = LOOP
    rate: int = 12


SHOWN = {
    "dancer": Shown((1.0, 60.0), (20.0, 7.0), 33.0, QUADS, 24),
    "tshirt": Shown((1.0, 36.0), (15.0, 8.0), 17.0, QUADS),
    "layers": Shown((1.0, 30.0), (30.0, 6.0), 20.0, QUADS),
    "sleeve": Shown((1.0, 24.0), (25.0, 10.0), 22.0),
    "skirt": Shown((1.0, 32.0), (25.0, 6.0), 24.0),
    "flag": Shown((1.0, 30.0), (25.0, 10.0), 24.0, QUADS),
    "block": Shown((1.0, 24.0), (40.0, 22.0), 16.0, QUADS),
}
"""The films by sample."""

README = "dancer"
"""The film that README.md shows: pages of repositories play animated pictures, no films."""

Side = list[DrawnMesh]


def main() -> None:
    """Film the samples."""
    prepare_device("cpu")
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or SHOWN:
        with tempfile.TemporaryDirectory() as folder:
            film(name, SHOWN[name], Path(folder), out / f"{name}.mp4")


def film(name: str, shown: Shown, folder: Path, out: Path) -> None:
    """Refine a sample, draw each frame of it, and print its figures."""
    shot, layer = write_sample(name, folder), folder / "refined.usdc"
    report = refine_shot(shot, layer, RefineOptions(frames=shown.frames, level=LEVEL))
    garments = [each["path"] for each in report.garments]
    fine = DrawnStage(shot, layer)
    times = fine.times(tuple(garments))
    fine.bake(times)
    refined = (fine.meshes(time, cages=garments) for time in times)
    sides = list(zip(times, smooth(name, fine, times, garments), refined, strict=True))
    columns = ([left for _, left, _ in sides], [right for _, _, right in sides])
    counts = [sum(crossings(side, garments) for side in column) for column in columns]
    seconds = statistics.median(sum(each["garments"][0]["milliseconds"].values()) for each in report.frames) / 1e3
    said = f"{len(times)} frames, {len(report.unsettled)} not settled, {seconds:.2f} s a frame"
    say(f"{name}: {said}, crossings {counts[0]:,} -> {counts[1]:,}")
    drawn = {time: Image.fromarray(pixels) for time, pixels in pictures(sides, shown)}
    drawn[shown.still].save(out.with_suffix(".jpg"), quality=85)
    encode(list(drawn.values()), out, rate=shown.rate)
    if name == README:
        first, *others = drawn.values()
        moving = {"save_all": True, "append_images": others, "duration": 1000 // shown.rate, "loop": 0}
        first.save(out.with_suffix(".webp"), quality=55, method=3, **moving)


def smooth(name: str, fine: DrawnStage, times: Sequence[float], garments: Sequence[str]) -> Iterator[Side]:
    """The fine meshes at the places that Loop's rules give them, one side a time."""
    shot = opened(name, LEVEL)
    problem = problem_of(shot)
    for time in times:
        places = problem.upsampled(shot.frame(time), smooth=True)
        points = {garment.path: each for garment, each in zip(shot.scene.garments, places, strict=True)}
        yield [replace(mesh, points=points.get(mesh.path, mesh.points)) for mesh in fine.meshes(time, cages=garments)]


def crossings(side: Side, garments: Sequence[str]) -> int:
    """Edges through faces where one of the two is of a garment."""
    cloth = [mesh for mesh in side if mesh.path in garments]
    total = sum(crossing_count(mesh.points, edges_of(mesh), mesh.triangles) for mesh in cloth)
    for body in (mesh for mesh in side if mesh.path not in garments):
        for mesh in cloth:
            points, shift = np.concatenate([mesh.points, body.points]), len(mesh.points)
            total += crossing_count(points, edges_of(mesh), body.triangles + shift)
            total += crossing_count(points, edges_of(body) + shift, mesh.triangles)
    return total


def edges_of(mesh: DrawnMesh) -> np.ndarray:
    """The mesh's edges, each once, shape (E, 2)."""
    corners = mesh.triangles
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def pictures(sides: Sequence[tuple[float, Side, Side]], shown: Shown) -> Iterator[tuple[float, np.ndarray]]:
    """The pixels at each time, both sides from one camera."""
    points = np.concatenate([mesh.points for _, _, side in sides for mesh in side])
    view: View = fit_view(points, PANEL[0] / PANEL[1], azimuth=shown.camera[0], elevation=shown.camera[1])
    floor = float(points[:, 1].min()) - 0.02
    for time, *both in sides:
        sheet = Image.new("RGB", (2 * PANEL[0], PANEL[1]))
        pen = ImageDraw.Draw(sheet)
        for place, (title, side) in enumerate(zip((shown.title, "Refined"), both, strict=True)):
            pixels = draw(side, view, size=PANEL, floor=floor)
            sheet.paste(Image.fromarray(pixels), (place * PANEL[0], 0))
            label(pen, (place * PANEL[0], 0), PANEL[1], lines=[title])
        yield time, np.asarray(sheet)


def encode(frames: Sequence[Image.Image], out: Path, *, rate: int) -> None:
    """Write an H.264 film that every browser plays."""
    program = shutil.which("ffmpeg")
    if program is None:
        sys.exit("no ffmpeg on the path: it writes the films")
    width, height = frames[0].size
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate}", "-i", "-"]
    wanted = ["-c:v", "libx264", "-preset", "slow", "-crf", QUALITY, "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    pixels = b"".join(frame.tobytes() for frame in frames)
    subprocess.run([program, "-loglevel", "error", "-y", *given, *wanted, str(out)], input=pixels, check=True)


if __name__ == "__main__":
    main()
