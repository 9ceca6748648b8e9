"""The list of defects, and how one is put into a copy of the package."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "physgraph_usd"
LIST = Path(__file__).with_name("list.toml")


@dataclass(frozen=True)
class Mutation:
    """One defect.

    Attributes:
        name: What it does, in a few words.
        file: File of the package where the old text was last seen.
        old: Text that occurs once.
        new: What takes its place.
        breaks: What is wrong then.
        tests: Test files, or tests in them, that must fail.
    """

    name: str
    file: str
    old: str
    new: str
    breaks: str
    tests: list[str]


def read_list() -> list[Mutation]:
    """Every defect, in the list's order."""
    return [Mutation(**entry) for entry in tomllib.loads(LIST.read_text(encoding="utf-8"))["mutation"]]


def place_of(mutation: Mutation, root: Path) -> Path:
    """The file that has the old text: the one named, or where it was moved to.

    Args:
        mutation: The defect.
        root: Folder that holds the package.

    Raises:
        LookupError: The text is in no file, in several, or several times in one.
    """
    named = root / PACKAGE / mutation.file
    files = [named] if named.is_file() and mutation.old in named.read_text(encoding="utf-8") else []
    files = files or [
        file for file in sorted((root / PACKAGE).rglob("*.py")) if mutation.old in file.read_text(encoding="utf-8")
    ]
    if len(files) != 1:
        raise LookupError(
            f"'{mutation.name}': the old text is in {len(files)} files of {PACKAGE}; {mutation.file} had it"
        )
    count = files[0].read_text(encoding="utf-8").count(mutation.old)
    if count != 1:
        raise LookupError(f"'{mutation.name}': the old text occurs {count} times in {files[0]}")
    return files[0]


def mutated(mutation: Mutation, root: Path) -> str:
    """The file's text with the defect in it."""
    return place_of(mutation, root).read_text(encoding="utf-8").replace(mutation.old, mutation.new)
