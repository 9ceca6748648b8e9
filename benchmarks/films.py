"""The films of docs/gallery.md: smooth subdivision of a shot's cage beside the refined cloth.

    python -m benchmarks.films docs/films [NAME...] [--folder SHOTS]

Refines some frames of a sample, or of a real shot below the folder, at level 2 and writes NAME.mp4, a loop, NAME.jpg,
the frame with the most folds that its cage lacks, and for README.md NAME.webp, an animated picture. `Figures` go into
figures.json, which `python -m docs.tables` shows in the gallery. Takes the program ffmpeg with libx264.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import click
import numpy as np
from PIL import Image, ImageDraw

from benchmarks.crossing_count import crossing_count
from benchmarks.rows import say
from benchmarks.shots import problem_of
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.page.drawing import View, draw, fit_view
from physgraph_usd.shot.page.preview import label
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.usd.read.meshes import DrawnMesh, DrawnStage
from physgraph_usd.usd.read.reader import open_shot

LEVEL, PANEL, QUALITY = 2, (480, 540), "25"
"""Subdivisions, one side's size [pixels], and x264's rate factor."""
LOOP, QUADS = "Cage, Loop subdivision", "Cage, Catmull-Clark subdivision"
"""Titles of the left side: `solver/mesh/subdivide.py` has one rule of both, the pure one among one kind of face."""


@dataclass(frozen=True)
class Shown:
    """What of a shot is filmed.

    Attributes:
        caption: What the gallery says of it.
        frames: First and last time code.
        camera: Azimuth and elevation [degrees].
        title: Of the left side.
        rate: Frames a second; shots have 24.
        source: Path of a real shot below the folder; "" for the sample of the film's name.
        garments: Prim paths of the garments; () for all that are tagged.
        bodies: Prim paths of the bodies, likewise.
        presets: Values, as `--set` takes them.
        near: Heights between which the picture is filled, as fractions of the whole's; None for the whole.
    """

    caption: str
    frames: tuple[float, float]
    camera: tuple[float, float]
    title: str = LOOP
    rate: int = 12
    source: str = ""
    garments: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    presets: tuple[str, ...] = ()
    near: tuple[float, float] | None = None


WALK = Shown(
    "Trousers, shirt and belt on a walk",
    (1001.0, 1036.0),
    (35.0, 6.0),
    QUADS,
    source="20_trousers_belt_shirt_walk_cm.usdc",
    garments=("/char/cloth/shirt", "/char/cloth/trousers", "/char/cloth/belt"),
    bodies=("/char/skin/body",),
    presets=tuple(
        f"/char/cloth/{each}" for each in ("shirt.preset=cotton", "trousers.preset=denim", "belt.preset=leather")
    ),
)
SHOWN = {
    "walk": WALK,
    "walk_near": replace(WALK, caption="The same walk, near", camera=(15.0, 4.0), near=(0.42, 0.72)),
    "coat": Shown(
        "An open wool coat",
        (1001.0, 1040.0),
        (30.0, 6.0),
        QUADS,
        source="21_open_coat_skinned.usdc",
        garments=("/shot/hero/geo/coat",),
        bodies=("/shot/hero/geo/body",),
        presets=("preset=wool",),
    ),
    "dancer": Shown("A dancer in a cotton dress", (1.0, 60.0), (20.0, 7.0), QUADS, 24),
    "tshirt": Shown("A T-shirt", (1.0, 36.0), (15.0, 8.0), QUADS),
    "layers": Shown("Trousers, shirt and belt", (1.0, 30.0), (30.0, 6.0), QUADS),
    "sleeve": Shown("A sleeve, pushed together and twisted", (1.0, 24.0), (25.0, 10.0)),
    "skirt": Shown("A skirt on turning hips", (1.0, 32.0), (25.0, 6.0)),
    "flag": Shown("A flag in the wind", (1.0, 30.0), (25.0, 10.0), QUADS),
    "block": Shown("A sheet dropped over a block", (1.0, 24.0), (40.0, 22.0), QUADS),
}
"""The films by name."""

README = ("walk", "dancer")
"""The films that README.md shows: pages of repositories play animated pictures, no films."""

Side = list[DrawnMesh]


@dataclass(frozen=True)
class Figures:
    """What figures.json says of a film.

    Attributes:
        frames: Number of frames.
        unsettled: Number of frames that did not settle.
        cage: Number of vertices of the garments in the shot.
        fine: Number of vertices of either side.
        seconds: Processor time a frame [s], with reading, writing and the first frame.
        crossings: Edges through faces of cloth and of bodies in all frames, subdivided and refined, counted by
            `benchmarks.crossing_count`.
    """

    frames: int
    unsettled: int
    cage: int
    fine: int
    seconds: float
    crossings: tuple[int, int]


@click.command()
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.argument("names", nargs=-1, type=click.Choice(list(SHOWN)))
@click.option("--folder", type=click.Path(exists=True, file_okay=False, path_type=Path), help="Real shots.")
def main(out: Path, names: Sequence[str], folder: Path | None) -> None:
    """Film the shots; without the folder, samples alone."""
    prepare_device("cpu")
    out.mkdir(parents=True, exist_ok=True)
    for name in names or SHOWN:
        shown = SHOWN[name]
        if shown.source and folder is None:
            say(f"{name} is left out: it is a real shot; give --folder")
            continue
        with tempfile.TemporaryDirectory() as place:
            shot = (folder or Path()) / shown.source if shown.source else write_sample(name, Path(place))
            film(shot, shown, Path(place) / "refined.usdc", out / f"{name}.mp4")


def film(shot: Path, shown: Shown, layer: Path, out: Path) -> None:
    """Refine a shot into a layer, draw each of its frames, and record its figures."""
    options = RefineOptions(
        frames=shown.frames,
        level=LEVEL,
        garments=shown.garments,
        colliders=shown.bodies,
        overrides=shown.presets,
    )
    start = time.process_time()
    report = refine_shot(shot, layer, options)
    spent = time.process_time() - start
    garments = [each["path"] for each in report.garments]
    fine = DrawnStage(shot, layer)
    times = fine.times(tuple(garments))
    fine.bake(times)
    subdivided = list(smooth(shot, fine, times, garments))
    refined = (fine.meshes(each, cages=garments) for each in times)
    before, after = (sum(crossings(side, garments) for side in column) for column in (subdivided, refined))
    surfaces = [fine.meshes(each, cages=()) for each in times]
    sides = list(zip(times, map(finer, subdivided, surfaces), surfaces, strict=True))
    cage, vertices = (sum(each[kind] for each in report.garments) for kind in ("points", "fine_points"))
    seconds = round(spent / len(times), 2)
    unsettled = len({entry["time"] for entry in report.unsettled})
    record(out, Figures(len(times), unsettled, cage, vertices, seconds, (before, after)))
    drawn = [Image.fromarray(pixels) for pixels in pictures(sides, shown)]
    max(drawn, key=added_folds).save(out.with_suffix(".jpg"), quality=85)
    encode(drawn, out, rate=shown.rate)
    if out.stem in README:
        moving = {"save_all": True, "append_images": drawn[1:], "duration": 1000 // shown.rate, "loop": 0}
        drawn[0].save(out.with_suffix(".webp"), quality=55, method=3, **moving)


def record(out: Path, figures: Figures) -> None:
    """Print a film's figures and put them into figures.json."""
    say(f"{out.stem}: {figures}")
    file = out.with_name("figures.json")
    kept = json.loads(file.read_text("utf-8")) if file.exists() else {}
    lines = (f'"{name}": {json.dumps(each)}' for name, each in sorted({**kept, out.stem: asdict(figures)}.items()))
    file.write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")


