"""Starts Warp and compiles its kernels."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
import warp as wp

from ...errors import PhysGraphError, UsageError

_STDERR = 2
_TARGET = "-target-cpu x86-64-v3" if torch.backends.cpu.get_cpu_capability() in ("AVX2", "AVX512") else "-march=native"
"""Instruction set common to all x86-64 processors with AVX2, for equal rounding on every machine."""
_FLAGS = (wp.config.cpu_compiler_flags or "-march=native").replace("-march=native", _TARGET)
KERNELS = {"enable_backward": False, "cpu_compiler_flags": _FLAGS}
"""Options of Warp modules: no derivatives; on the CPU Warp's default flags, for the target instructions."""
FUSED = {**KERNELS, "cpu_compiler_flags": f"{_FLAGS} -ffp-contract=fast"}
"""`KERNELS` with fused multiply-adds on the CPU, where Warp's own option, on by default, makes none."""
ALONE: dict[str, Any] = {"module": "unique", "module_options": FUSED}
"""Arguments of `wp.kernel` for a kernel that compiles separately."""


@functools.cache
def start_warp() -> None:
    """Start Warp, without its library's messages about a missing CUDA driver, common to most machines.

    Raises:
        PhysGraphError: Kernels need compiling, and the cache folder is missing or not writable.
    """
    wp.config.log_level = wp.LOG_WARNING
    try:
        with nullcontext() if torch.cuda.is_available() else _stderr_to_nowhere():
            wp.init()
    except OSError as error:
        raise _no_cache(f"{error.filename}: {error.strerror}") from error
    if not _compiled() and not os.access(wp.config.kernel_cache_dir or "", os.W_OK):
        raise _no_cache(f"{wp.config.kernel_cache_dir} may not be written")


def _no_cache(reason: str) -> PhysGraphError:
    return PhysGraphError(f"cannot keep compiled kernels, {reason}; WARP_CACHE_PATH names another folder for them")


def _compiled() -> list[Path]:
    """Our kernels already compiled for this user and version of Warp."""
    package = __name__.split(".", maxsplit=1)[0]
    return [*Path(wp.config.kernel_cache_dir or "").glob(f"wp_{package}*")]


def compile_kernels(device: str) -> None:
    """Compile all kernels of imported modules; Warp caches the kernels for later processes."""
    start_warp()
    wp.force_load(device, max_workers=os.cpu_count())


def device_of(device: str) -> str:
    """The device's name in torch and Warp.

    Args:
        device: "cpu", "cuda", a certain card as "cuda:1", or "auto" for a card if there is one.

    Raises:
        UsageError: CUDA was requested but is missing.
    """
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError("device 'cuda' was asked for and no CUDA device is there; use --device auto or cpu")
    return device


def cards_for(device: str) -> list[str]:
    """Names, for CUDA_VISIBLE_DEVICES, of the cards to share among processes; none for a certain card or the CPU.

    Arguments are as for `device_of`.
    """
    if device not in ("cuda", "auto"):
        return []
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return visible.split(",") if visible else [str(card) for card in range(torch.cuda.device_count())]


def kernels_are_compiled() -> bool:
    """Whether some of our kernels are already compiled for this user and version of Warp."""
    start_warp()
    return bool(_compiled())


@contextmanager
def _stderr_to_nowhere() -> Iterator[None]:
    """Keep output of C code off the terminal; does nothing in a program without standard error."""
    try:
        saved = os.dup(_STDERR)
    except OSError:
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, _STDERR)
        yield
    finally:
        os.dup2(saved, _STDERR)
        os.close(saved)
        os.close(nowhere)
