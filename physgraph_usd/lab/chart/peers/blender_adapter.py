"""Blender's cloth as a quasi-static solver: run by a Python that has ``bpy``, made for 5.0.

    python blender_adapter.py problem.npz result.npz --steps 1,2,4 --repeats 3 --most-ms 5000

It minimises an energy of its own, on the finest level alone: edges as springs whose stiffness is painted on the
vertices, forces on the angles between faces, and a goal spring at each vertex where our guide ties averages. A step is
a frame. Blender's units are no SI units, and forces have a scale of their own:

| Blender | its effect | here |
|---|---|---|
| time | frames; gravity times a thousandth | gravity is what makes ours from the mass |
| tension, compression, pin stiffness | divided by the mean spring | times that length |
| goal | the fourth power of the weight; from 0.999 on pinned | the fourth root |
| bending | a third of a tenth of stiffness x edge x angle, at the tips | what our moment makes over the height |
| air damping | a hundredth of it [kg a frame] at each vertex, whatever its mass | what a step is proximal to |
| rest shape key | left out by a cloth that comes first of all modifiers | a weld of nothing comes before it |

Forces are scaled so that the air holds a vertex by `PROXIMITY` of its springs' constants, and the mass is small beside
the air: a frame is then a proximal step, and nothing swings. With a vertex's real mass and stiffness the air holds the
cloth where it is. Imports nothing of this package.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

AIR = 5.0
"""Blender's air damping."""
DRAG = 0.01 * AIR
"""Drag coefficient of this damping [kg a frame]."""
PROXIMITY = 0.01
"""The air's hold over the springs' constants: with less the forces of bending, which are explicit, swing."""
INERTIA = 0.1
"""A vertex's mass over the drag of a frame."""
THOUSANDTH = 1e-3
"""Blender's factor of gravity."""
FREE = 0.998
"""Largest goal of a vertex that is not pinned."""
TIP = 30.0
"""Blender's bending stiffness that makes a force of one at the tip, on an edge of one."""


