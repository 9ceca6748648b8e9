"""``python -m tests.stability.report``: the cases S1 to S40 by method; writes benchmarks/results/stability.md.

A cell says whether the case passed and what was measured. Cases that no integrator decides have one figure for all.
"""

import contextlib
import platform
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import click
import report_contact as contact
import report_solver as solver
import report_stages as stages
import warp as wp
from report_solver import Result

import physgraph_usd
from benchmarks.rows import Journal, code_of, commit
from physgraph_usd.errors import PhysGraphError
from physgraph_usd.lab.methods import METHODS

PAGE = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "stability.md"


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        number: 1 to 40.
        title: What it is.
        bound: What passes.
        by_method: Measures one method, or None.
        once: Measures what no method decides, or None.
        left_out: Why it is not measured, or "".
    """

    number: int
    title: str
    bound: str
    by_method: Callable[[str], Result] | None = None
    once: Callable[[], Result] | None = None
    left_out: str = ""


CASES = (
    Case(
        1, "one triangle, one edge, no face, isolated points", "finite; isolated points stay", solver.s1_almost_nothing
    ),
    Case(2, "faces without area, repeated or doubled", "others move under 1 % of the displacement", solver.s2_faults),
    Case(3, "needles of aspect 1e4", "no step over an edge", solver.s3_needles),
    Case(4, "a fin, a bow-tie, a face wound the other way", "finite, energy falls", solver.s4_fins),
    Case(5, "NaN in one point of one frame", "other frames to the bit", stages.s5_broken_point),
    Case(6, "mirrored cloth", "mirrored answer to 1e-5 edges", solver.s6_mirror),
    Case(7, "a hundredth of the size", "same shape to 1e-4 edges", solver.s7_units),
    Case(8, "stiffness x 1e-3 to 1e3", "gap under 10 % in 200 steps", solver.s8_stiffness),
    Case(9, "levels 0 to 3", "gap under 10 % in 200 steps", solver.s9_resolution),
    Case(10, "a patch alone, and beside 100 times its area", "difference under 1 %", solver.s10_patch),
    Case(11, "turned, and 3e5 m away, float32", "2e-2 edges", solver.s11_far_and_turned),
    Case(12, "no force; weight x 1e6", "no move (1e-5 edges); finite, or refused by name", solver.s12_forces),
    Case(13, "flat sheet squeezed by a tenth", "wrinkles take up half the energy", solver.s13_saddle),
    Case(14, "a hinge at and past half a turn", "gradient to 1e-4", once=stages.s14_folds),
    Case(15, "crumpled ball, noise of three edges", "energy / 10 in 200 steps", solver.s15_crumpled),
    Case(16, "rest points not finite or out of bounds", "refused by name", once=stages.s16_rest_shapes),
    Case(17, "one pin, all pinned", "to the bit", solver.s17_pins),
    Case(18, "open colliders, wound either way and both", "none pushed through", contact.s18_open),
    Case(19, "card of 0.2 mm or pane between two layers", "none changes sides", contact.s19_thin),
    Case(20, "15 cm deep in a ball; past the middle of a torso", "none left inside", contact.s20_deep),
    Case(
        21,
        "pinched in half a millimetre; by parts that overlap",
        "to 1 mm; to a cage edge; 0.2 mm in eight frames",
        contact.s21_pinched,
    ),
    Case(22, "collider that swallows the cloth", "what stays in is told; filtered to the bit", contact.s22_swallowed),
    Case(23, "vertices exactly on a surface", "all rise, none slides 0.1 mm", contact.s23_on_the_surface),
    Case(24, "two sheets crossing: dented, cornered, tilted", "all apart", contact.s24_crossed),
    Case(25, "a sleeve through the cloth of a torso", "never more, under 2 edges", contact.s25_contours),
    Case(26, "ten layers at half their thickness", "drift under a tenth of it", contact.s26_stacked),
    Case(27, "pulled through a torus, laid on needles", "no new crossings, none inside", contact.s27_scenes),
    Case(28, "two garments with a shared seam", "opens under 0.1 mm", contact.s28_seams),
    Case(29, "the cage jumps 2 m or turns by half", "as where it stays, to 1e-3 edges", solver.s29_teleport),
    Case(30, "collider that moves five edges a frame", "none inside or under", contact.s30_fast),
    Case(31, "gaps and odd sample times", "samples at the authored times", stages.s31_times),
    Case(32, "topology that changes", "named, other frames written", once=stages.s32_topology),
    Case(33, "single against double precision", "1e-4 edges; CUDA in tests/test_cuda.py", solver.s33_precision),
    Case(34, "five runs, one to four threads", "the same bytes", solver.s34_repeats),
    Case(35, "a hundred equal frames", "the same bytes", solver.s35_frozen),
    Case(36, "ten passes over its own output", "energy falls, changes decay", solver.s36_drift),
    Case(37, "guarded; and adversaries under the guard", "energy never rises", solver.s37_guard, stages.s37_adversary),
    Case(38, "constants, cantilever on three kinds of mesh", "5 %", once=stages.s38_analytic),
    Case(39, "waves of 0.5, 1, 2, 3 and 8 edges", "warned under four edges", once=stages.s39_locking),
    Case(40, "every force against differences of its energy", "1e-6", once=stages.s40_gradients),
)


def cell(measure: Callable[[], Result]) -> tuple[bool, str]:
    """Whether a measurement passed, and its cell."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = measure()
    except (PhysGraphError, RuntimeError, ValueError, ArithmeticError, LookupError) as error:
        return False, f"**fail** {type(error).__name__}"
    return bool(result.held), f"pass {result.figure}" if result.held else f"**fail** {result.figure}"


