"""Writes tables that the code holds into pages of docs/: `python -m docs.tables`."""

from __future__ import annotations

from pathlib import Path

from physgraph_usd.shot.warnings import advice_table
from physgraph_usd.usd.write.attribute_rules import rules_table

TABLES = {"trouble.md": advice_table, "layers.md": rules_table}
PAGES = [Path(__file__).resolve().with_name(name) for name in TABLES]
START, END = "<!-- made by python -m docs.tables -->\n", "<!-- end -->\n"


def page_with_table(page: Path) -> str:
    """The text of a page with its table between its two comments."""
    before, _, rest = page.read_text("utf-8").partition(START)
    return f"{before}{START}{TABLES[page.name]()}{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    for each in PAGES:
        each.write_text(page_with_table(each), "utf-8")
