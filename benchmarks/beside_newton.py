"""Speed against accuracy with bodies: refined cloth beside subdivision and Newton's Style3D and VBD.

    python -m benchmarks.beside_newton --newton PYTHON [--shot FILE GARMENT BODY] [--scene NAME]... [--method NAME]...
    python -m benchmarks.beside_newton [--rows FILE]...

The first measures, on the card and on a core, adds rows to ``--rows`` and writes page and picture; the second writes
them anew from rows that are there. Scenes and fabric are those of `benchmarks.fidelity` that touch bodies or fold over
themselves, and a shot's garment on its body, cut below its waistband and held there. The cage that is refined is
simulated by Style3D, at the cage's resolution, as it is there.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import time as clock
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed, wait
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.crossing_count import crossing_count
from benchmarks.fidelity import RATE, Judge, garment_of, level_at, newton_result, problem_of, timed
from benchmarks.fidelity_stages import SCENES, Body, Stage, dressed
from benchmarks.rows import commit, say, table
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.level import Level, build_levels, refine_garments

CHOSEN = ("curtain", "ball", "elbow", "body")
"""Scenes: gathered cloth without a body, cloth over a ball, a sleeve on an arm that bends, and a
shot's garment on its body."""
FABRIC = "jersey"
APART = 0.25
"""Contact distance of cloth in Newton's solvers, relative to the mesh's spacing."""
WARM, COUNTED = 2, 4
"""Untimed frames at the start; stride of the frames in which crossings are counted."""
ROWS, PAGE = Path("benchmarks/results/newton.json"), Path("benchmarks/results/newton.md")
PICTURE = Path("docs/pictures/chart_bodies.webp")
TEXT = """# Speed against accuracy with bodies

Written by `python -m benchmarks.beside_newton --newton PYTHON`; fabric {fabric}, {frames} frames at 24 a second, Newton
{newton}, ours at commit {commit}. Newton's solvers simulate the fine sheet, self-contact on, their steps recorded as
graphs on the card; `refined` refines a cage of the same sheet that Style3D simulates (40 steps, 4 iterations of 40;
with fewer steps than the reference, which damp more, it lacks folds). So they answer unlike questions: theirs has a
history, ours and subdivision have the cage's. The reference is Style3D with {reference}: what is Style3D's own comes
near it by construction. One level coarser: so solved, then subdivided by Loop. XPBD is not here: with steps short
enough for it, 640 a frame, no sheet was done in 150 s. Nor is Blender's cloth, whose energy is another; see
docs/chart.md.

- **Settings**: steps of ours at the finest level, 12 by default, the tolerance in inverse proportion; of Newton, steps
  of a frame x iterations (x conjugate gradients).
- **Warm frame**: median after the first two; the cage's simulation is not in it
  ({cages}). On a core: one thread, rows run beside each other.
- **Away**: over the bands of wavelengths of [fidelity.md](fidelity.md) the mean factor between the RMS of the mean
  curvature and the reference's, larger or smaller, less one; last half of the frames. **Curvature**: total absolute
  mean curvature over the reference's.
- **Stretch**: 99th percentile over edges of their length over the rest length, less one; largest over frames.
- **Cloth through cloth**: edges that pass through triangles, sum over every fourth frame. **In bodies**: vertices, sum
  over frames.
- **Body**: cut below its waistband, which is turned in and begins folded flat onto itself: uncut, the reference tangled
  there, and a simulation had 57 to 94% of each band's square in those 3% of the cloth.
- **Front**: none on that device is both faster and nearer.

![Distance from the fine simulation against time]({picture})
"""
HEAD = ("scene", "vertices", "on", "method", "warm frame, ms", "away, %", "curvature", "stretch, %")
HEAD += ("cloth through cloth", "in bodies", "front")


@dataclass(frozen=True)
class Method:
    """A method and its settings.

    Attributes:
        name: Of what solves.
        steps: Of ours at the finest level, or of Newton in a frame, which are even.
        iterations: Newton's in a step, and of the conjugate gradients in each.
        below: Levels by which its mesh is coarser; the result is subdivided by Loop.
        core: Whether it is measured on a core too.
    """

    name: str
    steps: int = 0
    iterations: tuple[int, int] = (0, 0)
    below: int = 0
    core: bool = False

    @property
    def settings(self) -> str:
        """In a few words."""
        numbers = [str(each) for each in (self.steps, *self.iterations) if each]
        return ", ".join([*filter(None, [" x ".join(numbers)]), *["one level coarser"] * self.below])


