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
        nested: Whether cold frames solve coarse levels first; otherwise the finest level only.
    """

    build: Callable[[], Integrator]
    nested: bool


def _shipped() -> Integrator:
    """The integrator of the network that ships."""
    return guarded(shipped_network("physgraph"))


METHODS: dict[str, Method] = {
    "auto": Method(_shipped, nested=True),
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
LEARNED = ("auto", "physgraph", "physgraph-paper")
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
    if name not in LEARNED:
        raise UsageError(f"integrator '{name}' has no weights; name one that has: {', '.join(LEARNED)}")
    network = load_network(weights, kind="physgraph" if name == "auto" else name)

    def own() -> Integrator:
        return guarded(network)

    return replace(method, build=own)
