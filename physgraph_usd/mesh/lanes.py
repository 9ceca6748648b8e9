"""Kernel launches prepared once: on the CPU in slices on several threads, on CUDA whole.

Warp runs a CPU kernel on the calling thread and lets go of the interpreter meanwhile, so slices run side by side. Each
item writes its own places only, so the number of lanes changes no bit of the result.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import torch
import warp as wp

LEAST_PER_LANE = 4000
"""Items below which another lane costs more than it saves."""
LEAST_QUERIES = 250
"""The same where each item asks a hierarchy or stands for many elements."""


class Launch:
    """One kernel over items 0 to size - 1; the kernel's first parameter is its slice's first item."""

    def __init__(
        self,
        kernel: wp.Kernel,
        size: int,
        inputs: Sequence[wp.array],
        *,
        device: str,
        lanes: int = 1,
        least: int = LEAST_PER_LANE,
    ) -> None:
        """Prepare the launch.

        Args:
            kernel: Kernel of (first, *inputs).
            size: Number of items.
            inputs: The kernel's arrays; those that change are given again at each call.
            device: "cpu" or a CUDA device.
            lanes: Most threads to use on the CPU.
            least: Items below which another of them costs more than it saves.
        """
        lanes = max(1, min(lanes, size // least)) if device == "cpu" else 1
        self._device = None if device == "cpu" else device
        bounds = np.linspace(0, size, lanes + 1).astype(int).tolist()
        self._commands: list[wp.Launch] = []
        for a, b in pairwise(bounds):
            command = wp.launch(kernel, dim=b - a, inputs=[a, *inputs], device=device, record_cmd=True)
            if b > a and command is not None:
                self._commands.append(command)

    def change(self, changed: Mapping[int, wp.array]) -> None:
        """Replace some inputs from now on, by their place in ``inputs``."""
        for command in self._commands:
            for place, array in changed.items():
                command.set_param_at_index(place + 1, array)

    def __call__(self, changed: Mapping[int, wp.array]) -> None:
        """Run with some inputs replaced, by their place in ``inputs``."""
        self.change(changed)
        if self._device is not None:
            stream = current_stream(self._device)
            for command in self._commands:
                command.launch(stream=stream)
            return
        others = [_pool(len(self._commands)).submit(command.launch) for command in self._commands[1:]]
        for command in self._commands[:1]:
            command.launch()
        for other in others:
            other.result()


def current_stream(device: str) -> wp.Stream:
    """Torch's current stream on a CUDA device: kernels queue behind torch's work, also while a graph is captured."""
    stream = torch.cuda.current_stream(device)
    return _stream(device, stream.cuda_stream)


@functools.lru_cache(maxsize=64)
def _stream(device: str, handle: int) -> wp.Stream:
    return wp.Stream(device, cuda_stream=handle)


@functools.cache
def _pool(lanes: int) -> ThreadPoolExecutor:
    """Threads that wait for slices, shared by all launches of one width."""
    return ThreadPoolExecutor(lanes - 1, thread_name_prefix="lane")
