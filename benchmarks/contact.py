"""Cost of contact: the same frames with and without a body, and with and without cloth against cloth.

    python -m benchmarks.contact [--device cuda]

Drapes a sheet of about 100,000 fine vertices over a ball of 20,480 triangles. Prints the median milliseconds of a
frame, in one run, over those without contact, and the same of processor time, which other work on the machine changes
less; how much of a frame is measuring for the report; how many vertices each form leaves to the last projection; then
the same of frames that start from the last one's detail, while the sheet's folds travel round the ball. The ball turns
from frame to frame: what is found out about one that stands still would be kept.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from typing import Any

import trimesh

from benchmarks.rows import say
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.colliders.pose import MeshPose
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.scene import Frame, GarmentFrame, Scene

from .sheet_over_ball import SheetOverBall

REPEATS = 5
WARM = 13
"""Frames of the sequence, the first of which is cold."""
TRAVEL = 0.05
"""Angle by which its folds travel round the ball between frames."""
SHEET = SheetOverBall(side=79, edge=0.02, radius=0.4)
THREADS = 2


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    device = parser.parse_args().device
    prepare_device(device)
    cold_frames(device)
    warm_frames(device)


def cold_frames(device: str) -> None:
    """Print the table of frames by themselves, and what each form leaves."""
    scene, ball = SHEET.scene(subdivisions=5)
    sheets = [SHEET.draped(height) for height in (0.0, -0.003, -0.006)]
    far = MeshPose(ball.points + 100.0, ball.triangles)
    cases = {
        "switched off": ("off", "off", ball),
        "contact": ("quadratic", "pairs", ball),
        "body only": ("quadratic", "off", ball),
        "cloth only": ("off", "pairs", ball),
        "body out of reach": ("quadratic", "off", far),
    }
    refiners = {name: _refiner(scene, form, cloth, device=device) for name, (form, cloth, _) in cases.items()}
    times, work, solve, measure = ({name: list[float]() for name in cases} for _ in range(4))
    said: dict[str, Any] = {}
    count = 0
    for repeat in range(REPEATS):
        for name, (*_, pose) in cases.items():
            refiners[name].forget()
            began, worked = time.perf_counter(), time.process_time()
            points, turned = sheets[repeat % len(sheets)], _turned(pose, repeat)
            state = refiners[name].solve(Frame(None, (GarmentFrame(points, PRESETS["jersey"]),), (turned,)))
            times[name].append(1e3 * (time.perf_counter() - began))
            work[name].append(1e3 * (time.process_time() - worked))
            solve[name].append(sum(level["milliseconds"] for level in state.telemetry[0]["levels"]))  # type: ignore[attr-defined]
            measure[name].append(state.telemetry[0]["milliseconds"]["measure"])  # type: ignore[index]
            said[name] = state.telemetry[0].get("contact")
            count = len(state.points[0]) if state.points[0] is not None else 0
    say(f"sheet of {count} vertices over a ball of {len(ball.triangles)} triangles, {THREADS} threads, cold frames")
    say("\n| case | frame ms | steps alone ms | measuring ms | frame / switched off | of processor time |")
    say("|---|---|---|---|---|---|")
    bases = [statistics.median(values["switched off"][1:]) for values in (times, work)]
    for name in cases:
        frame, steps, seen, worked = (statistics.median(each[name][1:]) for each in (times, solve, measure, work))
        say(f"| {name} | {frame:.0f} | {steps:.0f} | {seen:.0f} | {frame / bases[0]:.2f} | {worked / bases[1]:.2f} |")
    for name in ("contact",):
        say(f"\n{name}: left to the last projection {said[name]['projected']}")
        for path, values in said[name]["bodies"].items():
            say(f"{path}: before {values['before']}\nafter {values['after']}")


def warm_frames(device: str) -> None:
    """Print the table of a sequence's frames, the first left out."""
    scene, ball = SHEET.scene(subdivisions=5)
    cases = {"switched off": ("off", "off"), "contact": ("quadratic", "pairs"), "body only": ("quadratic", "off")}
    refiners = {name: _refiner(scene, *forms, device=device, temporal="tether") for name, forms in cases.items()}
    times, work, steps = ({name: list[float]() for name in cases} for _ in range(3))
    for index in range(WARM):
        points, turned = SHEET.draped(0.0, phase=TRAVEL * index), _turned(ball, index)
        for name, refiner in refiners.items():
            began, worked = time.perf_counter(), time.process_time()
            state = refiner.solve(Frame(None, (GarmentFrame(points, PRESETS["jersey"]),), (turned,)))
            times[name].append(1e3 * (time.perf_counter() - began))
            work[name].append(1e3 * (time.process_time() - worked))
            steps[name].append(sum(level["steps"] for level in state.telemetry[0]["levels"]))  # type: ignore[attr-defined]
    say("\n| warm frames | frame ms | steps | frame / switched off | of processor time |\n|---|---|---|---|---|")
    bases = [statistics.median(values["switched off"][1:]) for values in (times, work)]
    for name in cases:
        frame, worked, made = (statistics.median(each[name][1:]) for each in (times, work, steps))
        say(f"| {name} | {frame:.0f} | {made:.0f} | {frame / bases[0]:.2f} | {worked / bases[1]:.2f} |")


def _turned(ball: MeshPose, index: int) -> MeshPose:
    """The ball turned about the vertical, a little farther each frame."""
    turn = trimesh.transformations.rotation_matrix(TRAVEL * index, [0.0, 1.0, 0.0])[:3, :3]
    return MeshPose(ball.points @ turn.transpose(), ball.triangles)


def _refiner(scene: Scene, form: str, cloth: str, *, device: str, temporal: str = "off") -> Refiner:
    contact = ContactSettings(form, cloth=cloth)
    settings = SolveSettings(method_named("quasi-newton"), temporal=temporal, contact=contact)
    return Refiner(replace(scene), settings, device=device, threads=THREADS)


if __name__ == "__main__":
    main()