CAGE, REFERENCE = Method("cage", 40, (4, 40)), Method("reference", 40, (8, 80))
"""Of as many steps in a frame: implicit steps damp folds the more the longer they are."""
METHODS = (
    Method("style3d", 10, (4, 10), core=True),
    Method("vbd", 10, (10, 0), core=True),
    Method("loop", core=True),
    *(Method("refined", steps, core=True) for steps in (4, 12, 48)),
    Method("refined", 12, below=1, core=True),
    *(Method("style3d", *each) for each in ((4, (2, 10)), (10, (4, 40)), (20, (4, 40)))),
    Method("style3d", 10, (4, 10), below=1),
    *(Method("vbd", *each) for each in ((4, (10, 0)), (10, (40, 0)), (20, (80, 0)))),
)
"""Newton's own examples have 10 steps a frame, of VBD with 4 iterations, of Style3D with 4 of 10."""


@wp.kernel
def inward(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), found: wp.array(dtype=wp.bool)):  # pyright: ignore
    """Which points are inside a closed mesh, by the winding number."""
    near = wp.mesh_query_point_sign_winding_number(mesh, points[wp.tid()], 1e6)
    found[wp.tid()] = near.result and near.sign < 0.0  # pyright: ignore[reportAttributeAccessIssue]


@dataclass(frozen=True)
class Task:
    """A row that is to be made.

    Attributes:
        scene: Name of the scene.
        subdivisions: Subdivisions of the fine mesh.
        method: Method that is measured.
        device: "cuda" or "cpu".
        frames: Number of frames.
        python: Path of a Python with Newton.
        folder: Folder of the cages' positions and of the file "lock", which rows on a card hold in turns.
        shot: File, garment and body of the scene "body"; empty for other scenes.
    """

    scene: str
    subdivisions: int
    method: Method
    device: str
    frames: int
    python: str
    folder: Path
    shot: tuple[str, ...] = ()

    @cached_property
    def stage(self) -> Stage:
        """The scene."""
        return dressed(*self.shot) if self.scene == "body" else SCENES[self.scene]()

    def level(self, subdivisions: int) -> Level:
        """The sheet at a number of subdivisions."""
        return level_at(garment_of(self.stage, subdivisions), subdivisions)

    def newton(self, solver: str, subdivisions: int, method: Method) -> dict[str, np.ndarray]:
        """What one of Newton's solvers makes of the sheet: frames, milliseconds and its version."""
        problem = problem_of(self.stage, PRESETS[FABRIC], subdivisions, frames=self.frames, substeps=method.steps)
        problem["iterations"] = np.array(method.iterations)
        if method is not CAGE:
            problem["apart"] = np.array(APART * float(self.level(subdivisions).spacing.min()))
        name = f"{self.scene} {method.name} {method.settings} {subdivisions} {'' if method is CAGE else self.device}"
        card = ("--lock", str(self.folder / "lock")) if self.device != "cpu" else ()
        options = ("--solver", solver, "--device", self.device, *card)
        return newton_result(self.python, problem, self.folder / f"{name}.npz", *options)

    def cage(self) -> dict[str, np.ndarray]:
        """The simulation that is refined."""
        return self.newton("style3d", 0, CAGE)

    def ours(self, subdivisions: int) -> Iterator[tuple[np.ndarray, float]]:
        """Positions of each frame [m] by subdivision or refined, shape (V, 3), and milliseconds of each."""
        cages = [*self.cage()["frames"].astype(float)]
        if self.method.name == "refined":
            settings: dict[str, Any] = {"touches": True, "device": self.device, "steps": self.method.steps}
            settings["tolerance"] = SolveSettings.tolerance * SolveSettings.steps / self.method.steps
            yield from timed(self.stage, PRESETS[FABRIC], cages, subdivisions, **settings)
            return
        garment = garment_of(self.stage, subdivisions)
        loop = build_levels([garment], refine_garments([garment], [subdivisions]), device=self.device)[-1].smooth_base
        for cage in cages:
            began = clock.perf_counter()
            x = loop.apply(torch.as_tensor(cage, dtype=torch.float32, device=self.device)).double().cpu().numpy()
            yield x, 1e3 * (clock.perf_counter() - began)

    def measured(self) -> tuple[np.ndarray, np.ndarray, str]:
        """Positions of each frame on the fine mesh [m], shape (F, V, 3), milliseconds of each, and Newton's version."""
        name, subdivisions = self.method.name, self.subdivisions - self.method.below
        if name in {"loop", "refined"}:
            self.cage()
            with (self.folder / "lock").open("rb") as lock:
                if self.device != "cpu":
                    fcntl.flock(lock, fcntl.LOCK_EX)
                found, spent = zip(*self.ours(subdivisions), strict=True)
            x, version = np.array(found), ""
        else:
            solver = "style3d" if name == "reference" else name
            results = self.newton(solver, subdivisions, self.method)
            x, spent, version = results["frames"].astype(float), results["milliseconds"], str(results["newton"])
        for finer in range(subdivisions + 1, self.subdivisions + 1):
            up = self.level(finer).smooth_from_below
            assert up is not None  # Only the cage has none.
            x = np.array([up.apply(torch.as_tensor(each, dtype=torch.float32)).double().numpy() for each in x])
        return x, np.array(spent), version


