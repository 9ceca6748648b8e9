"""One mutant: a sound shot, broken on purpose in a way that its number decides."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pxr import Sdf, Tf, Usd

T = TypeVar("T")
SEED = 20
SHOT = "shot.usda"


@dataclass
class Draft:
    """A shot being broken: its folder, the mutant's own generator, the shot's file, what was done, and its options."""

    folder: Path
    rng: np.random.Generator
    name: str = SHOT
    said: list[str] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def shot(self) -> Path:
        return self.folder / self.name

    def pick(self, choices: Sequence[T]) -> T:
        return choices[int(self.rng.integers(len(choices)))]

    def chance(self, part: float) -> bool:
        """True in a part of the mutants."""
        return bool(self.rng.random() < part)

    def open(self) -> Usd.Stage:
        """The shot as a stage; edits go to its root layer."""
        return Usd.Stage.Open(str(self.shot))

    def save(self, stage: Usd.Stage, said: str) -> None:
        stage.GetRootLayer().Save()
        self.said.append(said)

    def files(self) -> list[Path]:
        """The shot's layers, the root first."""
        others = sorted(file for file in self.folder.iterdir() if file.suffix.startswith(".usd") and file != self.shot)
        return [self.shot, *others]

    def as_crate(self) -> None:
        layer = Sdf.Layer.FindOrOpen(str(self.shot))
        layer.Export(str(self.folder / "shot.usdc"))
        self.shot.unlink()
        self.name = "shot.usdc"


Mutation = Callable[[Draft], None]


@dataclass(frozen=True)
class Kind:
    """One way to break shots; not `in_process` where USD itself may crash."""

    name: str
    mutate: Mutation
    bases: tuple[str, ...]
    in_process: bool = True


def make(number: int, kinds: Sequence[Kind], bases: Path, folder: Path) -> tuple[Kind, Draft]:
    """Make one mutant in a new folder: its number decides the kind in turn, the shot and the damage."""
    kind = kinds[number % len(kinds)]
    rng = np.random.default_rng([SEED, number])
    base = kind.bases[int(rng.integers(len(kind.bases)))]
    shutil.copytree(bases / base, folder)
    draft = Draft(folder, rng, said=[f"shot '{base}'"])
    draft.options = _options(draft)
    try:
        kind.mutate(draft)
    except Tf.ErrorException as error:  # the file stays as it was when USD refused
        draft.said.append(f"USD refused: {str(error).splitlines()[-1]}")
    return kind, draft


def _options(draft: Draft) -> dict[str, Any]:
    """Options in the ordinary range, so that every path of writing is met."""
    options: dict[str, Any] = {"level": 1, "steps": 3}
    if draft.chance(0.2):
        options["mode"] = "sibling"
    if draft.chance(0.2):
        options["velocities"] = True
    if draft.chance(0.15):
        options["root"] = draft.folder / "out.root.usda"
    if draft.chance(0.1):
        options["frames"] = (1.0, 1.0)
    if draft.chance(0.1):
        options["temporal"] = draft.pick(["warm", "off"])
    if draft.chance(0.1):
        options["integrator"] = draft.pick(["quasi-newton", "physgraph"])
    return options
