"""What `benchmarks.knobs` says of a sheet whose edge points of the last subdivision stand off by a known height."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pxr", reason="benchmarks read stages with usd-core")

from benchmarks.knobs import kinds_of, refinements_of, standing_off
from physgraph_usd.lab.samples.shapes import square
from physgraph_usd.solver.mesh.subdivide import compose, fine_count
from physgraph_usd.solver.mesh.topology import PolygonMesh


def test_raised_kind_stands_off_by_its_height() -> None:
    """All four neighbours of a raised edge point are low, and all of a low vertex's are raised."""
    points, quads, _ = square(1.0, 6, 0.0)
    cage = PolygonMesh(np.full(len(quads), 4), quads.ravel(), len(points))
    refinements = refinements_of(cage, fine_count(cage, 2))
    fine = compose(refinements) @ points
    first = refinements[-1].parent_vertex_count
    fine[first : first + len(refinements[-1].edges), 1] += 1e-3
    off = standing_off(refinements[-1].mesh, fine)
    means = {kind: off[own].mean() for kind, own in kinds_of(cage, refinements).items()}
    assert list(means) == ["the cage's own", "edge points 1", "face points 1", "edge points 2", "face points 2"]
    raised = np.sign(means["edge points 2"])
    expected = {kind: raised * (1e-3 if kind == "edge points 2" else -1e-3) for kind in means}
    assert means == pytest.approx(expected, rel=1e-2)


def test_a_layer_of_another_cage_is_refused() -> None:
    """No subdivision of one quad has ten vertices."""
    with pytest.raises(ValueError, match="10 vertices"):
        refinements_of(PolygonMesh(np.array([4]), np.arange(4), 4), 10)