def stretch(level: Level, x: np.ndarray) -> float:
    """99th percentile of the edges' strain [%]."""
    first, second = level.springs.numpy().T
    rest = np.linalg.norm(level.rest.double().numpy()[first] - level.rest.double().numpy()[second], axis=1)
    return float(100.0 * (np.percentile(np.linalg.norm(x[first] - x[second], axis=1) / rest, 99.0) - 1.0))


def inside(stage: Stage, x: np.ndarray, time: float) -> int:
    """Vertices inside bodies at a time [s]."""
    deep = np.zeros(len(x), dtype=bool)
    for body in stage.bodies:
        if isinstance(body, Body):
            middle, turn = body.place(time)
            local = (x - middle) @ turn
            along = local[:, 2] - np.clip(local[:, 2], -body.half, body.half)
            deep |= np.linalg.norm(np.column_stack([local[:, :2], along]), axis=1) < body.radius
        else:
            points, corners = wp.array(body.points(time), dtype=wp.vec3), wp.array(body.triangles.ravel(), dtype=int)
            mesh, found = wp.Mesh(points, corners, support_winding_number=True), wp.zeros(len(x), dtype=wp.bool)
            wp.launch(inward, len(x), inputs=[mesh.id, wp.array(x, dtype=wp.vec3), found])
            deep |= found.numpy()
    return int(deep.sum())


Row = dict[str, Any]
"""A row's names and figures, as they stand in JSON."""


def made(task: Task) -> Row:
    """Measure and judge."""
    task = replace(task, device=prepare_device(task.device))
    x, spent, version = task.measured()
    level, late = task.level(task.subdivisions), task.frames // 2
    edges, triangles = level.springs.numpy(), level.triangles.numpy()
    row = {
        "scene": task.scene,
        "vertices": level.vertex_count,
        "on": "one core" if task.device == "cpu" else wp.get_device(task.device).name,
        "method": task.method.name,
        "settings": task.method.settings,
        "frames": task.frames,
        "newton": version,
        "commit": commit("benchmarks"),
        "ms": float(np.median(spent[WARM:])),
        "cage ms": float(np.median(task.cage()["milliseconds"][WARM:])),
        "stretch": float(np.max([stretch(level, each) for each in x])),
    }
    judge = Judge(level, level.from_coarse @ task.stage.flat)
    with wp.ScopedDevice("cpu"):
        deep = sum(inside(task.stage, each, (n + 1) / RATE) for n, each in enumerate(x))
    return row | {
        "bands": np.mean([judge.amplitudes(judge.bending(each)) for each in x[late:]], axis=0).tolist(),
        "curvature": float(np.mean([judge.curvature(each) for each in x[late:]])),
        "crossings": sum(crossing_count(each, edges, triangles) for each in x[COUNTED - 1 :: COUNTED]),
        "inside": deep,
    }


def key(row: Row) -> tuple[Any, ...]:
    """What tells a row from others."""
    return tuple(row[name] for name in ("scene", "vertices", "on", "method", "settings"))


