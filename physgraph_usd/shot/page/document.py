"""Parts of a page: the document, tables, and the shared style."""

from __future__ import annotations

import html
from collections.abc import Sequence

STYLE = """
:root { --ink: #26282c; --faint: #606468; --line: #e2e2e2 }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1160px; padding: 0 1rem; color: var(--ink) }
h1 { font-size: 1.35rem; margin-bottom: .3rem } h2 { font-size: 1.12rem; margin-top: 2.4rem }
h3 { font-size: .95rem; margin: 1.2rem 0 0; font-weight: 600 }
p.note, figcaption { color: var(--faint); font-size: .9rem } .wide { overflow-x: auto }
table { border-collapse: collapse; font-size: .9rem } th { font-weight: 600 }
th, td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top }
td.number, th.number { text-align: right }
ul.warnings { padding-left: 1.2rem } ul.warnings li { margin: .25rem 0 }
figure { margin: 1rem 0 } img { max-width: 100%; border: 1px solid var(--line) }
svg.plot { display: block; width: 100%; height: auto; overflow: visible; font-size: 11px }
svg.plot .grid { stroke: #ececec } svg.plot .cursor { stroke: #9a9a9a; visibility: hidden }
svg.plot text { fill: var(--faint) } .legend { font-size: .85rem; color: var(--faint) }
.legend span { margin-right: 1.1rem; white-space: nowrap } .legend i { display: inline-block; width: 1.1em;
height: .25em; margin-right: .35em; vertical-align: middle } .legend b { color: var(--ink); font-weight: 500 }
"""


def document(title: str, body: str, *, script: str = "") -> str:
    """A whole page.

    Args:
        title: Title, plain text.
        body: HTML.
        script: JavaScript run after loading.
    """
    head = f"<meta charset='utf-8'><title>{html.escape(title)}</title><link rel='icon' href='data:,'>"
    last = f"<script>{script}</script>" if script else ""
    return (
        f"<!doctype html>\n<html lang='en'><head>{head}<meta name='viewport' content='width=device-width'>"
        f"<style>{STYLE}</style></head>\n<body>{body}{last}</body></html>\n"
    )


def table(name: str, head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Sequence[int] = ()) -> str:
    """A table of plain text.

    Args:
        name: The element's id.
        head: Titles of the columns.
        rows: Cells.
        numbers: Columns aligned to the right.
    """

    def cells(values: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{' class=number' if column in numbers else ''}>{html.escape(value)}</{tag}>"
            for column, value in enumerate(values)
        )

    lines = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f"<div class='wide'><table id='{name}'><tr>{cells(head, 'th')}</tr>{lines}</table></div>"
