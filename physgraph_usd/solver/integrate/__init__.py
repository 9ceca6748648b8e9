"""Integrators: forces in, displacements out.

A new integrator is one file and one line in `METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from ...errors import UsageError
from .base import Integrator
from .first_order import Adam, GradientDescent
from .guard import Guard
from .learned import guarded
from .newton import Newton
from .quasi_newton import QuasiNewton
from .weights import load_network, shipped_network


@dataclass(frozen=True)
class Method:
    """An integrator and how it is used.

    Attributes:
        build: Makes the integrator.
        nested: Solve coarse levels first; otherwise the finest level only. None chooses frame by frame: `choice`.
        learned: Makes the network's integrator, where frames choose; None where there is no choice.
    """

    build: Callable[[], Integrator]
    nested: bool | None
    learned: Callable[[], Integrator] | None = None


def _shipped() -> Integrator:
    """The integrator of the network that ships."""
    return guarded(shipped_network("physgraph"))


METHODS: dict[str, Method] = {
    "auto": Method(QuasiNewton, nested=None, learned=_shipped),
    "quasi-newton": Method(QuasiNewton, nested=True),
    "quasi-newton-flat": Method(QuasiNewton, nested=False),
    "lbfgs": Method(lambda: QuasiNewton(use_metric=False), nested=False),
    "adam": Method(lambda: Guard(Adam()), nested=False),
    "gd": Method(lambda: Guard(GradientDescent()), nested=False),
    "newton": Method(Newton, nested=True),
    "physgraph": Method(_shipped, nested=True),
    "physgraph-paper": Method(lambda: guarded(shipped_network("physgraph-paper")), nested=False),
}
"""Every method by its name on the command line."""
LEARNED = ("physgraph", "physgraph-paper")
"""Those that have weights."""


def method_named(name: str, weights: Path | None = None) -> Method:
    """The method of that name.

    Args:
        name: A name out of `METHODS`.
        weights: A file for a learned one, in place of what ships.

    Raises:
        UsageError: No method has that name, or it has no weights.
        WeightsError: The file is missing, damaged or of another kind.
    """
    if name not in METHODS:
        raise UsageError(f"unknown integrator '{name}'; known integrators: {', '.join(METHODS)}")
    method = METHODS[name]
    if weights is None:
        return method
    if name not in LEARNED and method.learned is None:
        raise UsageError(f"integrator '{name}' has no weights; name one that has: auto, {', '.join(LEARNED)}")
    network = load_network(weights, kind=name if name in LEARNED else "physgraph")

    def own() -> Integrator:
        return guarded(network)

    return replace(method, build=own) if name in LEARNED else replace(method, learned=own)
