"""Writes what code and records hold into pages of docs/: `python -m docs.tables`."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from benchmarks.films import SHOWN, Shown
from physgraph_usd.cli import main
from physgraph_usd.shot.findings.table import advice_tables
from physgraph_usd.usd.schema_files import attribute_table
from physgraph_usd.usd.write.attribute_rules import rules_table

DOCS = Path(__file__).resolve().parent
REPORT_SCHEMA = DOCS.parent / "physgraph_usd" / "shot" / "report.schema.json"
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


def commands_table() -> str:
    """Every command with its help and its options, each group of options as a table."""
    context = click.Context(main, info_name="physgraph-usd")
    return "\n".join("\n".join(_command(context, command)) for command in main.commands.values())


def _command(parent: click.Context, command: click.Command) -> Iterator[str]:
    """Markdown lines of one command."""
    context = click.Context(command, parent=parent, info_name=command.name, **parent.command.context_settings)
    usage = " ".join(command.collect_usage_pieces(context))
    yield f"## {command.name}\n\n`physgraph-usd {command.name} {usage}`\n\n{inspect.cleandoc(command.help or '')}\n"
    groups: dict[str, list[tuple[str, str]]] = {}
    for option in command.params:
        record = option.get_help_record(context) if isinstance(option, click.Option) else None
        if record is not None:
            groups.setdefault(getattr(option, "heading", "Options"), []).append(record)
    for heading, records in groups.items():
        yield f"| {heading} | |\n|---|---|"
        yield from (f"| `{_cell(names)}` | {_cell(text)} |" for names, text in records)
        yield ""


def report_table() -> str:
    """The fields of the report, a table for each kind of record in its JSON Schema."""
    schema = json.loads(REPORT_SCHEMA.read_text("utf-8"))
    records = {"report": schema, **schema["$defs"]}
    return "\n".join(f"## {name}\n\n{_fields(record)}" for name, record in records.items())


def _fields(record: Mapping[str, Any]) -> str:
    """The fields of one record as a table."""
    rows = (f"| `{name}` | {_type(kind)} | {_cell(kind.get('description', ''))} |\n" for name, kind in _leaves(record))
    return f"| field | type | meaning |\n|---|---|---|\n{''.join(rows)}"


def _leaves(record: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Names and types of the fields of a record, and of the records inside it that have no name of their own."""
    for name, kind in record["properties"].items():
        yield f"{prefix}{name}", kind
        if "properties" in kind:
            yield from _leaves(kind, f"{prefix}{name}.")


def _type(kind: Mapping[str, Any]) -> str:
    """A type of JSON in words, with a link to the table of a named record."""
    if "anyOf" in kind:
        return " or ".join(map(_type, kind["anyOf"]))
    if "$ref" in kind:
        name = kind["$ref"].rpartition("/")[2]
        return f"[{name}](#{name})"
    if "const" in kind or "enum" in kind:
        return " or ".join(map(str, kind.get("enum", [kind.get("const")])))
    names = [kind["type"]] if isinstance(kind["type"], str) else kind["type"]
    words = " or ".join(names)
    if "items" in kind:
        return f"{words} of {_type(kind['items'])}"
    inside = kind.get("additionalProperties")
    if not inside:
        return words
    body = inside["properties"]["after"] if "properties" in inside else inside
    return f"{words} of {_type(body)}"


def _cell(text: str) -> str:
    """Text for a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


TABLES = {
    "attributes.md": attribute_table,
    "commands.md": commands_table,
    "gallery.md": film_wall,
    "layers.md": rules_table,
    "report.md": report_table,
    "trouble.md": advice_tables,
}
PAGES = [DOCS / name for name in TABLES]


def page_with_table(page: Path) -> str:
    """The text of a page with its table between its two comments."""
    before, _, rest = page.read_text("utf-8").partition(START)
    return f"{before}{START}{TABLES[page.name]()}{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    for each in PAGES:
        each.write_text(page_with_table(each), "utf-8")
