"""The command: each defect is put into a copy of the repository, and its tests run there."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click

from .entries import PACKAGE, Mutation, mutated, place_of, read_list

ROOT = Path(__file__).resolve().parents[2]
COPIED = (PACKAGE, "tests", "schemas", "samples", "pyproject.toml", "README.md", "Makefile")
FAILED_TESTS = 1
"""pytest's exit code when tests ran and some failed; any other but 0 means that none could run."""


@click.command()
@click.option("--only", default="", metavar="TEXT", help="Only defects whose name, file or tests have this in them.")
@click.option("--seconds", default=300.0, show_default=True, help="Time limit of one defect; a hang counts as caught.")
@click.option("--sound", is_flag=True, help="First see that all named tests pass without a defect.")
def main(*, only: str, seconds: float, sound: bool) -> None:
    """Break the package on purpose, one defect at a time, and see that the tests notice.

    Exit code 1 when a defect is missed or a test does not run.
    """
    chosen = [each for each in read_list() if any(only in text for text in (each.name, each.file, *each.tests))]
    missed = []
    with tempfile.TemporaryDirectory(prefix="physgraph-mutations-") as folder:
        root = Path(folder)
        _copy(root)
        if sound and _run(sorted({test for each in chosen for test in each.tests}), root, seconds * len(chosen))[0]:
            raise click.ClickException("the named tests fail without any defect")
        for mutation in chosen:
            began = time.monotonic()
            verdict, by = _try(mutation, root, seconds)
            missed += [mutation.name] if verdict != "caught" else []
            click.echo(f"{verdict:8} {time.monotonic() - began:6.1f} s  {mutation.name}  ({mutation.file})  {by}")
    click.echo(f"{len(chosen) - len(missed)} of {len(chosen)} caught")
    sys.exit(1 if missed else 0)


def _copy(root: Path) -> None:
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, root / name, ignore=shutil.ignore_patterns("__pycache__", "*.pyc"))
        elif source.is_file():
            shutil.copy(source, root / name)


def _try(mutation: Mutation, root: Path, seconds: float) -> tuple[str, str]:
    """Put one defect in, run its tests, take it out again; the verdict and the test that noticed."""
    file = place_of(mutation, root)
    sound = file.read_text(encoding="utf-8")
    file.write_text(mutated(mutation, root), encoding="utf-8")
    try:
        code, said = _run(mutation.tests, root, seconds)
    except subprocess.TimeoutExpired:
        return "caught", "by a hang"
    finally:
        file.write_text(sound, encoding="utf-8")
    noticed = next((line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))), "")
    verdict = {0: "MISSED", FAILED_TESTS: "caught"}.get(code, "NOT RUN")
    return verdict, noticed.split(" - ")[0] if verdict == "caught" else said[-300:] if verdict == "NOT RUN" else ""


def _run(tests: list[str], root: Path, seconds: float) -> tuple[int, str]:
    """Run tests of the copy until one fails."""
    line = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(line, cwd=root, env=environment, capture_output=True, text=True, check=False, timeout=seconds)
    return done.returncode, done.stdout
