"""Hook of the site: each notebook is a page, with the outputs that it was saved with."""

from __future__ import annotations

import json
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add a page for each notebook."""
    for each in [file for file in files if file.src_uri.endswith(".ipynb")]:
        cells = json.loads(each.content_string)["cells"]
        place = each.src_uri.replace(".ipynb", ".md")
        files.append(File.generated(config, place, content="\n\n".join(map(cell_text, cells))))


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Let links to notebooks, which a checkout follows, go to their pages."""
    return markdown.replace(".ipynb)", ".md)")


def cell_text(cell: dict[str, Any]) -> str:
    """A cell with its outputs, in Markdown."""
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return source
    return "\n\n".join([f"```python\n{source}\n```", *map(output_text, cell["outputs"])])


def output_text(output: dict[str, Any]) -> str:
    """What a cell printed or drew."""
    if "text" in output:
        return f"```text\n{''.join(output['text'])}```"
    return f"![Output](data:image/png;base64,{output['data']['image/png']})"
