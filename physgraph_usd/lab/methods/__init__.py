"""Methods compared in charts, training and benchmarks only; the import adds the methods to the solver's registries."""

from __future__ import annotations

from pathlib import Path

from ...solver.integrate import METHODS, Method, register
from ...solver.integrate.guard import Guard
from ...solver.integrate.quasi_newton import QuasiNewton
from ...solver.integrate.weights import Kind, register_kind, shipped_network
from .first_order import Adam, GradientDescent
from .lbfgs import Lbfgs
from .newton import Newton
from .paper_network import PaperConfig, PaperNetwork
from .paper_steps import LearnedPaper

__all__ = ["METHODS"]

PAPER = "physgraph-paper"
"""Name of the paper's network, as a method and as a kind of weights."""


def _paper() -> Guard:
    return Guard(LearnedPaper(shipped_network(PAPER)))


register_kind(
    PAPER,
    Kind(PaperConfig, PaperNetwork, LearnedPaper, Path(__file__).with_name(f"{PAPER}.safetensors")),
)
register("quasi-newton-flat", Method(QuasiNewton, nested=False))
register("lbfgs", Method(Lbfgs, nested=False))
register("adam", Method(lambda: Guard(Adam()), nested=False))
register("gd", Method(lambda: Guard(GradientDescent()), nested=False))
register("newton", Method(Newton, nested=True))
register(PAPER, Method(_paper, nested=False))
