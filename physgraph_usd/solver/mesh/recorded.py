"""Work on a card, recorded once as a CUDA graph and replayed: its launch by the host takes longer than most kernels."""

from __future__ import annotations

import functools
import gc
import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

CALLS = 2
"""Calls with equal shapes before a recording, which takes as long as some calls. First frames take 3.2 and 7.6 s with
2, 4.1 and 8.3 with 4, and 4.5 and 8.4 with 12 (H200, dancer at two subdivisions and shot 10 at three)."""
NEVER = -(2**62)
"""Number of calls noted for a function after a failed recording."""
_logger = logging.getLogger(__name__)


class Recorded:
    """A function of tensors, recorded for each combination of shapes.

    The function reads nothing back from the card, and all that changes from call to call is an input. Without a card,
    with an input that is no tensor there, or where recording fails, the function is called as it is.
    """

    def __init__(self, function: Callable[..., Sequence[Tensor]]) -> None:
        """Take the function."""
        self._function = function
        self._known: dict[tuple[Any, ...], int | _Recording] = {}

    def __call__(self, *given: Any) -> Sequence[Tensor]:
        """The function's tensors, the caller's own."""
        if not all(isinstance(each, Tensor) and each.is_cuda for each in given):
            return self._function(*given)
        key = tuple((each.shape, each.dtype) for each in given)
        known = self._known.get(key, 0)
        if isinstance(known, _Recording):
            return known(given)
        self._known[key] = known + 1 if known < CALLS else self._recording(given)
        return self._function(*given)

    def _recording(self, given: Sequence[Tensor]) -> _Recording | int:
        try:
            return _Recording(self._function, given)
        except RuntimeError as error:
            _logger.info("%s is not recorded: %s", self._function.__qualname__, error)
            return NEVER


class Recordings(dict[Any, Recorded]):
    """Recorded functions by key."""

    def of(self, key: Any, function: Callable[..., Sequence[Tensor]]) -> Recorded:
        """The recorded function of a key; the given one, if it is the first."""
        if key not in self:
            self[key] = Recorded(function)
        return self[key]


class _Recording:
    """A CUDA graph with its inputs and outputs."""

    def __init__(self, function: Callable[..., Sequence[Tensor]], given: Sequence[Tensor]) -> None:
        """Record the function, without running it."""
        self._inputs = [each.clone(memory_format=torch.contiguous_format) for each in given]
        card = given[0].device
        self._graph, self._outputs = _captured(lambda: function(*self._inputs), card, pool=_shared(card).pool())

    def __call__(self, given: Sequence[Tensor]) -> list[Tensor]:
        """Replay with other inputs."""
        torch._foreach_copy_(self._inputs, list(given))  # pyright: ignore[reportPrivateImportUsage]
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
