"""Kernel launches prepared once: on the CPU in slices on several threads, on CUDA as a whole.

Warp runs a CPU kernel on the calling thread and releases the interpreter lock meanwhile, so slices run in parallel.
Each item writes only its own results, so the number of threads changes no bit of the result. The number of threads of
a launch depends on the time per item in the kernel's last launches.
"""

from __future__ import annotations

import copy
import ctypes
import functools
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from itertools import pairwise
from typing import Any

import torch
import warp as wp
from torch import Tensor

LEAST_SECONDS = 5e-4
"""Least work per thread [s]; waking a thread takes some 0.2 ms."""
MOST_THREADS = 4
"""Most threads of a launch: warm frames took 0.17, 0.12 and 0.19 s (dancer) and 2.7, 1.6 and 2.7 s (layers) on 1, 4 and
16 cores without this limit."""
SLICES, SLICE_SECONDS = 8, 5e-5
"""Slices per thread and their least average work [s]: some items cost a hundred times as much as average, so free
threads take the next slice, and slices shrink to shorten the wait for the last."""
_item_seconds: defaultdict[str, float] = defaultdict(float)
"""Recent time per item on one thread [s], by kernel."""


class Launch:
    """A kernel over items 0 to size - 1; the kernel's first parameter is the first item of a slice."""

    def __init__(
        self, kernel: wp.Kernel, size: int, inputs: Sequence[Any], *, device: str, threads: int = 1, at_once: int = 1
    ) -> None:
        """Prepare the launch.

        Args:
            kernel: Kernel of (first, *inputs).
            size: Number of items; of elements if a kernel's item is a block of elements.
            inputs: The kernel's arrays; changing arrays are replaced at each call.
            device: "cpu" or a CUDA device.
            threads: Most threads to use on the CPU; at most `MOST_THREADS` are.
            at_once: Number of elements in an item of the kernel.
        """
        self._size, self._name = -(-size // at_once), f"{kernel.module.name}.{kernel.key}"
        self._device = None if device == "cpu" else device
        self._most = min(threads, MOST_THREADS) if self._device is None else 1
        command = wp.launch(kernel, dim=self._size, inputs=[0, *inputs], device=device, record_cmd=True)
        self._command: wp.Launch | None = command if self._size else None
        self._call = None if self._command is None or self._device is not None else _Call(self._command)
        if self._command is not None and self._call is None:
            _separate_arguments(self._command)
        self._slices: list[_Call] = []

    def change(self, changed: Mapping[int, Any]) -> None:
        """Replace some inputs from now on, by position in ``inputs``; tensors only by tensors of equal shape."""
        if self._command is None:
            return
        if self._call is None:
            for position, value in changed.items():
                if isinstance(value, Tensor):  # In place: to pack an argument takes longer than many kernels.
                    self._command.params[position + 2].data = _address(value)
                else:
                    self._command.set_param_at_index(position + 1, value)
        for call in (self._call, *self._slices) if self._call is not None else ():
            call.change(changed)

    def __call__(self, changed: Mapping[int, Any]) -> None:
        """Run with some inputs replaced, by position in ``inputs``."""
        self.change(changed)
        if self._command is None:
            return
        if self._call is None:
            self._command.launch(stream=current_stream(str(self._device)))
            return
        item_seconds = _item_seconds[self._name]
        work = item_seconds * self._size
        threads = min(self._most, int(work / LEAST_SECONDS))
        spent = _run([self._call]) if threads < 2 else self._shared(threads, work)
        _item_seconds[self._name] = 0.5 * (item_seconds + spent / self._size)

    def _shared(self, threads: int, work: float) -> float:
        """Run on several threads, given the work [s]; returns the time of all threads together [s]."""
        assert self._call is not None
        if not self._slices:
            bounds = _tapered(self._size, min(SLICES * threads, int(work / SLICE_SECONDS), self._size))
            self._slices = [self._call.part(a, b) for a, b in pairwise(bounds) if b > a]
        queue = iter(self._slices)  # A list's iterator hands each call to one thread only.
        futures: list[Future[float]] = []
        try:
            for _ in range(threads - 1):
                futures.append(_pool(self._most).submit(_run, queue))
            spent = _run(queue)
        finally:
            wait(futures)  # The caller may free its arrays only after all threads have finished.
        return spent + sum(future.result() for future in futures)


class _Call:
    """A launch on the CPU whose arguments are packed once: packing takes as long as many kernels."""

    def __init__(self, command: wp.Launch) -> None:
        """Pack the arguments of a recorded launch, and keep it, and thus its arrays, alive."""
        self._command, self._bounds = command, command.params[0]
        packed = _packed_type(*map(type, command.params[1:]))
        self._packed, self._names = packed(), [name for name, _ in packed._fields_]
        hooks: Any = command.hooks
        self._forward = hooks.forward
        for name, value in zip(self._names, command.params[1:], strict=True):
            setattr(self._packed, name, value)

    def change(self, changed: Mapping[int, Any]) -> None:
        """Replace some inputs, as in `Launch.change`."""
        for position, value in changed.items():
            if isinstance(value, Tensor):
                getattr(self._packed, self._names[position + 1]).data = _address(value)
            else:
                plain = value.__ctype__() if isinstance(value, wp.array) else value
                setattr(self._packed, self._names[position + 1], plain)

    def part(self, begin: int, end: int) -> _Call:
        """The call for a slice of the items."""
        command = copy.copy(self._command)
        command.params, command.fwd_args = list(command.params), list(command.fwd_args or ())
        command.set_dim(end - begin)
        part = _Call(command)
        part._packed = type(self._packed).from_buffer_copy(self._packed)
        setattr(part._packed, part._names[0], begin)
        return part

    def launch(self) -> None:
        """Run the kernel on this thread; Python's lock is free meanwhile."""
        self._forward(ctypes.byref(self._bounds), ctypes.byref(self._packed))


def _separate_arguments(command: wp.Launch) -> None:
    """Give a launch on a card its own structure for each array, to be changed in place; Warp shares an array's."""
    parameters: Any = command.params
    addresses: Any = command.params_addr
    for number, shared in enumerate(parameters):
        if number and isinstance(shared, ctypes.Structure):
            parameters[number] = type(shared).from_buffer_copy(shared)
            addresses[number] = ctypes.c_void_p(ctypes.addressof(parameters[number]))


def _address(tensor: Tensor) -> int:
    """Address of a tensor's first element.

    Raises:
        ValueError: The tensor is not contiguous.
    """
    if not tensor.is_contiguous():
        raise ValueError("a kernel reads contiguous tensors only")
    return tensor.data_ptr()


def run(kernel: wp.Kernel, size: int, inputs: Sequence[Any], *, device: str, threads: int = 1) -> None:
    """Run a kernel once, like a `Launch`."""
    if device == "cpu":
        Launch(kernel, size, inputs, device=device, threads=threads)({})
    elif size:
        wp.launch(kernel, dim=size, inputs=[0, *inputs], device=device, stream=current_stream(device))


def refit(tree: wp.Bvh | wp.Mesh, device: str) -> None:
    """Refit a hierarchy to its changed boxes or points, on the stream of the kernels."""
    with nullcontext() if device == "cpu" else wp.ScopedStream(current_stream(device), sync_enter=False):
        tree.refit()


def argument(tensor: Tensor, dtype: type | None = None) -> Any:
    """A contiguous tensor as a kernel argument, without a copy, with scalar or vector elements.

    The result cannot be inspected, nor be part of a struct, but costs a third of a Warp array.
    """
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


def _tapered(size: int, slices: int) -> list[int]:
    """Bounds of linearly shrinking slices (trapezoid self-scheduling, Tzen and Ni 1993)."""
    weight = slices * (slices + 1)
    return [size * i * (2 * slices + 1 - i) // weight for i in range(slices + 1)]


def _run(commands: Iterable[_Call]) -> float:
    """Run launches in sequence, and return the wall time [s]."""
    began = time.perf_counter()
    for command in commands:
        command.launch()
    return time.perf_counter() - began


def current_stream(device: str) -> wp.Stream:
    """Torch's current stream on a CUDA device: kernels queue behind torch's work, also during graph capture."""
    index = torch.device(device).index
    index = torch.cuda.current_device() if index is None else index
    return _stream(device, torch._C._cuda_getCurrentRawStream(index))  # A torch stream object costs more than a launch.


@functools.lru_cache(maxsize=64)
def _stream(device: str, handle: int) -> wp.Stream:
    return wp.Stream(device, cuda_stream=handle)


@functools.cache
def _packed_type(*kinds: type) -> Any:
    """The C structure of arguments of given types: making a type takes longer than many kernels."""
    fields = [(f"argument{number}", kind) for number, kind in enumerate(kinds)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads waiting for slices, shared by all launches with the same number of threads."""
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="thread")