def added_folds(sheet: Image.Image) -> float:
    """How much more the shading varies on the right of a picture than on the left: the pixels' steps, summed."""
    pixels = np.asarray(sheet).astype(float)
    left, right = (np.abs(np.diff(side, axis=0)).sum() for side in np.split(pixels, 2, axis=1))
    return float(right - left)


def smooth(shot: Path, fine: DrawnStage, times: Sequence[float], garments: Sequence[str]) -> Iterator[Side]:
    """The fine meshes at the places that the rules of subdivision give them, one side a time."""
    coarse = open_shot(str(shot), level=LEVEL, garments=garments)
    problem = problem_of(coarse)
    for each in times:
        places = problem.upsampled(coarse.frame(each), smooth=True)
        points = {garment.path: found for garment, found in zip(coarse.scene.garments, places, strict=True)}
        yield [replace(mesh, points=points.get(mesh.path, mesh.points)) for mesh in fine.meshes(each, cages=garments)]


def finer(side: Side, like: Side) -> Side:
    """The meshes of a side subdivided smoothly to as many faces as other meshes have."""
    return [mesh.subdivided(other.mesh.face_count) for mesh, other in zip(side, like, strict=True)]


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


def pictures(sides: Sequence[tuple[float, Side, Side]], shown: Shown) -> Iterator[np.ndarray]:
    """The pixels of each frame, both sides from one camera."""
    points = np.concatenate([mesh.points for _, _, side in sides for mesh in side])
    floor = float(points[:, 1].min()) - 0.02
    if shown.near is not None:
        low, high = floor + np.array(shown.near) * np.ptp(points[:, 1])
        points = points[(points[:, 1] > low) & (points[:, 1] < high)]
    view: View = fit_view(points, PANEL[0] / PANEL[1], azimuth=shown.camera[0], elevation=shown.camera[1])
    for _, *both in sides:
        sheet = Image.new("RGB", (2 * PANEL[0], PANEL[1]))
        pen = ImageDraw.Draw(sheet)
        for place, (title, side) in enumerate(zip((shown.title, "Refined"), both, strict=True)):
            pixels = draw(side, view, size=PANEL, floor=floor)
            sheet.paste(Image.fromarray(pixels), (place * PANEL[0], 0))
            label(pen, (place * PANEL[0], 0), PANEL[1], lines=[title])
        yield np.asarray(sheet)


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
