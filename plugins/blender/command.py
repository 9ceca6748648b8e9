"""What the add-on asks of the command `physgraph-usd`, and what it reads from its words; needs no Blender."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

PRESETS = ("paper", "silk", "cotton", "wool", "polyester", "denim", "jersey", "rib", "leather")
PRESETS += ("worn-denim", "crisp-cotton", "soft-jersey")
"""The fabrics of `physgraph-usd tag --preset`."""
OF_BLENDER = ("MATERIALX_SEARCH_PATH", "PXR_MTLX_STDLIB_SEARCH_PATHS")
"""What Blender sets for its own USD, of another version than the command's."""
COMMAND, SOLVER_FILE = "physgraph-usd", "solver.txt"
"""Name of the command on the search path, and the file beside the add-on that `make blender` writes the path into."""
IN_PART = 3
"""Exit code of a run that refined some of its frames."""
LONGEST_STEM = 60
WARNING = "warning: "
PROGRESS = re.compile(r"^\s*(\d+)%\s+(.*)$")
PATIENCE_SECONDS = 5.0
"""How long a command that was told to end may take to clear up."""


def usual_command(folder: Path) -> str:
    """The command that a folder's `SOLVER_FILE` names, if it exists, else its name on the search path."""
    file = folder / SOLVER_FILE
    path = file.read_text(encoding="utf-8").strip() if file.is_file() else ""
    return path if path and Path(path).is_file() else COMMAND


class Slider(NamedTuple):
    """A value on the panel.

    Attributes:
        key: Name of the panel's property; ``use_KEY`` switches it on.
        name: The schema's short name.
        label: Name that the artist sees.
        unit: Unit on the panel.
        factor: Times the SI value, it is the number on the panel.
        default: Number on the panel before the artist changes it.
        limits: Least and greatest number.
        ends: Ends of the slider.
        doc: Meaning.
    """

    key: str
    name: str
    label: str
    unit: str
    factor: float
    default: float
    limits: tuple[float, float]
    ends: tuple[float, float]
    doc: str


_EASE = ("%", 1.0, 0.0, (-50.0, 100.0), (0.0, 10.0))
SLIDERS = (
    Slider("weft_ease", "rest:weftEase", "Weft Ease", *_EASE, "Length along the weft that the cage does not show"),
    Slider("warp_ease", "rest:warpEase", "Warp Ease", *_EASE, "Length along the warp that the cage does not show"),
    Slider(
        "stretch", "stretchStiffness", "Stretch", "N/m", 1.0, 30.0, (1e-3, 1e9), (1.0, 2000.0),
        "Stretch stiffness E h of the sheet",
    ),
    Slider(
        "bend", "bendStiffness", "Bend", "\N{MICRO SIGN}N m", 1e6, 4.7, (0.0, 1e11), (0.0, 500.0),
        "Bending stiffness D of the sheet",
    ),
    Slider(
        "density", "density", "Density", "g/m\N{SUPERSCRIPT TWO}", 1e3, 187.0, (0.1, 1e8), (10.0, 2000.0),
        "Mass per area",
    ),
    Slider(
        "guide", "guide:stiffness", "Guide", "N/m\N{SUPERSCRIPT THREE}", 1.0, 2000.0, (0.0, 1e12), (10.0, 20000.0),
        "How firmly the fine cloth follows the coarse animation",
    ),
    Slider(
        "max_distance", "maxDistance", "Max Distance", "mm", 1e3, 50.0, (0.0, 1e6), (0.0, 100.0),
        "Largest distance of the fine cloth from the smooth coarse animation",
    ),
    Slider(
        "backstop", "backstop", "Backstop", "mm", 1e3, 10.0, (0.0, 1e6), (0.0, 100.0),
        "Largest distance of the fine cloth inside the smooth coarse animation",
    ),
    Slider(
        "offset", "contact:offset", "Offset", "mm", 1e3, 2.0, (0.0, 1e4), (0.1, 30.0),
        "Distance kept from colliders",
    ),
)  # fmt: skip
"""The values on the panel, in its order: those of `physgraph-usd tune` that artists move most."""