def measure(tasks: Sequence[Task], file: Path, jobs: int) -> None:
    """Make rows, many at once but one at a time on the card, and add each to a file; one that fails is left out."""
    rows = {key(row): row for row in read([file])}
    context = get_context("spawn")
    with ProcessPoolExecutor(jobs, context) as card, ProcessPoolExecutor(jobs, context) as core:
        wait([card.submit(task.cage) for task in {task.scene: task for task in tasks[::-1]}.values()])
        begun = {(core if task.device == "cpu" else card).submit(made, task): task for task in tasks}
        for done in as_completed(begun):
            task = begun[done]
            if problem := done.exception():
                say(f"{task.scene}, {task.method.name} {task.method.settings}, {task.device}: {problem}")
                continue
            row = done.result()
            rows[key(row)] = row
            file.write_text(json.dumps([*rows.values()], indent=1) + "\n", encoding="utf-8")
            say(" ".join(f"{row[name]}" for name in ("scene", "on", "method", "settings", "ms", "crossings", "inside")))


def read(files: Sequence[Path]) -> list[Row]:
    """The rows of files that are there."""
    return [row for file in files if file.exists() for row in json.loads(file.read_text(encoding="utf-8"))]


Marks = dict[tuple[Any, ...], list[Row]]
"""The rows of each scene, number of vertices and device, by time."""


def marked(rows: Sequence[Row]) -> Marks:
    """The rows beside their references: "away", curvature as a ratio, "front", and the reference's stretch."""
    truth = {key(row)[:2]: row for row in rows if row["method"] == "reference"}
    found: Marks = {}
    for row in sorted(rows, key=lambda row: (CHOSEN.index(row["scene"]), *key(row)[1:3], row["ms"])):
        fine = truth.get(key(row)[:2], row)
        if row is fine:
            continue
        ratio = np.divide(row["bands"], fine["bands"])
        away = 100.0 * float(np.expm1(np.abs(np.log(ratio)).mean()))
        faster = found.setdefault(key(row)[:3], [])
        front = away < min((each["away"] for each in faster if each["front"]), default=np.inf)
        faster.append(
            row
            | {"away": away, "front": front, "fine stretch": fine["stretch"]}
            | {"curvature": row["curvature"] / fine["curvature"]}
        )
    return found


def cells(row: Row) -> list[str]:
    """A row of the page's table."""
    name = ", ".join(filter(None, [row["method"], row["settings"]]))
    said = [row["scene"], f"{row['vertices']:,}", row["on"], name, f"{float(format(row['ms'], '.3g')):,g}"]
    said += [f"{row['away']:.1f}", f"{row['curvature']:.2f}", f"{row['stretch']:.1f}"]
    return [*said, f"{row['crossings']:,}", f"{row['inside']:,}", "yes" * row["front"]]


BESIDE = """x: cloth through cloth, then vertices in bodies; stretch where it is over twice the fine simulation's
hollow: solved one level coarser, then subdivided by Loop"""
COLOURS = {"loop": "#7f7f7f", "refined": "#d62728", "style3d": "#1f77b4", "vbd": "#2ca02c"}


