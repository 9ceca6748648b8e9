"""One shot, rippled and refined once: the figures that `benchmarks.versions` and `benchmarks.numbers` compare.

    PYTHONPATH=TREE python benchmarks/judge_shot.py JOB.json FIGURES.json

Runs against the package of any checkout TREE, so this file imports that package, numpy and pxr only. What is seen of a
shape is measured by `physgraph_usd/solver/seen.py` of the judge's own checkout, for all versions alike. A job names the
shot, its garments and colliders, the first frame and number of frames, the level, the device and the ripple; and how
many of the last frames are solved on until nothing moves, to measure how far from rest the frames end.

A ripple is a layer over the shot. In the ripple layer each vertex of a garment is moved by a fraction of the garment's
mean edge, in a random direction that is the same in every sample. No user could see a ripple, so figures that differ
between ripples are noise.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import ShotSolver, open_for
from physgraph_usd.solver.frame import solve as frame_solve
from physgraph_usd.solver.mesh.subdivide import smooth, subdivide_times

RIPPLES = (0.15, 0.20, 0.25)
"""Sizes of the ripples of a shot that is judged [% of the mean edge]: well below what a user can see."""
STILL = 0.01
"""A cage stands where it moves less than this between two samples, in mean cage edges."""
SHARP, SMOOTH = 60.0, 30.0
"""Fine cloth folded by more than the first, in degrees, where the smooth cage folds by less than the second."""
PERCENTILE = 99.0
"""Percentile of the cloth's motion over a standing cage."""
REST_STEPS, REST_TOLERANCE = 400, 1e-4
"""Most steps to a frame's rest, and the remaining move that counts as rest [local edge lengths]. A frame of the dancer
(8, level 2) turns by 7.6 degrees in the first 100 quasi-Newton steps, 11.3 in 400 and 11.7 in 1,500."""


@dataclass(frozen=True)
class Job:
    """One run of one shot.

    Attributes:
        shot: Path of the shot.
        garments: Prim paths of the garments; empty for tagged garments.
        colliders: Prim paths of the bodies; empty for tagged bodies.
        first: Number of the first frame.
        count: Number of frames; 0 for all.
        level: Subdivisions of each garment.
        device: "cpu" or "cuda".
        ripple: Displacement of each cage vertex, in percent of the mean edge; 0 for the shot itself.
        seed: Seed of the ripple's directions.
        rest: Number of last frames that are solved on until nothing moves.
        rest_steps: Most steps of each of them.
        solve: Options of the solve that differ from the defaults, such as steps, tolerance and integrator.
        positions: File to write the fine positions to, or "" for none; see `write_positions`.
    """

    shot: str
    garments: Sequence[str] = ()
    colliders: Sequence[str] = ()
    first: int = 0
    count: int = 0
    level: int = 2
    device: str = "cpu"
    ripple: float = 0.0
    seed: int = 0
    rest: int = 0
    rest_steps: int = REST_STEPS
    solve: Mapping[str, Any] = field(default_factory=dict)
    positions: str = ""

    @property
    def options(self) -> RefineOptions:
        """Options of the run. Naming a report makes the solver measure contact; no report is written."""
        return RefineOptions(
            garments=tuple(self.garments),
            colliders=tuple(self.colliders),
            level=self.level,
            device=self.device,
            report=Path("report.json"),
            **self.solve,
        )


