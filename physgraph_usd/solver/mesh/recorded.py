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

    The functions read nothing back from the card, and all that changes from call to call is an input. Without a card,
    with an input that is no tensor there, or where recording fails, a function is called as it is.
    """

    def __init__(self) -> None:
        """Begin without recordings."""
        self._known: dict[Any, int | _Recording] = {}
        self._inputs: dict[Any, _Input] = {}

    def run(self, key: Any, function: Callable[..., Sequence[Tensor]], *given: Any) -> Sequence[Tensor]:
        """The function's tensors, the caller's own.

        Args:
            key: What functions of equal work have in common.
            function: Computes tensors from those given.
        """
        if not all(isinstance(each, Tensor) and each.is_cuda for each in given):
            return function(*given)
        key = (key, *((each.shape, each.dtype) for each in given))
        known = self._known.get(key, 0)
        if isinstance(known, _Recording):
            return known(given)
        self._known[key] = known + 1 if known < CALLS else self._recording(function, given)
        return function(*given)

    def clear(self) -> None:
        """Forget all recordings."""
        self.__init__()

    def _recording(self, function: Callable[..., Sequence[Tensor]], given: Sequence[Tensor]) -> _Recording | int:
        places = [(number, each.shape, each.dtype) for number, each in enumerate(given)]
        try:
            self._inputs |= {
                place: _Input(each) for place, each in zip(places, given, strict=True) if place not in self._inputs
            }
            return _Recording(function, [self._inputs[place] for place in places])
        except RuntimeError as error:
            _logger.info("%s is not recorded: %s", function.__qualname__, error)
            return NEVER


@dataclass(frozen=True, eq=False)
class Work:
    """A function of a tensor and of others, for cards to record.

    Attributes:
        key: What functions of equal work have in common.
        function: Computes tensors from the tensor and those given.
        given: The other tensors.
    """

    key: Any
    function: Callable[..., Sequence[Tensor]]
    given: Sequence[Any]

    def run(self, recordings: Recordings, *first: Tensor) -> Sequence[Tensor]:
        """The function's tensors."""
        return recordings.run(self.key, self.function, *first, *self.given)


class _Input:
    """A tensor read by recordings, shared by those with an input of its shape in the same place.

    Attributes:
        own: The tensor.
    """

    def __init__(self, given: Tensor) -> None:
        """Take the first values."""
        self.own = given.clone(memory_format=torch.contiguous_format)
        self._last: tuple[Any, int] | None = None

    def differs(self, given: Tensor) -> bool:
        """True for a tensor or a version other than the last call's."""
        if self._last is not None and self._last[0]() is given and self._last[1] == given._version:
            return False
        self._last = weakref.ref(given), given._version
        return True


class _Recording:
    """A CUDA graph with its inputs and outputs."""

    def __init__(self, function: Callable[..., Sequence[Tensor]], inputs: Sequence[_Input]) -> None:
        """Record a function without running it, and keep its closure alive: the graph reads the closure's tensors."""
        self._function, self._inputs, own = function, inputs, [each.own for each in inputs]
        card = own[0].device
        self._graph, self._outputs = _captured(lambda: function(*own), card, pool=_shared(card).pool())

    def __call__(self, given: Sequence[Tensor]) -> list[Tensor]:
        """Replay with other inputs."""
        changed = [(mine.own, each) for mine, each in zip(self._inputs, given, strict=True) if mine.differs(each)]
        if changed:
            own, new = [mine for mine, _ in changed], [each for _, each in changed]
            torch._foreach_copy_(own, new)  # pyright: ignore[reportPrivateImportUsage]
        self._graph.replay()
        return [each.clone() for each in self._outputs]


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
                made = function()
            finally:
                graph.capture_end()
    finally:
        if collects:
            gc.enable()
    before.wait_stream(stream)
    return graph, made


@functools.cache
def _shared(card: torch.device) -> torch.cuda.CUDAGraph:
    """An unused graph, to keep alive the memory pool of all graphs of a card; torch refuses a pool without a graph.

    Graphs can share memory because they run one after another.
    """
    return _captured(lambda: [torch.zeros(1, device=card)], card)[0]
