"""Solvers outside, each in the environment that a variable names: they move, settle, and find about our shape."""

import os
from pathlib import Path

import pytest

pytest.importorskip("matplotlib", reason="charts are drawn with matplotlib")
pytest.importorskip("plotly", reason="charts are drawn with plotly")

from shots import cloth_shot

from physgraph_usd.lab.chart.measure import UPSAMPLED
from physgraph_usd.lab.chart.options import ChartOptions
from physgraph_usd.lab.chart.peers.run import PEERS
from physgraph_usd.lab.chart.run import chart_shot
from physgraph_usd.lab.chart.table import Chart, Point

VARIABLES = {
    "newton": "PHYSGRAPH_NEWTON_PYTHON",
    "newton-xpbd": "PHYSGRAPH_NEWTON_PYTHON",
    "blender": "PHYSGRAPH_BPY_PYTHON",
}
"""What names the Python of each peer."""


def chart_with(peer: str, folder: Path) -> tuple[Chart, tuple[Point, ...]]:
    """A chart of a sheet with a peer, and the peer's flat curve."""
    python = os.environ.get(VARIABLES[peer])
    if not python:
        pytest.skip(f"{VARIABLES[peer]} does not name a Python that has {peer.partition('-')[0]}")
    options = ChartOptions(
        level=1,
        methods=("quasi-newton",),
        peers=(f"{peer}={python}",),
        count=1,
        repeats=1,
        budget_minutes=1.0,
        clock="cpu",
    )
    chart = chart_shot(cloth_shot(folder / "sheet.usda", size=(16, 12)), folder / "out", options)
    assert not chart.failed, chart.failed
    return chart, chart.curve(PEERS[peer].name)


@pytest.mark.slow
@pytest.mark.parametrize("peer", ["newton", "newton-xpbd"])
def test_a_peer_of_our_potential_closes_the_gap(peer: str, tmp_path: Path):
    _, points = chart_with(peer, tmp_path)
    assert points[-1].gap < 0.5 * points[0].gap
    assert points[-1].gap < 0.3
    assert all(point.gap > -1e-3 for point in points), "nobody finds less than the least energy"


@pytest.mark.slow
@pytest.mark.blender
def test_blenders_cloth_settles_near_our_shape(tmp_path: Path):
    """Its energy is another, so not the gap is asked for: strain goes where ours does, and the shape comes nearer."""
    chart, points = chart_with("blender", tmp_path)
    [start], least = chart.curve(UPSAMPLED), min(chart.curve("quasi-newton"), key=lambda point: point.gap)
    last = points[-1]
    assert last.apart_mm is not None
    assert start.apart_mm is not None
    assert last.apart_mm < 0.7 * start.apart_mm
    assert last.strain == pytest.approx(least.strain, rel=0.5)
    assert last.strain < 0.7 * start.strain
    assert abs(points[-1].energy - points[-2].energy) < 0.1 * abs(start.energy - last.energy), "it settles"
    assert "own energy" in last.method
