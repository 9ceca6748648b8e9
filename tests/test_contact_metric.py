"""The preconditioner of cloth that something touches."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch

from physgraph_usd.solver.contact import metric as contact_metric
from physgraph_usd.solver.contact.frame import LevelContact
from physgraph_usd.solver.contact.metric import HeldMetric
from physgraph_usd.solver.forces.contact import Contact
from physgraph_usd.solver.integrate.metric import Metric


def chain(count: int = 12) -> tuple[Metric, np.ndarray]:
    """Springs in a row, held by their ground, and their matrix."""
    matrix = sp.csr_matrix(2.5 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
    free = torch.ones((count, 1), dtype=torch.bool)
    return Metric(matrix, free=free, dtype=torch.float64), matrix.toarray()


class TestHeldMetric:
    def test_it_is_what_its_docstring_says(self):
        plain, matrix = chain()
        stiff = torch.linspace(0.0, 5.0, 12, dtype=torch.float64)
        force = torch.randn((12, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(3))
        held = matrix + np.diag(stiff.numpy())
        let = np.diag(np.sqrt(np.diag(matrix) / np.diag(held)))
        smooth = let @ np.linalg.solve(matrix, let @ force.numpy())
        rough = force.numpy() / np.diag(held)[:, None]
        answer = contact_metric.SMOOTH * smooth + contact_metric.ROUGH * rough
        metric = HeldMetric(plain, stiff)
        np.testing.assert_allclose(metric.solve(force).numpy(), answer, rtol=1e-6, atol=1e-6)
        known = metric.held(force)
        assert known is not None
        np.testing.assert_allclose(known.numpy(), smooth, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(metric.short(force).numpy(), 0.5 * answer, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(metric.diagonal.numpy(), np.diag(held), rtol=1e-6)

    def test_what_it_answered_is_known_of_that_force_alone(self):
        metric = HeldMetric(chain()[0], torch.ones(12, dtype=torch.float64))
        force = torch.ones((12, 3), dtype=torch.float64)
        assert metric.held(force) is None
        metric.solve(force)
        assert metric.held(force.clone()) is None
        assert metric.held(force) is not None
        force[0] = 2.0
        assert metric.held(force) is None

    def test_it_needs_no_factor(self, monkeypatch):
        monkeypatch.setattr(Metric, "plus", lambda *_: (_ for _ in ()).throw(AssertionError("factorised")))
        metric, force = (
            HeldMetric(chain()[0], torch.ones(12, dtype=torch.float64)),
            torch.ones((12, 3), dtype=torch.float64),
        )
        assert bool(metric.solve(force).isfinite().all())
        assert bool(metric.short(force).isfinite().all())

    def test_it_serves_while_it_lacks_little(self):
        plain, _ = chain()
        stiff = torch.ones(12, dtype=torch.float64)
        metric = HeldMetric(plain, stiff)
        assert metric.serves(0.0 * stiff)
        assert metric.serves(9.0 * stiff)
        assert not metric.serves(11.0 * stiff)


def test_the_rough_part_takes_up_what_touches(monkeypatch):
    pushed = torch.linspace(0.0, 5.0, 12, dtype=torch.float64)
    monkeypatch.setattr(Contact, "diagonal", lambda *_: pushed)
    x = torch.zeros((12, 3), dtype=torch.float64)
    metric = LevelContact(None, None).metric(chain()[0], [object.__new__(Contact)], x)
    assert isinstance(metric, HeldMetric)
    assert torch.equal(metric.stiff, 3.0 * pushed)
