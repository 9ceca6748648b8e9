"""The way of a warm frame from its reading to its writing: files whose code runs, and kinds of records that are made.

A record is an instance of a dataclass of the package. What a module makes when it is imported does not count.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import physgraph_usd
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot

SAMPLE, FRAMES, LEVEL = "armpit", (1.0, 3.0), 1
"""The sample, a garment with a body, its frames and subdivisions; the last frame counts."""
ROOT = str(Path(physgraph_usd.__file__).parent)


def path_of_frame() -> tuple[list[str], list[str]]:
    """Files of the package whose code runs in a warm frame, and the names of the records that are made, sorted."""
    files, records, done = set[str](), set[str](), 0

    def trace(frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or done != int(FRAMES[1]) - 1:
            return
        file = frame.f_code.co_filename
        if file.startswith(ROOT):
            files.add(file[len(ROOT) + 1 :])
        made = frame.f_locals.get("self")
        if frame.f_code.co_name == "__init__" and is_dataclass(made) and type(made).__module__.startswith("physgraph"):
            records.add(type(made).__name__)

    def progress(frames: int, _: int) -> None:
        nonlocal done
        done = frames

    with tempfile.TemporaryDirectory() as folder, _profiled(trace):
        shot = write_sample(SAMPLE, Path(folder))
        refine_shot(shot, Path(folder) / "out.usdc", RefineOptions(frames=FRAMES, level=LEVEL, progress=progress))
    return sorted(files), sorted(records)


@contextmanager
def _profiled(trace: Any) -> Iterator[None]:
    """Call a function at each call of Python code in this thread."""
    sys.setprofile(trace)
    try:
        yield
    finally:
        sys.setprofile(None)


def text_of_path() -> str:
    """A line for files and a line for records."""
    parts = zip(("files", "kinds of records"), path_of_frame(), strict=True)
    return "\n".join(f"{len(names)} {title}: {', '.join(names)}" for title, names in parts)
