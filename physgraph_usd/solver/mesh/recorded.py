"""Work on a card, recorded once as a CUDA graph and replayed: its launch by the host takes longer than most kernels."""

from __future__ import annotations

import functools
import gc
import logging
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

CALLS = 2
"""Calls with equal shapes before a recording, which takes as long as some calls. First frames take 3.2 and 7.6 s with
2, 4.1 and 8.3 with 4, and 4.5 and 8.4 with 12 (H200, dancer at two subdivisions and shot 10 at three)."""
NEVER = -(2**62)
"""Number of calls noted for a function after a failed recording."""
_logger = logging.getLogger(__name__)


class Recordings:
    """Functions of tensors, recorded for each key and combination of shapes.

    The functions read nothing back from the card, and everything that changes from call to call is an input. Without a
    card, with an input that is no tensor on it, or if recording fails, a function is called without a recording.
    """

    def __init__(self) -> None:
        """Begin without recordings."""
        self._records: dict[Any, int | _Recording] = {}
        self._inputs: dict[Any, _Input] = {}

    def run(self, key: Any, function: Callable[..., Sequence[Tensor]], *tensors: Any) -> Sequence[Tensor]:
        """The function's tensors; the caller may change them.

        Args:
            key: Equal for functions that do the same work on the same constants.
            function: Computes tensors from the inputs.
            tensors: Inputs of the function.
        """
        if not all(isinstance(tensor, Tensor) and tensor.is_cuda for tensor in tensors):
            return function(*tensors)
        key = (key, *((tensor.shape, tensor.dtype) for tensor in tensors))
        record = self._records.get(key, 0)
        if isinstance(record, _Recording):
            return record(tensors)
        self._records[key] = record + 1 if record < CALLS else self._recording(function, tensors)
        return function(*tensors)

    def clear(self) -> None:
        """Forget all recordings."""
        self.__init__()

    def _recording(self, function: Callable[..., Sequence[Tensor]], tensors: Sequence[Tensor]) -> _Recording | int:
        slots = [(number, tensor.shape, tensor.dtype) for number, tensor in enumerate(tensors)]
        try:
            self._inputs |= {
                slot: _Input(tensor) for slot, tensor in zip(slots, tensors, strict=True) if slot not in self._inputs
            }
            return _Recording(function, [self._inputs[slot] for slot in slots])
        except RuntimeError as error:
            _logger.info("%s is not recorded: %s", function.__qualname__, error)
            return NEVER


@dataclass(frozen=True, eq=False)
class Work:
    """A function of tensors, for cards to record.

    Attributes:
        key: As for `Recordings.run`.
        function: Computes tensors from those given to `run`, followed by ``tensors``.
        tensors: The function's last inputs.
    """

    key: Any
    function: Callable[..., Sequence[Tensor]]
    tensors: Sequence[Any]

    def run(self, recordings: Recordings, *first: Tensor) -> Sequence[Tensor]:
        """The function's tensors."""
        return recordings.run(self.key, self.function, *first, *self.tensors)


class _Input:
    """An input of recordings, shared by all recordings with an argument of its position, shape and type.

    Attributes:
        buffer: The tensor that the recordings read.
    """

    def __init__(self, values: Tensor) -> None:
        """Take the first values."""
        self.buffer = values.clone(memory_format=torch.contiguous_format)
        self._last: tuple[Any, int] | None = None

    def differs(self, tensor: Tensor) -> bool:
        """True unless the last call had the same tensor in the same version."""
        if self._last is not None and self._last[0]() is tensor and self._last[1] == tensor._version:
            return False
        self._last = weakref.ref(tensor), tensor._version
        return True


class _Recording:
    """A CUDA graph with its inputs and outputs."""

    def __init__(self, function: Callable[..., Sequence[Tensor]], inputs: Sequence[_Input]) -> None:
        """Record a function without running it, and keep its closure alive: the graph reads the closure's tensors."""
        self._function, self._inputs, buffers = function, inputs, [recorded.buffer for recorded in inputs]
        card = buffers[0].device
        self._graph, self._outputs = _captured(lambda: function(*buffers), card, pool=_shared(card).pool())

    def __call__(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Replay with other inputs."""
        pairs = zip(self._inputs, tensors, strict=True)
        changed = [(recorded.buffer, tensor) for recorded, tensor in pairs if recorded.differs(tensor)]
        if changed:
            buffers, values = map(list, zip(*changed, strict=True))
            torch._foreach_copy_(buffers, values)  # pyright: ignore[reportPrivateImportUsage]
        self._graph.replay()
        return [output.clone() for output in self._outputs]


def _captured(
    function: Callable[[], Sequence[Tensor]], card: torch.device, *, pool: Any = None
) -> tuple[torch.cuda.CUDAGraph, Sequence[Tensor]]:
    """CUDA graph of a function's kernels, not run, and the function's tensors.

    Args:
        function: A function without inputs.
        card: The function's device.
        pool: Memory pool of the graph; None for a new one.
    """
    graph, before, stream = torch.cuda.CUDAGraph(), torch.cuda.current_stream(card), torch.cuda.Stream(card)
    stream.wait_stream(before)
    collects = gc.isenabled()
    gc.disable()  # Memory that is freed meanwhile would end the recording.
    try:
        with torch.cuda.stream(stream):
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                outputs = function()
            finally:
                graph.capture_end()
    finally:
        if collects:
            gc.enable()
    before.wait_stream(stream)
    return graph, outputs


@functools.cache
def _shared(card: torch.device) -> torch.cuda.CUDAGraph:
    """An unused graph, to keep alive the memory pool of all graphs of a card; torch refuses a pool without a graph.

    Graphs can share memory because they run one after another.
    """
    return _captured(lambda: [torch.zeros(1, device=card)], card)[0]
