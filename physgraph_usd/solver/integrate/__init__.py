"""Integrators: from forces to displacements.

A new integrator needs one file and one line in `METHODS`. Methods for comparison only are in `lab.methods` and are
registered on import.
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
    """An integrator and its use.

    Attributes:
        build: Makes the integrator.
        nested: Whether cold frames solve coarse levels first; otherwise the finest level only.
    """

    build: Callable[[], Integrator]
    nested: bool


def _shipped() -> Integrator:
    return _guarded(shipped_network(LEARNED))


def _guarded(network: Physgraph) -> Integrator:
    """The guarded integrator of a network, with quasi-Newton as spare."""
    return Guard(LearnedMetric(network), spare=QuasiNewton())


LEARNED = "physgraph"
"""Name of the learned method, and of the kind of its weights."""
METHODS: dict[str, Method] = {
    LEARNED: Method(_shipped, nested=True),
    "quasi-newton": Method(QuasiNewton, nested=True),
}
"""All methods by name: methods of the command line, and methods added by `register`."""


def register(name: str, method: Method) -> None:
    """Add a method to `METHODS`."""
    METHODS[name] = method


def method_named(name: str, weights: Path | None = None) -> Method:
    """The method of a given name.

    Args:
        name: A name in `METHODS`.
        weights: Weights file for a learned method, instead of the shipped weights.

    Raises:
        UsageError: The name is unknown, or the method has no weights.
        WeightsError: The file is missing, damaged or of a different kind.
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
