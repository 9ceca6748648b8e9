"""Work that a card records and replays: checked here on the CPU, where it is called as it is."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from sheets import equilateral, level_of
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import ShotSolver, open_for
from physgraph_usd.solver.forces.self_contact import LEAST_ROOM, PairConstraints, SelfContact
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.coarse import CoarseLevels
from physgraph_usd.solver.level import Level
from physgraph_usd.solver.mesh.recorded import CALLS, Recordings, _Input

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


def checked(called: Counter[str], kept: Any) -> Any:
    """`Recordings.run` that notes names in a counter, and refuses what a recording cannot hold."""

    def run(self: Recordings, key: Any, function: Any, *given: Any) -> Sequence[Tensor]:
        name = function.__qualname__
        if "_search" in name or not all(isinstance(each, Tensor) for each in given):  # On the CPU these read numbers.
            return kept(self, key, function, *given)
        called[name] += 1
        # A system would keep values that exist after a replay only, and its recordings keep it.
        assert not any(isinstance(each.cell_contents, System) for each in function.__closure__ or ())
        with Reading():
            return kept(self, key, function, *given)

    return run


def test_what_a_card_records_reads_nothing_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Three frames of a skirt on its body, the cage solved and pairs padded as on a card."""
    called, made = Counter[str](), CoarseLevels.__init__

    def dense(self: CoarseLevels, *given: Any, **more: Any) -> None:
        made(self, *given, **more)
        self.dense = True

    monkeypatch.setattr(Recordings, "run", checked(called, Recordings.run))
    monkeypatch.setattr(CoarseLevels, "__init__", dense)
    monkeypatch.setattr(SelfContact, "aims", SelfContact.with_room)
    shot = open_for(str(write_sample("skirt", tmp_path)), RefineOptions(level=1))
    solver = ShotSolver(str(tmp_path / "skirt.usdc"), [1], RefineOptions(level=1), opened=shot)
    results = [*solver(list(shot.scene.times)[30:33])]
    shot.close()
    assert not any(result.telemetry.get("error") for result in results)
    assert {name.split(".")[0] for name in called} == {"total_of", "MovingFrames", "Metric"}
    assert called["total_of.<locals>.total"] > 10


def test_a_recording_is_given_again_what_changed():
    x = torch.zeros(3)
    own = _Input(x)
    assert own.differs(x)
    assert not own.differs(x)
    x += 1.0
    assert own.differs(x)
    assert own.differs(x.clone())


def test_room_for_more_pairs_changes_no_bit():
    level, gaps = gapped()
    own = SelfContact(level, gaps)
    roomy, x, forces = own.aimed(*own.with_room), level.rest, [torch.zeros_like(level.rest) for _ in range(2)]
    energies = [float(term.add_force(x, force)) for term, force in zip((own, roomy), forces, strict=True)]
    assert len(own.with_room[0]) == LEAST_ROOM > len(gaps.corners)
    assert energies[0] == energies[1] > 0.0
    assert torch.equal(*forces)


def gapped() -> tuple[Level, PairConstraints]:
    """A sheet, and pairs of each vertex with the first three, that push."""
    level = level_of(*equilateral(0.2, 0.2, 0.02))
    count = level.vertex_count
    corners = torch.stack([torch.arange(count), *(torch.full((count,), n) for n in range(3))], dim=1).int()
    weight = torch.tensor([[1.0, -0.5, -0.25, -0.25]], dtype=torch.float64).expand(count, 4).contiguous()
    up, one = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), torch.ones(count, dtype=torch.float64)
    return level, PairConstraints(corners, weight, up.expand(count, 3).contiguous(), 0.01 * one, 50.0 * one)


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
    recordings = Recordings()
    with caplog.at_level("INFO", logger="physgraph_usd"):
        found = [
            float(recordings.run("twice", lambda x: [2.0 * x], torch.full((1,), float(n)).as_subclass(OnCard))[0])
            for n in range(3 * CALLS)
        ]
    assert found == [2.0 * n for n in range(3 * CALLS)]
    assert len(tried) == 1
    assert "is not recorded: out of memory" in caplog.text