def draw(marks: Marks, out: Path) -> None:
    """Distance against time, a row a scene, a column a device."""
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.ticker import LogLocator, NullLocator  # noqa: PLC0415

    scenes = {scene: min(count for name, count, _ in marks if name == scene) for scene, _, _ in marks}
    devices = sorted({device for _, _, device in marks}, key=lambda device: device == "one core")
    with mpl.rc_context({"font.size": 8.0, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(5.5 * len(devices), 3.1 * len(scenes)), layout="constrained")
        panels = figure.subplots(len(scenes), len(devices), squeeze=False, sharey="row", sharex=True)
        for ((scene, count), device), axes in zip(product(scenes.items(), devices), panels.flat, strict=True):
            axes.set(title=f"{scene}, {count:,} vertices, {device}", xscale="log", yscale="log")
            axes.set(xlabel="warm frame, ms", ylabel="away from the fine simulation, %")
            axes.margins(x=0.12, y=0.12)
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_locator(NullLocator())
                axis.set_major_formatter("{x:g}")
            axes.grid(color="#e4e4e4", linewidth=0.6)
            some = marks.get((scene, count, device), [])
            for method, coarse in product(COLOURS, (False, True)):
                curve(
                    axes, [r for r in some if r["method"] == method and ("coarser" in r["settings"]) == coarse], coarse
                )
        keys = [Line2D([], [], color=colour, marker="o") for colour in COLOURS.values()]
        figure.legend(keys, COLOURS, loc="outside lower center", ncols=len(keys), frameon=False)
        figure.suptitle(BESIDE, fontsize=9.0)
        figure.savefig(out, dpi=120, pil_kwargs={"quality": 80, "method": 6})


def curve(axes: Any, rows: Sequence[Row], coarse: bool) -> None:
    """Marks of a method with their words, and a line through them."""
    for number, row in enumerate(rows):
        crossed, place, colour = (
            bool(row["crossings"] or row["inside"]),
            (row["ms"], row["away"]),
            COLOURS[row["method"]],
        )
        words = row["settings"].partition(",")[0].replace(" ", "")
        words += f" x {row['crossings']:,}, {row['inside']:,}" if crossed else ""
        words += f" {row['stretch']:.0f}%" if row["stretch"] > 2.0 * row["fine stretch"] else ""
        beside = (4, 4) if number % 2 == 0 else (4, -8)
        axes.annotate(words, place, beside, textcoords="offset points", fontsize=6.5, color=colour)
        style = {"marker": "X" if crossed else "o", "markersize": 6, "fillstyle": "none" if coarse else "full"}
        axes.plot(*place, color=colour, **style)
    if rows:
        axes.plot([r["ms"] for r in rows], [r["away"] for r in rows], color=COLOURS[rows[0]["method"]], linewidth=1.0)


def write(rows: Sequence[Row], page: Path, picture: Path) -> None:
    """Write the page and the picture."""
    marks, cages = marked(rows), {row["scene"]: f"{row['scene']} {row['cage ms']:.0f} ms" for row in rows}
    if not marks:
        say("no scene has its reference yet: no page is written")
        return
    draw(marks, picture)
    newton = max(row["newton"] for row in rows)
    place = os.path.relpath(picture, page.parent)
    text = TEXT.format(
        fabric=FABRIC,
        frames=rows[0]["frames"],
        newton=newton,
        commit=", ".join(sorted({row["commit"] for row in rows})),
        reference=REFERENCE.settings,
        cages=", ".join(cages.values()),
        picture=place,
    )
    lines = [cells(row) for some in marks.values() for row in some]
    page.write_text("\n".join([text, table(HEAD, lines)]) + "\n", encoding="utf-8")


def tasks_of(given: argparse.Namespace, folder: Path) -> Iterator[Task]:
    """The rows that are asked for: those on the first device first, which has all methods and the references."""
    scenes = CHOSEN if given.shot else CHOSEN[:-1]
    devices = given.device or ["cuda", "cpu"]
    for device, level, scene in product(devices, given.level or [2], given.scene or scenes):
        for method in (REFERENCE, *METHODS):
            asked = not given.method or method.name in given.method
            if asked and (method.core or device == devices[0]):
                yield Task(scene, level, method, device, given.frames, given.newton, folder, tuple(given.shot))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the page and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=PAGE)
    parser.add_argument("--picture", type=Path, default=PICTURE)
    parser.add_argument("--rows", type=Path, action="append", help="Of the first, those that are measured are added.")
    parser.add_argument("--newton", metavar="PYTHON", help="A Python that has newton; nothing is measured without.")
    parser.add_argument("--device", action="append", help="May be repeated; else cuda and cpu.")
    parser.add_argument("--level", type=int, action="append", help="Subdivisions, 2; may be repeated.")
    parser.add_argument("--shot", nargs=3, metavar=("FILE", "GARMENT", "BODY"), default=())
    parser.add_argument("--scene", action="append", help="May be repeated; else all.")
    parser.add_argument("--method", action="append", choices=[*COLOURS, "reference"], help="May be repeated; else all.")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--jobs", type=int, default=2, help="Processes on the card, which wait for it, and on cores.")
    given = parser.parse_args(arguments)
    files = given.rows or [ROWS]
    if given.newton:
        with TemporaryDirectory() as folder:
            (Path(folder) / "lock").touch()
            measure([*tasks_of(given, Path(folder))], files[0], given.jobs)
    write(read(files), given.out, given.picture)


if __name__ == "__main__":
    main()
