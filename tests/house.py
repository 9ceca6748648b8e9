"""The package's size and shape: lines and files by room, import circles, small files, classes, and a frame's files.

python -m tests.house
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "physgraph_usd"
ROOMS = ("solver", "usd", "shot", "studio", "lab", "cli")
MOST = {"lines": 30_000, "lines of solver": 14_000, "files beside the rooms": 5}
SMALL, LONG = 60, 200
"""Lines under which a file with one importer belongs to it unless it is a noun, and from which a class is too long."""
FRAME = """
import sys
import numpy as np
from physgraph_usd.solver import *

x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.3, 0.3, 9)))
corner = np.array([row * 9 + column for row in range(8) for column in range(8)])
rest, faces = np.stack([x, y, 0 * x + 0.205], axis=1), np.stack([corner, corner + 1, corner + 10, corner + 9], axis=1)
body = {body}
sheet = Garment.of("/Sheet", faces, rest, colliders=(0,) if body else ())
scene = Scene((sheet,), np.array([0.0, 0.0, -9.81]), colliders=(Collider("/Ball", "sphere"),))
frame = Frame(1.0, (GarmentFrame(rest * [0.9, 1.0, 1.0], PRESETS["jersey"]),),
              (ShapePose("sphere", np.eye(3), np.zeros(3), np.full(3, 0.2)),))
refiner, entered = Refiner(scene, SolveSettings()), set()
sys.setprofile(lambda frame, event, arg: entered.add(frame.f_code.co_filename))
refiner.solve(frame)
sys.setprofile(None)
names = sorted(name for name in entered if "physgraph_usd" in name)
sys.stdout.write(" ".join(names))
"""


def modules() -> dict[str, Path]:
    found = {}
    for file in PACKAGE.rglob("*.py"):
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = file
    return found


def imports(name: str, file: Path, known: dict[str, Path], *, typing: bool = False) -> Iterator[str]:
    """Modules of the package that one imports, anywhere in its text; those for types alone if asked for."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    skipped = {
        id(inner)
        for node in ast.walk(tree)
        if not typing and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom) or id(node) in skipped:
            continue
        parts = package.split(".")
        base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
        base = ".".join(part for part in (base, node.module) if part)
        for alias in node.names:
            if f"{base}.{alias.name}" in known:
                yield f"{base}.{alias.name}"
            elif base in known:
                yield base


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Modules that import one another in a circle, by Tarjan's strongly connected components."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            place = stack.index(node)
            component, stack[place:] = stack[place:], []
            if len(component) > 1 or node in graph[node]:
                found.append(sorted(component))

    for node in graph:
        if node not in index:
            visit(node)
    return found


def lines(file: Path) -> int:
    return len(file.read_text(encoding="utf-8").splitlines())


def house() -> Iterator[str]:
    """What is to be said of the package, line by line."""
    known = modules()
    graph = {name: {each for each in imports(name, file, known) if each != name} for name, file in known.items()}
    users: dict[str, set[str]] = {name: set() for name in known}
    for name, others in graph.items():
        for other in others:
            users[other].add(name)
    total = sum(lines(file) for file in known.values())
    yield f"{total:,} lines (at most {MOST['lines']:,}) in {len(known)} files"
    for room in ROOMS:
        files = [file for file in known.values() if (PACKAGE / room) in file.parents]
        yield f"  {room:7} {sum(map(lines, files)):6,} lines {len(files):4} files"
    beside = sorted(file.name for file in PACKAGE.glob("*.py"))
    yield f"{len(beside)} files beside the rooms (at most {MOST['files beside the rooms']}): {', '.join(beside)}"
    yield f"import circles: {circles(graph) or 'none'}"
    small = [
        f"{name} ({lines(file)} lines, imported by {next(iter(users[name]))})".replace("physgraph_usd.", "")
        for name, file in sorted(known.items())
        if file.name != "__init__.py" and lines(file) < SMALL and len(users[name]) == 1
    ]
    yield f"files under {SMALL} lines with one importer: {', '.join(small) or 'none'}"
    long = [
        f"{node.name} ({(node.end_lineno or 0) - node.lineno + 1})"
        for file in known.values()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef) and (node.end_lineno or 0) - node.lineno + 1 >= LONG
    ]
    yield f"classes of {LONG} lines or more: {', '.join(long) or 'none'}"
    for body in (False, True):
        yield f"a cold frame {'with' if body else 'without'} a body enters {frame_files(body=body)} files"


def frame_files(*, body: bool) -> int:
    """How many files of the package a cold frame enters."""
    command = [sys.executable, "-W", "ignore", "-c", FRAME.format(body=body)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    return sum(word.endswith(".py") for word in done.stdout.split())


if __name__ == "__main__":
    for text in house():
        sys.stdout.write(text + "\n")