def row(case: Case, names: list[str], journal: Journal) -> tuple[list[bool], str]:
    """Which cells of a case passed, and its row."""
    head = f"| S{case.number} | {case.title} | {case.bound} |"

    def known(column: str, measure: Callable[[], Result]) -> tuple[bool, str]:
        return tuple(journal.get(f"S{case.number} {column}", partial(cell, measure)))

    if case.left_out:
        return [], f"{head} {case.left_out} |" + " |" * len(names)
    found = [known("all", case.once)] if case.once else []
    once = found[0][1] if found else "n/a"
    columns = []
    if case.by_method:
        columns = [known(name, partial(case.by_method, name)) for name in names]
    shown = [text for _, text in columns] or ["n/a"] * len(names)
    return [held for held, _ in found + columns], f"{head} {once} | {' | '.join(shown)} |"


def cells_of(page: str) -> dict[tuple[str, str], bool]:
    """Whether each measured cell of a page passed, by case and column."""
    rows = [[part.strip() for part in line.strip("|").split("|")] for line in page.splitlines() if line.startswith("|")]
    (head, _, *cases), first = rows, rows[0].index("all")
    cells = {(row[0], name): text for row in cases for name, text in zip(head[first:], row[first:], strict=True)}
    return {key: text.startswith("pass") for key, text in cells.items() if text.startswith(("pass", "**fail**"))}


TEXT = """# Stability

Where methods fail, case by case, at commit {commit}. Written by `python -m tests.stability.report{form}` in
{minutes:.0f} minutes of processor time ({machine}; float64 unless a case says otherwise, float32 where something is
touched). {long} The measurements are in `report_solver.py`, `report_contact.py` and `report_stages.py` beside
it; the tests in that folder hold `quasi-newton` to bounds. What a test there expects to fail fails here too, with its
figure.

A cell says whether the case passed and what was measured. "all" is for what no method decides; n/a means that the case
does not concern the column. `adam`, `gd` and the learned `physgraph` and `physgraph-paper` are guarded; `quasi-newton`,
`newton` and `physgraph` are nested, the others start at the finest level, where nothing that starts crossed is drawn
apart. `physgraph`, nested, is what refine takes by default.
{passed} of {measured} measured cells pass; of `quasi-newton`'s and of those under "all" {own} of {all_own}.

{table}
"""
SLOW = "physgraph-paper"
"""The column that takes as long as all others; the short form leaves it out."""
LONG_MINUTES = 30
HERE = Path(__file__).resolve().parent
CELLS = Path("build") / f"stability.{code_of(Path(physgraph_usd.__file__).parent, HERE)}.jsonl"
"""Cells of this code."""


@click.command()
@click.option("--case", "chosen", type=int, multiple=True, help="Only this case: prints it, writes and keeps nothing.")
@click.option("--short", is_flag=True, help=f"Leave out {SLOW}; less than 15 minutes on two cores.")
@click.option("--fresh", is_flag=True, help="Measure every cell anew.")
@click.option("-o", "--out", type=click.Path(dir_okay=False, path_type=Path), default=PAGE, help="Page to write.")
def main(chosen: tuple[int, ...], short: bool, fresh: bool, out: Path) -> None:
    """Measure the cases S1 to S40 by method and write the table."""
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    names = [name for name in METHODS if not (short and name == SLOW)]
    journal = Journal(None if chosen else CELLS, fresh=fresh)
    lines = [f"| case | what | passes | all | {' | '.join(names)} |", "|---" * (4 + len(names)) + "|"]
    every: list[bool] = []
    own: list[bool] = []
    for case in CASES:
        if chosen and case.number not in chosen:
            continue
        with contextlib.redirect_stdout(sys.stderr):
            held, line = row(case, names, journal)
        every += held
        own += held[: bool(case.once) + bool(case.by_method)]
        lines.append(line)
        click.echo(line, err=True)
    table = "\n".join(lines)
    if chosen:
        click.echo(table)
        return
    figures = {"passed": sum(every), "measured": len(every), "own": sum(own), "all_own": len(own)}
    form, long = (" --short", f"With `{SLOW}`, without --short, it takes about {LONG_MINUTES}.") if short else ("", "")
    words = {"form": form, "long": long, "minutes": journal.seconds() / 60.0, "machine": f"{platform.machine()}, CPU"}
    words["commit"] = commit("tests/stability")
    out.write_text(TEXT.format(table=table, **words, **figures), encoding="utf-8")
    click.echo(out)


if __name__ == "__main__":
    main()
