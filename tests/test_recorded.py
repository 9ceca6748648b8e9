"""Work that a card records and replays: checked here on the CPU, where it is called as it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import ShotSolver, open_for
from physgraph_usd.solver.integrate.coarse import CoarseLevels
from physgraph_usd.solver.mesh.recorded import CALLS, Recorded

READS = {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "is_nonzero"}
"""Operations that wait for a card."""


class Reading(TorchDispatchMode):
    """Refuses what a recording cannot hold: values read back, and shapes that depend on values."""

    def __torch_dispatch__(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, func: Any, types: Any, args: Sequence[Any], kwargs: Mapping[str, Any] | None
    ) -> Any:
        name = func.overloadpacket.__name__
        places = args[1] if name in {"index", "index_put"} else ()
        if name in READS or any(each is not None and each.dtype == torch.bool for each in places):
            raise AssertionError(f"{name} reads values back")
        return func(*args, **(kwargs or {}))


def test_what_is_recorded_reads_nothing_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Three frames of a skirt on its body, the cage solved as on a card."""
    called, kept, made = Counter[str](), Recorded.__call__, CoarseLevels.__init__

    def dense(self: CoarseLevels, *given: Any, **more: Any) -> None:
        made(self, *given, **more)
        self.dense = True

    def checked(self: Recorded, *given: Any) -> Sequence[Tensor]:
        name = self._function.__qualname__
        if "_search" in name or not all(isinstance(each, Tensor) for each in given):  # On the CPU these read numbers.
            return kept(self, *given)
        called[name] += 1
        with Reading():
            return kept(self, *given)

    monkeypatch.setattr(Recorded, "__call__", checked)
    monkeypatch.setattr(CoarseLevels, "__init__", dense)
    shot = open_for(str(write_sample("skirt", tmp_path)), RefineOptions(level=1))
    solver = ShotSolver(str(tmp_path / "skirt.usdc"), [1], RefineOptions(level=1), opened=shot)
    outcomes = [*solver(list(shot.scene.times)[30:33])]
    shot.close()
    assert all("error" not in each.record for each in outcomes)
    assert {name.split(".")[0] for name in called} == {"total_of", "MovingFrames", "CoarseLevels"}


def test_what_a_card_cannot_record_is_called_as_it_is(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    """Also later: a second try would fail as well."""
    tried = list[int]()

    def fail(*given: Any, **more: Any) -> None:
        tried.append(1)
        raise RuntimeError("out of memory")

    class OnCard(Tensor):
        is_cuda = True

    monkeypatch.setattr("physgraph_usd.solver.mesh.recorded._captured", fail)
    twice = Recorded(lambda x: [2.0 * x])
    with caplog.at_level("INFO", logger="physgraph_usd"):
        found = [float(twice(torch.full((1,), float(n)).as_subclass(OnCard))[0]) for n in range(3 * CALLS)]
    assert found == [2.0 * n for n in range(3 * CALLS)]
    assert len(tried) == 1
    assert "is not recorded: out of memory" in caplog.text
