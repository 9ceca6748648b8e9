"""Integrators: forces in, displacements out.

A new integrator is one file and one line in `METHODS`. Methods that are only compared stand in `lab.methods`, which
registers them when it is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from ...errors import UsageError
from .base import Integrator
from .guard import Guard
from .learned import LearnedMetric
from .network import Physgraph
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
    return _guarded(shipped_network(LEARNED))


def _guarded(network: Physgraph) -> Integrator:
    """The integrator of a network, with quasi-Newton to spare."""
    return Guard(LearnedMetric(network), spare=QuasiNewton())


LEARNED = "physgraph"
"""Name of the method whose every step is the network's, and of the kind of its weights."""
METHODS: dict[str, Method] = {
    LEARNED: Method(_shipped, nested=True),
    "quasi-newton": Method(QuasiNewton, nested=True),
}
"""Every method by its name: those of the command line, and what `register` adds."""


def register(name: str, method: Method) -> None:
    """Add a method to `METHODS`."""
    METHODS[name] = method


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
    if name != LEARNED:
        raise UsageError(f"integrator '{name}' has no weights; name one that has: {LEARNED}")
    network = cast(Physgraph, load_network(weights, kind=LEARNED))

    def own() -> Integrator:
        return _guarded(network)

    return replace(method, build=own)
