"""The paper's results, each with its command, its figure and ours.

    python -m benchmarks.paper [--short] [--only NAME] [--fresh] [-o benchmarks/results/paper.md]

What was measured lies in a journal, a part the moment it is known: a run that was stopped goes on where it was, while
the code is the same. Rows of a GPU are read from benchmarks/results/step_cuda.json, which `python -m benchmarks.step`
writes.
"""

from __future__ import annotations

from pathlib import Path

import click
import torch

import physgraph_usd
from benchmarks import convergence, step, temporal
from benchmarks.paper import contact, forces, loose, materials, potentials, skinning
from benchmarks.paper.page import Part, page
from benchmarks.rows import Journal, code_of
from physgraph_usd.shot.solve import prepare_device

PAGE = Path("benchmarks/results/paper.md")
CACHE = Path("build")
"""Folder of the journals."""
PARTS = (
    Part("potentials", "Potentials and body collision", potentials.measure),
    Part("timing", "Time", step.measure, 30.0),
    Part("convergence", "Convergence", convergence.rows, 2.0),
    Part("forces", "Forces, one after another", forces.measure, 4.0),
    Part("loose", "A loose garment against a converged solve", loose.measure),
    Part("skinning", "Linear-blend skinning repaired", skinning.measure, 5.0),
    Part("materials", "Materials", materials.measure, 4.0),
    Part("colliders", "Block and torus", contact.colliders),
    Part("itself", "Self collision", contact.itself),
    Part("several", "Several garments", contact.several, 10.0),
    Part("temporal", "A sequence", temporal.rows, 4.0),
)
"""The page, from top to bottom."""


@click.command()
@click.option("--short", is_flag=True, help="Some 20 minutes of processor time.")
@click.option("-o", "--out", type=click.Path(dir_okay=False, path_type=Path), default=PAGE, help="Page to write.")
@click.option("--only", multiple=True, type=click.Choice([part.name for part in PARTS]), help="Measure only these.")
@click.option("--fresh", is_flag=True, help="Measure everything anew.")
def main(short: bool, out: Path, only: tuple[str, ...], fresh: bool) -> None:
    """Measure what is not yet known; write the page, or print the parts that are named."""
    prepare_device("cpu")
    form = "short" if short else "long"
    code = code_of(Path(physgraph_usd.__file__).parent, Path(__file__).parents[1])
    parts = [part for part in PARTS if not only or part.name in only]
    with torch.no_grad():
        text = page(parts, Journal(CACHE / f"results.{form}.{code}.jsonl", fresh=fresh), short=short)
    if only:
        click.echo(text)
        return
    out.write_text(text, encoding="utf-8")
    click.echo(out)


if __name__ == "__main__":
    main()