class Finest:
    """The finest level: the received arrays, and values derived from the arrays."""

    def __init__(self, problem: Any) -> None:
        """Take it from a problem."""
        self._problem, self._last = problem, int(problem["levels"]) - 1
        self.base, self.rest, self.free = (self.array(name) for name in ("base", "rest", "free"))
        edges = np.unique(np.sort(self.array("triangles")[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        self.length = float(np.linalg.norm(self.sides(edges), axis=1).mean())
        self.scale = DRAG / (PROXIMITY * float(self.array("diagonal").mean()))

    def array(self, name: str) -> np.ndarray:
        """An array of this level."""
        return self._problem[f"{name}{self._last}"]

    def sides(self, ends: np.ndarray) -> np.ndarray:
        """Vectors between rest positions [m]."""
        return self.rest[ends[:, 1]] - self.rest[ends[:, 0]]

    def guide(self) -> np.ndarray:
        """Goal springs that cost what the guide costs where all vertices near move alike [N/m]."""
        rows = np.repeat(np.arange(len(self.base)), np.diff(self.array("starts")))
        return np.bincount(rows, self.array("values"), len(self.base))

    def bending(self) -> np.ndarray:
        """Blender's stiffness at each hinge for our moment: the mean of the two tips."""
        i, j, k, ell = self.array("hinges").T
        axis = self.sides(np.stack([i, j], axis=1))
        length = np.linalg.norm(axis, axis=1)
        areas = [np.linalg.norm(np.cross(axis, self.rest[tip] - self.rest[i]), axis=1) for tip in (k, ell)]
        height = np.maximum(0.5 * (areas[0] + areas[1]) / length, 1e-3 * length)
        return TIP * self.array("hinge") / (height * length)


def build(level: Finest) -> Any:
    """The level as an object of Blender with a cloth modifier."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = bpy.data.meshes.new("cloth")
    mesh.from_pydata(level.base.tolist(), [], level.array("triangles").tolist())
    thing = bpy.data.objects.new("cloth", mesh)
    bpy.context.scene.collection.objects.link(thing)
    thing.shape_key_add(name="Basis")
    rest = thing.shape_key_add(name="rest")
    rest.data.foreach_set("co", level.rest.astype(np.float32).ravel())
    rest.value = 0.0
    thing.vertex_groups.new(name="nothing")
    first = thing.modifiers.new("first", "WELD")
    first.vertex_group, first.merge_threshold = "nothing", 0.0
    cloth = thing.modifiers.new("cloth", "CLOTH")
    cloth.settings.rest_shape_key = rest
    cloth.collision_settings.use_collision = cloth.collision_settings.use_self_collision = False
    set_up(thing, cloth.settings, level)
    return thing


def set_up(thing: Any, settings: Any, level: Finest) -> None:
    """Our values in Blender's units."""
    scale, mass = level.scale, INERTIA * DRAG
    settings.quality, settings.time_scale, settings.air_damping, settings.mass = 1, 1.0, AIR, mass
    load = level.array("load")
    down, weight = load.sum(axis=0), float(np.linalg.norm(load, axis=1).mean())
    unit = down / max(float(np.linalg.norm(down)), 1e-30)
    bpy.context.scene.gravity = (scale * weight / (THOUSANDTH * mass) * unit).tolist()
    least, most = paint(thing, "springs", level.array("springs"), level.array("spring") * level.length * scale)
    settings.tension_stiffness = settings.compression_stiffness = least
    settings.tension_stiffness_max = settings.compression_stiffness_max = most
    settings.vertex_group_structural_stiffness = "springs"
    least, most = paint(thing, "hinges", level.array("hinges")[:, :2], level.bending() * scale)
    settings.bending_model, settings.bending_stiffness, settings.bending_stiffness_max = "ANGULAR", least, most
    settings.vertex_group_bending = "hinges"
    settings.shear_stiffness = settings.shear_damping = settings.goal_friction = 0.0
    settings.tension_damping = settings.compression_damping = settings.bending_damping = 0.0
    guide = level.guide()
    most = max(float(guide[level.free].max(initial=0.0)) / FREE, 1e-30)
    weigh(thing, "pins", np.where(level.free, np.maximum(guide, 0.0) / most, 1.0) ** 0.25)
    settings.vertex_group_mass, settings.pin_stiffness = "pins", most * level.length * scale


def paint(thing: Any, name: str, ends: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Paint means of values at their ends on the vertices; returns the values of weights 0 and 1."""
    count = len(thing.data.vertices)
    shares = np.bincount(ends.ravel(), minlength=count)
    means = np.bincount(ends.ravel(), np.repeat(values, 2), count) / np.maximum(shares, 1)
    used = means[shares > 0]
    least, most = float(used.min(initial=np.inf)), float(used.max(initial=0.0))
    weigh(thing, name, np.clip((means - least) / max(most - least, 1e-30), 0.0, 1.0))
    return min(least, most), most


def weigh(thing: Any, name: str, weights: np.ndarray) -> None:
    """A vertex group of weights."""
    group = thing.vertex_groups.new(name=name)
    for vertex, weight in enumerate(weights.tolist()):
        group.add([vertex], weight, "REPLACE")


def run(thing: Any, budgets: list[int], *, clock: Any, most_ms: float) -> dict[int, tuple[np.ndarray, float]]:
    """Positions [m] and milliseconds after each number of frames, one run for all."""
    scene, results, spent = bpy.context.scene, dict[int, tuple[np.ndarray, float]](), 0.0
    cache = thing.modifiers["cloth"].point_cache
    cache.frame_start, cache.frame_end = 1, max(budgets) + 1
    scene.frame_end = max(budgets) + 1
    scene.frame_set(1)
    for frame in range(1, max(budgets) + 1):
        began = clock()
        scene.frame_set(frame + 1)
        seen = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        spent += 1e3 * (clock() - began)
        if frame in budgets:
            if len(seen.vertices) != len(thing.data.vertices):
                raise SystemExit("Blender made another number of vertices")
            x = np.empty(3 * len(seen.vertices), np.float32)
            seen.vertices.foreach_get("co", x)
            results[frame] = x.reshape(-1, 3).astype(np.float64), spent
            if 2.0 * spent > most_ms:
                break
    return results


def arrays_of(runs: list[dict[int, tuple[np.ndarray, float]]]) -> dict[str, Any]:
    """Positions [m] of the last run, and times of all runs [ms], of the budgets that all runs have, by name."""
    arrays: dict[str, Any] = {}
    for steps in set.intersection(*(set(run) for run in runs)):
        arrays[f"x_0_{steps}"] = runs[-1][steps][0]
        arrays[f"ms_0_{steps}"] = np.array([run[steps][1] for run in runs])
    return arrays


def main() -> None:
    """Solve with every budget and write positions and times."""
    parser = argparse.ArgumentParser()
    parser.add_argument("problem")
    parser.add_argument("result")
    parser.add_argument("--steps", required=True)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--most-ms", type=float, default=1e4)
    parser.add_argument("--clock", choices=["wall", "cpu"], default="wall")
    arguments = parser.parse_args()
    clock = time.process_time if arguments.clock == "cpu" else time.perf_counter
    level = Finest(np.load(arguments.problem))
    budgets = [int(steps) for steps in arguments.steps.split(",")]
    runs = [run(build(level), budgets, clock=clock, most_ms=arguments.most_ms) for _ in range(arguments.repeats)]
    np.savez(arguments.result, **arrays_of(runs))


if __name__ == "__main__":
    main()
