"""What the page says of a solved frame: the report's figures."""

from __future__ import annotations

from typing import Any


def figures(entry: dict[str, Any], *, seconds: float, vertices: int) -> dict[str, str]:
    """Figures of one garment in words, by name.

    Args:
        entry: What the solver tells of it, as a report's frame does.
        seconds: Wall time of the solve.
        vertices: Fine vertices.
    """
    told = {"Vertices": f"{vertices:,}"}
    if "energy_joules" in entry:
        told["Energy"] = f"{1e3 * sum(entry['energy_joules']['output'].values()):.4g} mJ"
    if "strain" in entry:
        told["Strain, 99th percentile"] = f"{100.0 * entry['strain']['p99']:.2g} %"
    contact = entry.get("contact", {})
    if "cloth" in contact:
        told["Crossings of cloth"] = str(contact["cloth"]["after"]["crossings"])
    if "bodies" in contact:
        inside = [body["after"]["inside"] for body in contact["bodies"].values()]
        told["Vertices inside bodies"] = str(sum(inside))
    if "levels" in entry:
        told["Evaluations"] = str(sum(level["evaluations"] for level in entry["levels"]))
    return told | {"Seconds": f"{seconds:.2f}", "Start": str(entry.get("start", ""))}
