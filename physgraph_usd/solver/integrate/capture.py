"""Kernels on CUDA captured as a graph: a replay launches all of them at once, between the same buffers."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch


def captured(kernels: Callable[[], None], device: torch.device) -> torch.cuda.CUDAGraph:
    """The graph of kernels that ran at least once before, so all of them are loaded; they are not run here.

    Args:
        kernels: Launches the kernels, without waiting for the device. Results must go to buffers made before.
        device: The CUDA device.
    """
    graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side), _uncollected():
        graph.capture_begin(pool=_anchor(device).pool(), capture_error_mode="relaxed")
        kernels()
        graph.capture_end()
    torch.cuda.current_stream().wait_stream(side)
    return graph


@functools.cache
def _anchor(device: torch.device) -> torch.cuda.CUDAGraph:
    """A permanent graph, to own the memory pool shared by all graphs on a device.

    Graphs are replayed one after another and leave no data in the pool.
    """
    graph, one = torch.cuda.CUDAGraph(), torch.zeros((), device=device)
    with torch.cuda.device(device), torch.cuda.graph(graph):
        one.add_(1.0)
    return graph


@contextmanager
def _uncollected() -> Iterator[None]:
    """Suspend the garbage collector, which might free an earlier frame's device memory: not allowed in a capture."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()
