"""The list of defects, and how one is put into a copy of the package."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "physgraph_usd"
LIST = Path(__file__).with_name("list.toml")


@dataclass(frozen=True)
class Mutation:
    """A defect: text that occurs once, what takes its place, what is wrong then, and the tests that must fail."""

    name: str
    file: str
    old: str
    new: str
    breaks: str
    tests: list[str]


def read_list() -> list[Mutation]:
    return [Mutation(**entry) for entry in tomllib.loads(LIST.read_text(encoding="utf-8"))["mutation"]]


def place_of(mutation: Mutation, root: Path) -> Path:
    """The file that has the old text: the one named, or where it was moved to."""
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
