"""The command: mutants in child processes, a table of outcomes by kind, failing mutants kept in a folder."""

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import click

from .bases import write_bases
from .kinds import KINDS
from .pool import clear, describe_dead, run_all, serve
from .trial import BAD, GOOD, Outcome, attempt, keep


@click.command()
@click.option("--mutants", default=2000, show_default=True, help="How many.")
@click.option("--first", default=0, show_default=True, help="Number of the first.")
@click.option("--only", type=int, metavar="NUMBER", help="Try this one in this process and keep it.")
@click.option("--kind", default="", metavar="TEXT", help="Only kinds whose name has this in it.")
@click.option("--jobs", default=2, show_default=True, help="Child processes.")
@click.option("--seconds", default=30.0, show_default=True, help="Time limit of one mutant.")
@click.option("--failures", type=click.Path(path_type=Path), default=Path("out/fuzz"), show_default=True)
@click.option("--serve", "service", nargs=2, type=click.Path(path_type=Path), hidden=True)
def main(
    *,
    mutants: int,
    first: int,
    only: int | None,
    kind: str,
    jobs: int,
    seconds: float,
    failures: Path,
    service: tuple[Path, Path] | None,
) -> None:
    """Break sound shots on purpose and see that each ends in a valid layer or an error that says why not.

    The same number is always the same mutant. Exit code 1 when one ends otherwise.
    """
    if service:
        serve(*service)
        return
    with tempfile.TemporaryDirectory(prefix="physgraph-fuzz-") as folder:
        bases, work = Path(folder) / "bases", Path(folder) / "work"
        write_bases(bases)
        work.mkdir()
        if only is not None:
            sys.exit(_one(only, bases, work, failures))
        numbers = [n for n in range(first, first + mutants) if kind in KINDS[n % len(KINDS)].name]
        tally = Tally(work, failures, len(numbers))
        run_all(numbers, bases, work, jobs=jobs, seconds=seconds, done=tally.add)
    click.echo("\n".join(tally.table()))
    sys.exit(1 if tally.failed else 0)


def _one(number: int, bases: Path, work: Path, failures: Path) -> int:
    """Try one mutant here, show everything about it and keep its folder."""
    outcome = attempt(number, KINDS, bases, work / str(number))
    failures.mkdir(parents=True, exist_ok=True)
    folder = keep(outcome, work / str(number), failures)
    click.echo(f"mutant {number}, {outcome.kind}: {outcome.result}\n{outcome.detail}")
    click.echo("\n".join([*outcome.said, *outcome.noise, f"kept in {folder}"]))
    return 0 if outcome.result in GOOD else 1


class Tally:
    """Counts outcomes, keeps the failed mutants and shows how far it is."""

    def __init__(self, work: Path, failures: Path, total: int) -> None:
        self._work, self._failures, self._total = work, failures, total
        self._counts: Counter[tuple[str, str]] = Counter()
        self._noise: Counter[str] = Counter()
        self._began = time.monotonic()
        self.failed: list[Outcome] = []

    def add(self, outcome: Outcome) -> None:
        folder = self._work / str(outcome.number)
        if outcome.result in {"hang", "died"}:
            describe_dead(outcome, folder)
        self._counts[outcome.kind, outcome.result] += 1
        self._noise.update(outcome.noise)
        if outcome.result in BAD:
            self.failed.append(outcome)
            self._failures.mkdir(parents=True, exist_ok=True)
            keep(outcome, folder, self._failures)
        clear(folder)
        count = sum(self._counts.values())
        if count % 100 == 0 or count == self._total:
            seconds = time.monotonic() - self._began
            left = seconds / count * (self._total - count)
            click.echo(f"{count} of {self._total}, {len(self.failed)} failed, {left:.0f} s left", err=True)

    def table(self) -> list[str]:
        """The table by kind, the failures one by one, and the warnings that got out."""
        shown = [result for result in (*GOOD, *BAD) if any(key[1] == result for key in self._counts)]
        lines = [" ".join([f"{'mutation':26}", f"{'mutants':>8}", *(f"{name:>14}" for name in shown)])]
        for name in [*dict.fromkeys(kind.name for kind in KINDS), "", "all"]:
            row = [sum(n for (k, r), n in self._counts.items() if name in (k, "all") and r == res) for res in shown]
            if sum(row):
                lines.append(" ".join([f"{name:26}", f"{sum(row):>8}", *(f"{count:>14}" for count in row)]))
        for outcome in sorted(self.failed, key=lambda outcome: outcome.number):
            last = outcome.detail.strip().splitlines()[-1:] or [""]
            lines.append(f"{outcome.number}: {outcome.kind}: {outcome.result}: {last[0][:300]}")
        lines += [f"warning seen {count} times: {text}" for text, count in self._noise.most_common()]
        return lines
