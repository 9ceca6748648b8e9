"""``python -m physgraph_usd`` is the console command."""

from __future__ import annotations

from .cli import main

if __name__ == "__main__":
    main(prog_name="physgraph-usd")
