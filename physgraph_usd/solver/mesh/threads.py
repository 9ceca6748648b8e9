"""Kernel launches prepared once: on the CPU in slices on several threads, on CUDA as a whole.

Warp runs a CPU kernel on the calling thread and releases the interpreter lock meanwhile, so slices run in parallel.
Each item writes only to its own places, so the number of threads changes no bit of the result.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any

import torch
import warp as wp
from torch import Tensor

LEAST_PER_THREAD = 4000
"""Items per thread below which an additional thread costs more than the gain."""
LEAST_QUERIES = 250
"""Items per thread, as above, for items that query a hierarchy or represent many elements."""
SLICES, LEAST_SLICE = 8, 32
"""Slices per thread for such items, and their least average size: some items cost a hundred times as much as average,
so free threads take the next slice, and slices shrink to shorten the wait for the last."""


class Launch:
    """A kernel over items 0 to size - 1; the kernel's first parameter is the first item of a slice."""

    def __init__(
        self,
        kernel: wp.Kernel,
        size: int,
        inputs: Sequence[Any],
        *,
        device: str,
        threads: int = 1,
        least: int = LEAST_PER_THREAD,
        at_once: int = 1,
    ) -> None:
        """Prepare the launch.

        Args:
            kernel: Kernel of (first, *inputs).
            size: Number of items; of elements if a kernel's item is a block of elements.
            inputs: The kernel's arrays; changing arrays are given again at each call.
            device: "cpu" or a CUDA device.
            threads: Most threads to use on the CPU.
            least: Items per thread below which an additional thread costs more than the gain.
            at_once: Number of elements in an item of the kernel.
        """
        self._threads = threads = max(1, min(threads, size // least)) if device == "cpu" else 1
        size = -(-size // at_once)
        self._device = None if device == "cpu" else device
        slices = min(SLICES * threads, size // LEAST_SLICE) if threads > 1 and least < LEAST_PER_THREAD else threads
        bounds = _tapered(size, slices) if slices > threads else [size * i // slices for i in range(slices + 1)]
        whole = wp.launch(kernel, dim=size, inputs=[0, *inputs], device=device, record_cmd=True)
        self._commands: list[wp.Launch] = []
        if whole is not None and size:
            self._commands = [whole] if slices == 1 else [_part(whole, a, b) for a, b in pairwise(bounds)]

    def change(self, changed: Mapping[int, Any]) -> None:
        """Replace some inputs from now on, by position in ``inputs``."""
        for command in self._commands:
            for place, array in changed.items():
                command.set_param_at_index(place + 1, array)

    def __call__(self, changed: Mapping[int, Any]) -> None:
        """Run with some inputs replaced, by position in ``inputs``."""
        self.change(changed)
        if self._device is not None:
            stream = current_stream(self._device)
            for command in self._commands:
                command.launch(stream=stream)
            return
        if self._threads == 1:
            _run(iter(self._commands))
            return
        left = iter(self._commands)  # A list's iterator hands each command to one thread only.
        others: list[Future[None]] = []
        try:
            for _ in range(self._threads - 1):
                others.append(_pool(self._threads).submit(_run, left))
            _run(left)
        finally:
            wait(others)  # The caller may free its arrays only after all threads have finished.
        for other in others:
            other.result()


def run(
    kernel: wp.Kernel,
    size: int,
    inputs: Sequence[Any],
    *,
    device: str,
    threads: int = 1,
    least: int = LEAST_PER_THREAD,
) -> None:
    """Run a kernel once, like a `Launch`."""
    if device == "cpu":
        Launch(kernel, size, inputs, device=device, threads=threads, least=least)({})
    elif size:
        wp.launch(kernel, dim=size, inputs=[0, *inputs], device=device, stream=current_stream(device))


def argument(tensor: Tensor, dtype: type | None = None) -> Any:
    """A contiguous tensor as a kernel argument, without a copy, with scalar or vector elements.

    The result cannot be inspected, nor be part of a struct, but costs a third of a Warp array.
    """
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


def _tapered(size: int, slices: int) -> list[int]:
    """Bounds of linearly shrinking slices (trapezoid self-scheduling, Tzen and Ni 1993)."""
    weight = slices * (slices + 1)
    return [size * i * (2 * slices + 1 - i) // weight for i in range(slices + 1)]


def _part(whole: wp.Launch, begin: int, end: int) -> wp.Launch:
    """A launch over a slice of the items: packing all parameters again would take longer than many slices."""
    part = copy.copy(whole)
    part.params = list(whole.params)
    part.fwd_args = list(whole.fwd_args or ())  # Keeps the arrays alive.
    part.set_dim(end - begin)
    part.set_param_at_index(0, begin)
    return part


def _run(commands: Iterator[wp.Launch]) -> None:
    """Launch the remaining commands."""
    for command in commands:
        command.launch()


def current_stream(device: str) -> wp.Stream:
    """Torch's current stream on a CUDA device: kernels queue behind torch's work, also during graph capture."""
    index = torch.device(device).index
    index = torch.cuda.current_device() if index is None else index
    return _stream(device, torch._C._cuda_getCurrentRawStream(index))  # A torch stream object costs more than a launch.


@functools.lru_cache(maxsize=64)
def _stream(device: str, handle: int) -> wp.Stream:
    return wp.Stream(device, cuda_stream=handle)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads waiting for slices, shared by all launches with the same number of threads."""
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="thread")
