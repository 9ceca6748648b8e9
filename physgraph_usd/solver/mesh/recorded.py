"""Work on a card, recorded once as a CUDA graph and replayed: its launch by the host takes longer than most kernels."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

CALLS = 12
"""Calls with equal shapes before a recording: recording takes as long as some calls, and a changed material ends it."""


class Recorded:
    """A function of tensors, recorded for each combination of shapes.

    The function reads nothing back from the card, and all that changes from call to call is an input. Without a card,
    or with an input that is no tensor there, it is called as it is.
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
        if not isinstance(known, _Recording):
            self._known[key] = known + 1 if known < CALLS else _Recording(self._function, given)
            return self._function(*given)
        return known(given)


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
        self._graph, before, stream = torch.cuda.CUDAGraph(), torch.cuda.current_stream(card), torch.cuda.Stream(card)
        stream.wait_stream(before)
        collects = gc.isenabled()
        gc.disable()  # Memory that is freed meanwhile would end the recording.
        with torch.cuda.stream(stream):
            self._graph.capture_begin(pool=_pool(before.device_index), capture_error_mode="thread_local")
            try:
                self._outputs = list(function(*self._inputs))
            finally:
                self._graph.capture_end()
                if collects:
                    gc.enable()
        before.wait_stream(stream)

    def __call__(self, given: Sequence[Tensor]) -> list[Tensor]:
        """Replay with other inputs."""
        torch._foreach_copy_(self._inputs, list(given))  # pyright: ignore[reportPrivateImportUsage]
        self._graph.replay()
        return [each.clone() for each in self._outputs]


@functools.cache
def _pool(card: int) -> Any:
    """Memory shared by the recordings of a card: none runs while another does."""
    return torch.cuda.graph_pool_handle()
