"""Writes the table of warnings into docs/trouble.md: `python -m docs.warnings_table`."""

from __future__ import annotations

from pathlib import Path

from physgraph_usd.shot.warnings import advice_table

PAGE = Path(__file__).resolve().with_name("trouble.md")
START, END = "<!-- made by python -m docs.warnings_table -->\n", "<!-- end -->\n"


def page_with_table(page: str) -> str:
    """The page with the table of warnings between its two comments."""
    before, _, rest = page.partition(START)
    return f"{before}{START}{advice_table()}{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    PAGE.write_text(page_with_table(PAGE.read_text("utf-8")), "utf-8")
