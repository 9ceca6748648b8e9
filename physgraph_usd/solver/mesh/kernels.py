"""How Warp's kernels are compiled, and Warp started."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import torch
import warp as wp

from ...errors import PhysGraphError

_STDERR = 2
_TARGET = "-target-cpu x86-64-v3" if torch.backends.cpu.get_cpu_capability() in ("AVX2", "AVX512") else "-march=native"
"""Instructions of every x86-64 processor that has AVX2, so that kernels round alike on all of them."""
_FLAGS = (wp.config.cpu_compiler_flags or "-march=native").replace("-march=native", _TARGET)
KERNELS = {"enable_backward": False, "cpu_compiler_flags": _FLAGS}
"""Options of Warp modules: no derivatives; on the CPU Warp's default flags, for the target instructions."""
FUSED = KERNELS | {"cpu_compiler_flags": f"{_FLAGS} -ffp-contract=fast"}
"""Options of modules whose kernels compute most: on the CPU a product and a sum are one instruction."""


@functools.cache
def start_warp() -> None:
    """Start Warp, without what its library prints itself where no CUDA driver is found: most machines have none.

    Raises:
        PhysGraphError: Kernels have to be compiled, and there is no folder to keep them in.
    """
    wp.config.log_level = wp.LOG_WARNING
    try:
        with nullcontext() if torch.cuda.is_available() else _stderr_to_nowhere():
            wp.init()
    except OSError as error:
        raise _no_cache(f"{error.filename}: {error.strerror}") from error
    if not _compiled() and not os.access(wp.config.kernel_cache_dir or "", os.W_OK):
        raise _no_cache(f"{wp.config.kernel_cache_dir} may not be written")


def _no_cache(why: str) -> PhysGraphError:
    return PhysGraphError(f"cannot keep compiled kernels, {why}; WARP_CACHE_PATH names another folder for them")


def _compiled() -> list[Path]:
    """Kernels of ours that were compiled for this user and version of Warp before."""
    package = __name__.split(".", maxsplit=1)[0]
    return [*Path(wp.config.kernel_cache_dir or "").glob(f"wp_{package}*")]


def compile_kernels(device: str) -> None:
    """Compile all kernels of modules that are imported; Warp keeps them for every later process."""
    start_warp()
    wp.force_load(device)


def kernels_are_compiled() -> bool:
    """Whether some of our kernels were compiled for this user and version of Warp before."""
    start_warp()
    return bool(_compiled())


@contextmanager
def _stderr_to_nowhere() -> Iterator[None]:
    """Keep off the terminal what C code prints; does nothing in a program that has no standard error."""
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