@dataclass(frozen=True)
class Settings:
    """What the panel says.

    Attributes:
        frames: First and last frame.
        preset: A name of `PRESETS`, or "" for what the objects and their materials say.
        values: Values [SI] in place of the fabric's and of those authored, by the schema's short names.
        level: Subdivisions; -1 lets the command choose.
        report: Whether to write a page about the run.
        more: Further options of `physgraph-usd refine`, as in a shell.
    """

    frames: tuple[int, int]
    preset: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    level: int = 2
    report: bool = False
    more: str = ""


@dataclass(frozen=True)
class Files:
    """The files of one run, side by side.

    Attributes:
        coarse: What Blender exports.
        cloth: The same with its fabric chosen.
        layer: What the command writes.
        root: The layer over the shot; what Blender imports.
        report: Folder of the report.
        log: What the command says.
    """

    coarse: Path
    cloth: Path
    layer: Path
    root: Path
    report: Path
    log: Path


def files_of_run(folder: Path, blend: str, garments: list[str]) -> Files:
    """Name the files of a new run; no file of an earlier one is named again.

    Blender keeps an imported layer open, and may go back to it by undo: it must not change.

    Args:
        folder: Where they go.
        blend: Name of the .blend file without its suffix.
        garments: Names of the objects to refine.
    """
    stem = re.sub(r"[^\w-]+", "_", "-".join([blend, *garments]))
    if len(stem) > LONGEST_STEM:
        stem = f"{stem[:LONGEST_STEM]}-{crc32(stem.encode()):08x}"
    used = [re.match(r"\.v(\d+)\.", file.name.removeprefix(stem)) for file in folder.glob(f"{stem}.v*")]
    run = 1 + max((int(match[1]) for match in used if match), default=0)

    def named(suffix: str) -> Path:
        return folder / f"{stem}.v{run:03d}.{suffix}"

    suffixes = ("coarse.usdc", "cloth.usda", "refined.usdc", "refined.usda", "report", "log")
    return Files(*map(named, suffixes))


def command_lines(
    command: str, settings: Settings, files: Files, *, garments: list[str], colliders: list[str]
) -> list[list[str]]:
    """The command lines to run one after the other.

    Args:
        command: The command, a name on the search path or a path.
        settings: What the panel says.
        files: The files of the run.
        garments: Prim paths of the garments in the exported file, at least one.
        colliders: Prim paths of the colliders.

    Raises:
        ValueError: The further options end inside a quotation.
    """
    named = [word for path in garments for word in ("--garment", path)]
    lines, shot = [], files.coarse
    if settings.preset:
        shot = files.cloth
        lines.append([command, "tag", str(files.coarse), "-o", str(shot), *named, "--preset", settings.preset])
    named += [word for path in colliders for word in ("--collider", path)]
    refine = [command, "refine", str(shot), "-o", str(files.layer), "--root", str(files.root), *named]
    refine += ["--frames", "{}:{}".format(*settings.frames), "--level", str(settings.level).replace("-1", "auto")]
    refine += [word for name, value in settings.values.items() for word in ("--set", f"{name}={value:.9g}")]
    refine += ["--report", str(files.report)] if settings.report else []
    return [*lines, [*refine, "--progress", "--no-keep-frames", *shlex.split(settings.more)]]


def live_line(command: str, settings: Settings, shot: Path, *, garments: list[str], colliders: list[str]) -> list[str]:
    """The command line of a process that solves frames of an exported shot; arguments are those of `command_lines`.

    Of the further options it takes the device alone.

    Raises:
        ValueError: The further options end inside a quotation.
    """
    named = [word for path in garments for word in ("--garment", path)]
    named += [word for path in colliders for word in ("--collider", path)]
    words = shlex.split(settings.more.replace("--device=", "--device "))
    device = words[words.index("--device") :][:2] if "--device" in words else []
    return [command, "live", str(shot), *named, *device]


