"""Kernel launches prepared once: on the CPU in slices on several threads, on CUDA whole.

Warp runs a CPU kernel on the calling thread and lets go of the interpreter meanwhile, so slices run side by side. Each
item writes its own places only, so the number of threads changes no bit of the result.
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
"""Items below which another thread costs more than it saves."""
LEAST_QUERIES = 250
"""Such items where each queries a hierarchy or stands for many elements."""
SLICES, LEAST_SLICE = 8, 32
"""Slices a thread there, and what they have at least on average: some items cost a hundred times as much as others, so
whoever is free takes the next, and each is smaller than the one before, so that nobody waits long for the last."""

WORKERS = 16
"""Threads that share an item of many elements on CUDA, where few items leave most of the device idle."""


def workers_on(device: str) -> int:
    """How many threads share an item of many elements."""
    return 1 if device == "cpu" else WORKERS


class Launch:
    """One kernel over items 0 to size - 1; the kernel's first parameter is its slice's first item."""

    def __init__(
        self,
        kernel: wp.Kernel,
        size: int,
        inputs: Sequence[Any],
        *,
        device: str,
        threads: int = 1,
        least: int = LEAST_PER_THREAD,
    ) -> None:
        """Prepare the launch.

        Args:
            kernel: Kernel of (first, *inputs).
            size: Number of items.
            inputs: The kernel's arrays; those that change are given again at each call.
            device: "cpu" or a CUDA device.
            threads: Most threads to use on the CPU.
            least: Items below which another of them costs more than it saves.
        """
        self._threads = threads = max(1, min(threads, size // least)) if device == "cpu" else 1
        self._device = None if device == "cpu" else device
        slices = min(SLICES * threads, size // LEAST_SLICE) if threads > 1 and least < LEAST_PER_THREAD else threads
        bounds = _tapered(size, slices) if slices > threads else [size * i // slices for i in range(slices + 1)]
        whole = wp.launch(kernel, dim=size, inputs=[0, *inputs], device=device, record_cmd=True)
        self._commands: list[wp.Launch] = []
        if whole is not None and size:
            self._commands = [whole] if slices == 1 else [_part(whole, a, b) for a, b in pairwise(bounds)]

    def change(self, changed: Mapping[int, Any]) -> None:
        """Replace some inputs from now on, by their place in ``inputs``."""
        for command in self._commands:
            for place, array in changed.items():
                command.set_param_at_index(place + 1, array)

    def __call__(self, changed: Mapping[int, Any]) -> None:
        """Run with some inputs replaced, by their place in ``inputs``."""
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
            wait(others)  # The caller's arrays may go only when nobody works on them any more.
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
    """Run a kernel once, as a `Launch` does."""
    if device == "cpu":
        Launch(kernel, size, inputs, device=device, threads=threads, least=least)({})
    elif size:
        wp.launch(kernel, dim=size, inputs=[0, *inputs], device=device, stream=current_stream(device))


def argument(tensor: Tensor, dtype: type | None = None) -> Any:
    """A contiguous tensor as an array that a kernel takes, without a copy, of so many values or of vectors.

    It cannot be asked anything, nor be part of a struct, but costs a third of an array of Warp's to make.
    """
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


def _tapered(size: int, slices: int) -> list[int]:
    """Bounds of slices of which each is smaller by as much (trapezoid self-scheduling, Tzen and Ni 1993)."""
    weight = slices * (slices + 1)
    return [size * i * (2 * slices + 1 - i) // weight for i in range(slices + 1)]


def _part(whole: wp.Launch, begin: int, end: int) -> wp.Launch:
    """A launch over some of its items: packing all parameters anew would take longer than many a slice."""
    part = copy.copy(whole)
    part.params = list(whole.params)
    part.fwd_args = list(whole.fwd_args or ())  # They keep the arrays alive.
    part.set_dim(end - begin)
    part.set_param_at_index(0, begin)
    return part


def _run(commands: Iterator[wp.Launch]) -> None:
    """Launch what is left."""
    for command in commands:
        command.launch()


def current_stream(device: str) -> wp.Stream:
    """Torch's current stream on a CUDA device: kernels queue behind torch's work, also while a graph is captured."""
    index = torch.device(device).index
    index = torch.cuda.current_device() if index is None else index
    return _stream(device, torch._C._cuda_getCurrentRawStream(index))  # A stream of torch's costs more than a launch.


@functools.lru_cache(maxsize=64)
def _stream(device: str, handle: int) -> wp.Stream:
    return wp.Stream(device, cuda_stream=handle)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that wait for slices, shared by all launches of one width."""
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="thread")