def _loaded_seen() -> Any:
    """The module `physgraph_usd.solver.seen` of this checkout, whatever checkout the package is from."""
    file = Path(__file__).resolve().parents[1] / "physgraph_usd" / "solver" / "seen.py"
    spec = importlib.util.spec_from_file_location("judge_seen", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


seen = _loaded_seen()


class OwnRest:
    """How far frames end from their own rest: where the cloth would end if the same frame were solved on.

    As a context, this notes each solve of the finest level. `add` then continues those of the last frame from where
    they ended, contact found anew as the cloth moves and the tether as it was, and what the run carries to its next
    frame does not change. The steps are quasi-Newton's for all versions: a network with a new training cannot change
    what counts as rest. Where a frame is solved again from its cage, the second solve is the one continued.
    """

    def __init__(self, level: int, steps: int) -> None:
        """Take the number of the finest level, and the most steps of a frame."""
        self._finest, self._steps, self._original = level, steps, frame_solve.solve_one_level
        self._ended: dict[int, tuple[Any, Any, Any]] = {}
        self._frames: list[dict[str, float]] = []

    def __enter__(self) -> OwnRest:
        """Begin to note solves."""

        def noted(problem: Any, *args: Any, **options: Any) -> Any:
            found = self._original(problem, *args, **options)
            if problem.level.index == self._finest:
                self._ended[id(problem.level)] = problem, found[0], found[2]
            return found

        frame_solve.solve_one_level = noted
        return self

    def __exit__(self, *_: object) -> None:
        """Note no more solves."""
        frame_solve.solve_one_level = self._original

    def begin(self) -> None:
        """Forget the solves of the frame before."""
        self._ended.clear()

    def add(self) -> None:
        """Continue the last frame's solves to rest; a frame without any, such as one equal to the last, adds none."""
        sums, angles, moves = dict.fromkeys(("before", "after", "folding", "rest_folding"), 0.0), [], []
        for problem, x, module in self._ended.values():
            budget = type(problem.budget)(self._steps, REST_TOLERANCE)
            longer = replace(problem, budget=budget, integrator=problem.untangler, show=None)
            triangles = problem.level.triangles.cpu().numpy().astype(np.int64)
            ended, before = x.double().cpu().numpy().copy(), sum(module.energies(x).values())
            rest, _, module_at_rest, *_ = self._original(longer, x, None)
            there = rest.double().cpu().numpy()
            angles.append(seen.normal_angles(ended, there, triangles))
            moves.append(((there - ended) ** 2).sum(axis=1))
            sums["before"] += before
            sums["after"] += sum(module_at_rest.energies(rest).values())
            sums["folding"] += seen.folding(ended, triangles)
            sums["rest_folding"] += seen.folding(there, triangles)
        if angles:
            found = np.concatenate(angles)
            distance = 1e3 * float(np.sqrt(np.concatenate(moves).mean()))
            middle, high = (float(each) for each in np.percentile(found, (50.0, 90.0)))
            self._frames.append(sums | {"angle": middle, "angle90": high, "distance": distance})

    @property
    def figures(self) -> dict[str, float | None]:
        """Medians over the frames: angles [degrees], distance [mm], folding over that at rest, energies [J]."""
        every = self._frames

        def middle(of: Callable[[dict[str, float]], float]) -> float | None:
            return statistics.median(map(of, every)) if every else None

        return {
            "rest_angle": middle(lambda each: each["angle"]),
            "rest_angle90": middle(lambda each: each["angle90"]),
            "rest_distance": middle(lambda each: each["distance"]),
            "rest_folding": middle(lambda each: each["folding"] / max(each["rest_folding"], 1e-30)),
            "rest_before": middle(lambda each: each["before"]),
            "rest_after": middle(lambda each: each["after"]),
        }


class Motion:
    """Motion and folds of the refined cloth relative to the cage's, summed over frames.

    Attributes:
        jumps: Vertices whose motion between two samples differs from the cage's by more than a mean cage edge.
        sharp: Number of edges that fold sharply where the smoothly subdivided cage does not, and of all inner edges.
    """

    def __init__(self, garments: Sequence[Any], level: int) -> None:
        """Subdivide the cages of a scene's garments."""
        self._chains = [subdivide_times(garment.mesh, level) for garment in garments]
        self._sharp = [sharp_folds(g.mesh, chain) for g, chain in zip(garments, self._chains, strict=True)]
        self._edges = [_mean_rest_edge(garment) for garment in garments]
        self._last: list[tuple[np.ndarray, np.ndarray] | None] = [None] * len(garments)
        self._still: list[np.ndarray] = []
        self.jumps, self.sharp = 0, (0, 0)

    def add(self, cages: Sequence[np.ndarray], points: Sequence[np.ndarray | None]) -> None:
        """Take the next frame: cage and fine positions of each garment [m]; None for a garment without a sample."""
        for index, (cage, fine) in enumerate(zip(cages, points, strict=True)):
            before, now = self._last[index], None if fine is None else (fine, self._upsampled(index, cage))
            self._last[index] = now
            if fine is not None:
                found = self._sharp[index](cage, fine)
                self.sharp = self.sharp[0] + int(found.sum()), self.sharp[1] + len(found)
            if before is None or now is None:
                continue
            carried = now[1] - before[1]
            own = np.linalg.norm(now[0] - before[0] - carried, axis=1)
            self.jumps += int((own > self._edges[index]).sum())
            self._still.append(own[np.linalg.norm(carried, axis=1) < STILL * self._edges[index]])

    @property
    def still(self) -> float | None:
        """99th percentile of the cloth's own motion between two samples where the cage stands [mm]; None without."""
        found = np.concatenate(self._still) if self._still else np.empty(0)
        return 1e3 * float(np.percentile(found, PERCENTILE)) if len(found) else None

    def _upsampled(self, index: int, points: np.ndarray) -> np.ndarray:
        for refinement in self._chains[index]:
            points = np.asarray(refinement.linear @ points)
        return points


def sharp_folds(mesh: Any, chain: Sequence[Any]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Maps positions of a cage and of its fine cloth to whether each inner fine edge folds sharply where the smoothly
    subdivided cage does not.
    """
    angles, smoothed = _sides(chain[-1].mesh if chain else mesh), _smoothing(mesh, chain)
    return lambda cage, fine: (angles(fine) > SHARP) & (angles(smoothed(cage)) < SMOOTH)


def _smoothing(mesh: Any, chain: Sequence[Any]) -> Callable[[np.ndarray], np.ndarray]:
    """Maps cage positions to the smoothly subdivided cage's."""
    steps = [smooth(coarse, step) for coarse, step in zip([mesh, *(each.mesh for each in chain)], chain, strict=False)]
    return lambda x: functools.reduce(lambda points, step: np.asarray(step @ points), steps, x)


def _sides(mesh: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Maps positions to the angle between the two faces at each inner edge, in degrees."""
    face, order = np.repeat(np.arange(len(mesh.counts)), mesh.counts), np.argsort(mesh.half_edges.edge, kind="stable")
    first = (np.cumsum(mesh.half_edges.count) - mesh.half_edges.count)[mesh.half_edges.count == 2]
    pairs, following = face[order][first[:, None] + [0, 1]], mesh.indices[mesh.next_corner]

    def angles(x: np.ndarray) -> np.ndarray:
        cross = np.cross(x[mesh.indices], x[following])
        normal = np.stack([np.bincount(face, each, len(mesh.counts)) for each in cross.T], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-30)
        return np.degrees(np.arccos((normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(axis=1).clip(-1.0, 1.0)))

    return angles


def _mean_rest_edge(garment: Any) -> float:
    """Mean rest length of a garment's cage edges [m]."""
    edges = garment.mesh.half_edges.edges
    return float(np.linalg.norm(garment.rest[edges[:, 0]] - garment.rest[edges[:, 1]], axis=1).mean())


def judged(job: Job) -> dict[str, float | None]:
    """Refine a shot and return the run's figures by name, as listed in `benchmarks.verdicts`.

    Raises:
        PhysGraphError: The shot cannot be read.
        ValueError: A frame could not be solved.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = job.shot
        if job.ripple:
            opened = open_for(file, job.options)
            prims = [str(source.path) for source in opened.sources]
            opened.close()
            file = str(rippled(Path(file), prims, Path(folder) / "ripple.usdc", size=job.ripple / 100.0, seed=job.seed))
        shot = open_for(file, job.options)
        motion, frames, spent, points = Motion(shot.scene.garments, job.level), [], [], []
        solver = ShotSolver(file, [job.level] * len(shot.scene.garments), job.options, opened=shot)
        times = list(shot.scene.times)[job.first :][: job.count or None]
        with OwnRest(job.level, job.rest_steps) as rest:
            for number, (result, milliseconds) in enumerate(_timed(solver(times), rest.begin)):
                error, fine, telemetry = _parts_of(result)
                if error:
                    raise ValueError(f"frame {result.time:g}: {error}")
                motion.add([each.points for each in shot.frame(result.time).garments], fine)
                frames.append(groups_of(telemetry))
                spent.append(milliseconds)
                if job.positions:
                    points.append(fine)
                if number >= len(times) - job.rest:
                    rest.add()
        shot.close()
    if job.positions:
        write_positions(Path(job.positions), shot.scene.garments, points, level=job.level)
    return (
        _figures(frames, spent, job)
        | rest.figures
        | {
            "jumps": motion.jumps,
            "still": motion.still,
            "sharp": motion.sharp[0] / max(motion.sharp[1], 1),
        }
    )


def write_positions(
    file: Path, garments: Sequence[Any], frames: Sequence[Sequence[np.ndarray | None]], *, level: int
) -> None:
    """Write the fine positions of a run as one array, all garments joined, and the triangles.

    Args:
        file: The .npz file, with the arrays points [m], shape (frames, V, 3), and triangles, shape (T, 3).
        garments: The garments of the scene.
        frames: Positions of each garment in each frame [m].
        level: Subdivisions of each garment.

    Raises:
        ValueError: A garment has no sample in a frame.
    """
    triangles, count = [], 0
    for garment in garments:
        mesh = [garment.mesh, *(each.mesh for each in subdivide_times(garment.mesh, level))][-1]
        triangles.append(mesh.triangulate().triangles + count)
        count += mesh.vertex_count
    if any(each is None for points in frames for each in points):
        raise ValueError("a garment has no sample in a frame")
    joined = [np.concatenate([np.asarray(each) for each in points]) for points in frames]
    np.savez(file, points=np.array(joined, np.float32), triangles=np.concatenate(triangles))


def _parts_of(result: Any) -> tuple[str, list[np.ndarray], list[dict[str, Any]]]:
    """Error or "", fine points [m] and telemetry of each garment in a `Result`, or an `Outcome` of older versions."""
    if hasattr(result, "record"):
        return result.record.get("error", ""), list(result.points), result.record.get("garments", [])
    garments = result.garments
    error = result.telemetry.get("error", "")
    return error, [garment.points for garment in garments], [garment.telemetry for garment in garments]


def _timed(results: Iterable[Any], begin: Callable[[], None]) -> Iterator[tuple[Any, float]]:
    """Each frame with the processor time spent on reading and solving the frame [ms]; ``begin`` is called before it."""
    begin()
    began = time.process_time()
    for each in results:
        yield each, 1e3 * (time.process_time() - began)
        begin()
        began = time.process_time()


def _figures(frames: Sequence[list[dict[str, Any]]], spent: Sequence[float], job: Job) -> dict[str, float | None]:
    """Figures of a run from the report of each frame and the processor time of each frame [ms].

    A frame solved on a card costs little processor time, so its time is the report's. Frames reused from an equal
    frame count for nothing.
    """
    if job.device != "cpu":
        spent = [sum(sum(each["milliseconds"].values()) for each in groups) for groups in frames]
    pairs = [(groups, milliseconds) for groups, milliseconds in zip(frames, spent, strict=True) if groups]
    warm = pairs[1:] or pairs
    contact = [each.get("contact") or {} for groups, _ in pairs for each in groups]
    bodies = [body["after"] for each in contact for body in (each.get("bodies") or {}).values()]
    cloth = [each["cloth"]["after"] for each in contact if each.get("cloth")]
    return {
        "warm": statistics.median(milliseconds for _, milliseconds in warm),
        "first": pairs[0][1],
        "energy": 1e3 * statistics.mean(sum(map(_energy, groups)) for groups, _ in warm),
        "cloth": sum(each["crossings"] for each in cloth),
        "bodies": sum(each["crossings"] for each in bodies),
        "inside": sum(each["inside"] for each in bodies),
        "remaining": max(
            (each["levels"][-1]["remaining_move"] for groups, _ in pairs for each in groups if each["levels"]),
            default=0.0,
        ),
    }


def _energy(group: dict[str, Any]) -> float:
    """Energy of the refined cloth without the tether's [J]."""
    return sum(value for name, value in group["energy_joules"]["output"].items() if name != "tether")


def groups_of(garments: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Entries of a frame's report, one per group of garments solved together; each garment of a group repeats its."""
    solved = [entry for entry in garments if entry.get("energy_joules")]
    return list({json.dumps([each["milliseconds"], each["energy_joules"]]): each for each in solved}.values())


def layer_over(shot: Path, out: Path) -> Sdf.Layer:
    """Create an empty layer that sublayers a shot and has the shot's stage metadata."""
    below = Sdf.Layer.FindOrOpen(str(shot))
    layer = Sdf.Layer.CreateNew(str(out))
    for key in below.pseudoRoot.ListInfoKeys():
        if key not in ("subLayers", "subLayerOffsets"):
            layer.pseudoRoot.SetInfo(key, below.pseudoRoot.GetInfo(key))
    layer.subLayerPaths.append(str(shot.resolve()))
    return layer


def rippled(shot: Path, prims: Sequence[str], out: Path, *, size: float, seed: int) -> Path:
    """Write a layer that sublayers a shot and moves the points of some meshes, and return the layer's path.

    Args:
        shot: Path of the shot.
        prims: Prim paths of the meshes.
        out: Path of the layer to write.
        size: Displacement of each vertex, in mean edges of the mesh's first sample.
        seed: Seed of the random directions.
    """
    layer = layer_over(shot, out)
    stage = Usd.Stage.Open(layer)
    random = np.random.default_rng(seed)
    for prim in prims:
        _move_points(UsdGeom.Mesh(stage.GetPrimAtPath(prim)), size, random)
    layer.Save()
    return out


def _move_points(mesh: UsdGeom.Mesh, size: float, random: np.random.Generator) -> None:
    """Author displaced points at the default and at every sample; skinned meshes have a default only."""
    points = mesh.GetPointsAttr()
    codes = [*map(Usd.TimeCode, points.GetTimeSamples()), Usd.TimeCode.Default()]
    # All samples are read before one is written: the first written sample hides those of the layers below.
    values = {code: np.asarray(value, np.float64) for code in codes if (value := points.Get(code))}
    first = next(iter(values.values()))
    offset = offsets(mesh, first, size, random)
    for code, value in values.items():
        if value.shape == offset.shape:
            points.Set(Vt.Vec3fArray.FromNumpy((value + offset).astype(np.float32)), code)


def offsets(mesh: UsdGeom.Mesh, points: np.ndarray, size: float, random: np.random.Generator) -> np.ndarray:
    """A displacement of a given size [mean edges] in a random direction for each vertex, in stage units."""
    found = random.normal(size=points.shape)
    return found * (size * _mean_edge(mesh, points) / np.linalg.norm(found, axis=1, keepdims=True))


def _mean_edge(mesh: UsdGeom.Mesh, points: np.ndarray) -> float:
    """Mean length of the sides of a mesh's faces, in stage units."""
    code = Usd.TimeCode.EarliestTime()
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(code))
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(code))
    following = np.arange(1, len(indices) + 1)
    ends = np.cumsum(counts)
    following[ends - 1] = ends - counts
    return float(np.linalg.norm(points[indices] - points[indices[following]], axis=1).mean())


def main(arguments: Sequence[str]) -> None:
    """Run a job file and write its figures."""
    job = Job(**json.loads(Path(arguments[0]).read_text("utf-8")))
    Path(arguments[1]).write_text(json.dumps(judged(job)), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
