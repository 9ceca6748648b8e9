"""The paper's timing table: milliseconds of a force evaluation and of an integration step by number of springs.

    python -m benchmarks.step_rows [--long]
    python -m benchmarks.step_rows --device cuda --json docs/figures/step_cuda.json      on a machine with a GPU

Runs `python -m benchmarks.step` and reads its table. The paper's times are of its own network on an RTX A6000; ours of
a step of each integrator, forces and metric solve included: on the CPU the time of all threads together, on CUDA wall
time. Figures of a GPU are read from the file that the second form writes.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.rows import Found, Row, show, table, under
from physgraph_usd.shot.solve import prepare_device

PAPER_MS = {1_000: (0.037, 7.13), 10_000: (0.042, 9.74), 100_000: (0.051, 37.74), 1_000_000: (0.078, 343.08)}
"""Forces and integrator by number of springs [ms]."""
MOST = {True: (100_000, 1_000), False: (1_000_000, 10_000)}
"""Most edges of ours and of the paper's network, by whether the form is the short one."""
CUDA = Path("docs/figures/step_cuda.json")
OURS, THEIRS, CLASSIC = "physgraph", "physgraph-paper", "quasi-newton"


def measure(short: bool) -> Found:
    """The rows of the CPU, and of the GPU where they are known."""
    most, paper_most = MOST[short]
    lines = timed(["--most", f"{most}", "--paper-most", f"{paper_most}"])
    rows = [under_paper(f"{name} on this CPU", line, name) for name in (CLASSIC, OURS) for line in lines]
    notes = ["CPU, milliseconds:", as_table(lines)]
    if CUDA.exists():
        known = json.loads(CUDA.read_text(encoding="utf-8"))
        device = known["device"]
        for line in known["rows"]:
            forces = PAPER_MS[size_of(line)][0]
            rows.append(under(f"forces on {device}, {line['edges']:,} springs", line["forces"], forces, unit=" ms"))
            rows += [under_paper(f"{name} on {device}", line, name) for name in (CLASSIC, OURS, THEIRS)]
        of = f" ({known['network']})" if "network" in known else ""
        notes += [f"{device}, milliseconds, `{known['command']}`{of}:", as_table(known["rows"])]
    else:
        rows.append(Row("forces and integrators on a GPU", "not measured", "as above", "as the paper", False))
    return Found(rows, notes)


def under_paper(what: str, line: dict[str, Any], name: str) -> Row:
    """A step beside the paper's."""
    most, value = PAPER_MS[size_of(line)][1], line.get(name)
    value = math.nan if value is None else value
    return under(f"{what}, {line['edges']:,} springs", value, most, unit=" ms", paper=f"{most} ms")


def size_of(line: dict[str, Any]) -> int:
    """The paper's number of springs that a line stands for."""
    return min(PAPER_MS, key=lambda size: abs(math.log(size / line["edges"])))


def timed(options: Sequence[str]) -> list[dict[str, Any]]:
    """What `benchmarks.step` prints, a record a size."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.step", *options], capture_output=True, text=True, check=True
    )
    return parsed(done.stdout)


def parsed(text: str) -> list[dict[str, Any]]:
    """The lines of a table in Markdown, as records; what is no number, or not finite, is None."""
    lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines() if line[:1] == "|"]
    head, _, *body = lines
    return [{name: number(cell) for name, cell in zip(head, cells, strict=True)} for cells in body]


def number(cell: str) -> float | int | None:
    """A cell's value."""
    try:
        value = float(cell)
    except ValueError:
        return None
    if not math.isfinite(value):
        return None
    return int(value) if value == int(value) and "." not in cell else value


def as_table(lines: Sequence[dict[str, Any]]) -> str:
    """Records as a table."""
    return table(list(lines[0]), [["-" if value is None else value for value in line.values()] for line in lines])


def main() -> None:
    """Print the rows, or write the figures of a device."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--long", action="store_true", help="measure more")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, default=None, help="file for the device's figures")
    given, more = parser.parse_known_args()
    prepare_device(given.device)
    if given.json is None:
        show(measure(not given.long))
        return
    options = ["--device", given.device, *more]
    name = torch.cuda.get_device_name(given.device) if given.device.startswith("cuda") else "CPU"
    known = {"device": name, "command": " ".join(["python -m benchmarks.step", *options]), "rows": timed(options)}
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
