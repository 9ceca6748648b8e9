"""Writes what code and records hold into pages of docs/: `python -m docs.tables`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.films import SHOWN, Shown
from physgraph_usd.shot.warnings import advice_table
from physgraph_usd.usd.write.attribute_rules import rules_table

DOCS = Path(__file__).resolve().parent
FIGURES = DOCS / "films" / "figures.json"
START, END = "<!-- made by python -m docs.tables -->\n", "<!-- end -->\n"


def film_wall() -> str:
    """A grid of the films, each with its figures."""
    recorded = json.loads(FIGURES.read_text("utf-8"))
    cells = [film_cell(name, shown, recorded[name]) for name, shown in SHOWN.items() if name in recorded]
    return '<div class="wall">\n' + "".join(cells) + "</div>\n"


def film_cell(name: str, shown: Shown, figures: dict[str, Any]) -> str:
    """One film of the wall, its caption, with the sample's name, and its figures."""
    film = f'<video src="films/{name}.mp4" poster="films/{name}.jpg" autoplay controls loop muted playsinline></video>'
    sample = "" if shown.source else f" <code>{name}</code>"
    fine, (before, after) = f"{figures['fine']:,}", figures["crossings"]
    settled = figures["frames"] - figures["unsettled"]
    rows = {
        "cage": f"{figures['cage']:,}",
        "subdivided": fine,
        "refined": fine,
        "seconds": f"{figures['seconds']:.2f}",
        "crossings": f"{before:,} → {after:,}",
        "settled": f"{settled}/{figures['frames']}",
    }
    said = "".join(f"<div><dt>{kind}</dt><dd>{value}</dd></div>" for kind, value in rows.items())
    return f"<figure>{film}<figcaption>{shown.caption}{sample}</figcaption><dl>{said}</dl></figure>\n"


TABLES = {"trouble.md": advice_table, "layers.md": rules_table, "gallery.md": film_wall}
PAGES = [DOCS / name for name in TABLES]


def page_with_table(page: Path) -> str:
    """The text of a page with its table between its two comments."""
    before, _, rest = page.read_text("utf-8").partition(START)
    return f"{before}{START}{TABLES[page.name]()}{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    for each in PAGES:
        each.write_text(page_with_table(each), "utf-8")