def unsaid_warnings(settings: Settings, lacking: dict[str, list[str]]) -> list[str]:
    """What to tell an artist who takes the fabric as it was authored, where it was not.

    Args:
        settings: What the panel says.
        lacking: Names of the stiffnesses that nothing gives, by the garment's object.
    """
    told = {item: [name for name in names if name not in settings.values] for item, names in lacking.items()}
    return [
        f"nothing gives the {' and '.join(names)} of '{item}': jersey's is taken; choose a fabric, or author it"
        for item, names in told.items()
        if names
    ]


def progress_in(text: str) -> tuple[float, str] | None:
    """The last line of progress in what a command said: the part that is done, and the rest of the line."""
    for line in reversed(text.splitlines()):
        if match := PROGRESS.match(line):
            return int(match[1]) / 100.0, " ".join(match[2].split())
    return None


def words_in(text: str) -> str:
    """What a command said, without its progress."""
    return "\n".join(line for line in text.splitlines() if not PROGRESS.match(line)).strip()


def warnings_in(text: str) -> list[str]:
    """The warnings of physgraph-usd in what a command said; its libraries have words of their own."""
    return [line.removeprefix(WARNING) for line in text.splitlines() if line.startswith(WARNING)]


class CommandError(Exception):
    """The command could not be started, or failed; says what it said."""


def start(line: list[str], *, stdin: int, stdout: int, stderr: BinaryIO) -> subprocess.Popen[bytes]:
    """Start a command line; the streams are as `subprocess.Popen` takes them.

    Raises:
        CommandError: It cannot be started.
    """
    environment = {name: value for name, value in os.environ.items() if name not in OF_BLENDER}
    try:
        return subprocess.Popen(line, env=environment, stdin=stdin, stdout=stdout, stderr=stderr)
    except OSError as error:
        raise CommandError(
            f"cannot run '{line[0]}': {error.strerror or error}. Install physgraph-usd in a Python of its own and "
            "give the path of its command in Edit > Preferences > Add-ons > PhysGraph Cloth"
        ) from error


class Run:
    """Command lines that run one after the other in processes of their own.

    Attributes:
        in_part: Whether the last one did some of its frames only.
    """

    def __init__(self, lines: list[list[str]], log: Path) -> None:
        """Start the first command line.

        Args:
            lines: The command lines.
            log: File that their words go to.

        Raises:
            CommandError: It cannot be started.
        """
        self.in_part = False
        self._left, self._log = list(lines), log
        self._log.write_bytes(b"")
        self._process = self._start()

    def poll(self) -> bool:
        """Whether all is done; starts the next command line when one has ended.

        Raises:
            CommandError: One failed.
        """
        code = self._process.poll()
        if code is None:
            return False
        self.in_part = code == IN_PART and not self._left
        if code != 0 and not self.in_part:
            raise CommandError(words_in(self._text()) or f"physgraph-usd ended with code {code} and said nothing")
        if self._left:
            self._process = self._start()
            return False
        return True

    def wait(self) -> None:
        """Run to the end.

        Raises:
            CommandError: A command line failed.
        """
        while not self.poll():
            self._process.wait()

    def warnings(self) -> list[str]:
        """The warnings so far."""
        return warnings_in(self._text())

    def progress(self) -> tuple[float, str]:
        """The part that is done, from 0 to 1, and what is being done."""
        return progress_in(self._text()) or (0.0, "reading the shot")

    def cancel(self) -> None:
        """End the running command; it removes what it had begun to write."""
        self._left = []
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(PATIENCE_SECONDS)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as log:
            return start(self._left.pop(0), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log)

    def _text(self) -> str:
        return self._log.read_text(encoding="utf-8", errors="replace")
