"""What all tests share: fixed seeds, the folder of real assets, and sample shots."""

import os
import random
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

# Tests run side by side, each on one core, and so do the commands that they start. numpy reads this as it is imported.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
import pytest
import torch
from hypothesis import settings
from shapes import check_shapes

from physgraph_usd.solver.mesh.kernels import start_warp

if TYPE_CHECKING:
    from pxr import Usd

ROOT = Path(__file__).resolve().parents[1]
SEED = 20

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    # A shell's background jobs ignore it, and hand that on to the processes that tests interrupt.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def warp() -> None:
    """Start Warp, which a test of kernels alone would find asleep."""
    start_warp()


@pytest.fixture(autouse=True)
def seed() -> int:
    """Seed every generator that a test may draw from; the seed itself for those that make their own."""
    random.seed(SEED)
    np.random.seed(SEED)
    torch.manual_seed(SEED)
    return SEED


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real assets; the test skips when it is absent."""
    folder = Path(os.environ.get("PHYSGRAPH_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no real assets: {folder} is not a folder (set PHYSGRAPH_DATA)")
    return folder


@pytest.fixture(scope="session")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A function from a sample's name to its shot file, written once per session; do not change the file."""
    pytest.importorskip("pxr", reason="samples are written with usd-core")
    from stages import built

    from physgraph_usd.usd.write.sample_stage import write_stage

    written: dict[str, Path] = {}

    def write(name: str) -> Path:
        if name not in written:
            written[name] = write_stage(built(name), tmp_path_factory.mktemp(name) / f"{name}.usdc")
        return written[name]

    return write


@pytest.fixture
def stage(tmp_path: Path) -> "Usd.Stage":
    """A stage in metres with a root transform ``/World``, in a file of its own."""
    from stages import new_stage

    return new_stage(tmp_path / "s.usda")


@pytest.fixture
def dressed(tmp_path: Path) -> Path:
    """A shot of a coat with all that depends on topology, under a parent that mirrors it."""
    from layers import MIRROR, dress_up, make_shot

    path = tmp_path / "shot.usda"
    dress_up(make_shot(path, matrix=MIRROR))
    return path


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip GPU tests, with the reason, where there is no CUDA device."""
    gpu = [item for item in items if item.get_closest_marker("gpu")]
    if not gpu:
        return
    if not torch.cuda.is_available():
        for item in gpu:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def pytest_collection_finish() -> None:
    """Hold every annotated tensor shape to its word; keep torch on one thread, as commands do.

    Its sums depend on how many share them, so that a test of a chaotic scene would depend on which ran before it.
    """
    check_shapes("physgraph_usd")
    torch.set_num_threads(1)
