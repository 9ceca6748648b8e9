"""The learned integrators: what holds for any weights, and that files which are not what they say are refused."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner
from cloth import finest_system, group_of, sheet, wave
from safetensors import safe_open
from safetensors.torch import save_file

from physgraph_usd.cli import main
from physgraph_usd.errors import WeightsError
from physgraph_usd.lab.methods import METHODS
from physgraph_usd.lab.methods.paper_network import PaperConfig
from physgraph_usd.lab.methods.random_networks import random_network
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.solver.integrate.base import Carry, Integrator, System
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.learned import LearnedMetric
from physgraph_usd.solver.integrate.network import VECTORS, Physgraph, PhysgraphConfig
from physgraph_usd.solver.integrate.stop import Budget
from physgraph_usd.solver.integrate.weights import NETWORKS, load_network, make_network, save_network

ALL = PhysgraphConfig(vectors=VECTORS, width=16, depth=3)
PLAIN = PhysgraphConfig(width=16)
PAPER = PaperConfig(latent=16, rounds=3)
SMALL = 0.1
"""Scale of random weights whose steps keep the cloth whole."""


def problem(dtype: torch.dtype = torch.float64, level: int = 1) -> tuple[System, torch.Tensor]:
    mesh, rest = sheet(6, 5)
    return finest_system(group_of(mesh, rest, level=level, dtype=dtype), wave(rest))


def run(integrator: Integrator, system: System, x: torch.Tensor, *, steps: int = 3) -> Carry:
    carry = integrator.start(system, x)
    for _ in range(steps):
        carry = integrator.step(system, carry)
    return carry


@pytest.mark.parametrize(
    "vectors",
    [
        ("metric", "move1", "diagonal"),
        ("secant", "metric", "metric1", "move1"),
        ("secant", "secant.normal", "metric.smooth", "diagonal.smooth"),
        ("secant", "metric", "secant.normal", "metric.normal", "metric.smooth", "secant.smooth"),
        ("secant", "metric.normal", "diagonal", "diagonal.normal", "diagonal1.normal"),
    ],
)
def test_the_kernels_do_what_torch_does(vectors: tuple[str, ...]):
    system, x = problem(torch.float32, level=2)
    network = random_network(PhysgraphConfig(vectors=vectors, width=16), seed=7, scale=0.3)
    assert isinstance(network, Physgraph)
    one, other = LearnedMetric(network), LearnedMetric(network, fuse=False)
    carry, same = one.start(system, x), other.start(system, x)
    for _ in range(7):  # More steps than secants are kept.
        carry = one.step(system, carry)
        same = other.follow(system, same, carry.x)
        move, expected = one.propose(system, carry), other.propose(system, same)
        assert float((move - expected).abs().max()) < 5e-5 * float(expected.abs().max())
        assert not bool(move[~system.free.squeeze(1)].any())


def test_another_networks_steps_go_on_from_a_memory_in_the_systems_precision():
    """A frame may be resumed by an integrator that was built since, whose network is in double precision."""
    system, x = problem(torch.float32, level=2)
    network = random_network(PhysgraphConfig(width=16), seed=7, scale=0.3)
    assert isinstance(network, Physgraph)
    carry = run(LearnedMetric(network), system, x)
    other = LearnedMetric(copy.deepcopy(network).double())
    expected, found = (each.step(system, each.resume(system, carry)).x for each in (LearnedMetric(network), other))
    torch.testing.assert_close(found, expected)


CONFIGURATIONS: dict[str, Callable[[dict[str, Any]], str]] = {
    "other width": lambda config: json.dumps(config | {"width": 17}),
    "unknown vector": lambda config: json.dumps(config | {"vectors": ["metric", "moon"]}),
    "empty configuration": lambda _: "{}",
    "endless configuration": lambda _: "[" * 100_000,
}


def spoilt(file: Path, how: str) -> None:
    """Spoil a weights file."""
    with safe_open(str(file), framework="pt") as opened:
        about = dict(opened.metadata())
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}
    data = file.read_bytes()
    if how == "missing":
        file.unlink()
    elif how == "cut":
        file.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        file.write_bytes(b"")
    elif how == "text":
        file.write_text("weights")
    elif how == "one bit":
        file.write_bytes(data[:-3] + bytes([data[-3] ^ 1]) + data[-2:])
    elif how == "other version":
        save_file(tensors, file, metadata=about | {"version": "0"})
    elif how == "no metadata":
        save_file(tensors, file)
    elif how in CONFIGURATIONS:
        config = CONFIGURATIONS[how](json.loads(about["config"]))
        save_file(tensors, file, metadata=about | {"config": config})
    else:
        network = make_network(PLAIN)
        network.decode.bias.data.fill_(torch.nan)
        save_network(network, file)


@pytest.mark.parametrize(
    ("how", "word"),
    [
        ("missing", "no weights at"),
        ("cut", "cannot be read"),
        ("empty", "cannot be read"),
        ("text", "cannot be read"),
        ("one bit", "damaged"),
        ("other version", "version '0'"),
        ("no metadata", "version None"),
        ("other width", "does not fit"),
        ("empty configuration", "'vectors' is missing"),
        ("endless configuration", "does not fit"),
        ("unknown vector", "moon"),
        ("NaN", "not finite"),
    ],
)
def test_s37_wrong_weights_are_refused_by_name(tmp_path: Path, how: str, word: str):
    file = tmp_path / "w.safetensors"
    save_network(random_network(PLAIN, seed=1), file)
    spoilt(file, how)
    with pytest.raises(WeightsError, match=word) as caught:
        load_network(file, kind="physgraph")
    assert str(file) in str(caught.value)


def test_s37_weights_of_the_other_kind_are_refused(tmp_path: Path):
    file = tmp_path / "w.safetensors"
    save_network(random_network(PAPER, seed=1), file)
    with pytest.raises(WeightsError, match="'physgraph-paper', not of 'physgraph'"):
        load_network(file, kind="physgraph")


@pytest.mark.parametrize("kind", ["physgraph", "physgraph-paper"])
def test_shipped_weights_solve_and_have_a_card(kind: str):
    file = NETWORKS[kind].file
    card = json.loads(file.with_suffix(".json").read_text())
    with safe_open(str(file), framework="pt") as opened:
        assert opened.metadata()["sha256"] == card["sha256"]
    system, x = problem(torch.float32, level=2)
    _, report = solve_level(system, METHODS[kind].build(), x, level=2, budget=Budget(8))
    assert report.energy_after < report.energy_before
    assert report.movers[kind] >= 6


def test_a_user_brings_weights_of_their_own(tmp_path: Path):
    """`refine --weights`: other numbers give another layer, which names them; what does not fit is refused."""
    stage = write_sample("swatch", tmp_path)
    own = tmp_path / "own.safetensors"
    digest = save_network(random_network(PLAIN, seed=5, scale=0.05), own)
    written, points = {}, {}
    for name, options in (("shipped", []), ("own", ["--weights", str(own)])):
        out = tmp_path / f"{name}.usda"
        small = ["--level", "1", "--frames", "1:1"]
        result = CliRunner().invoke(main, ["refine", str(stage), "-o", str(out), *small, *options])
        assert result.exit_code == 0, result.output
        written[name] = out.read_text()
        points[name] = [line for line in written[name].splitlines() if "point3f[] points" in line or " 1: [" in line]
    assert digest in written["own"]
    assert "weights" not in written["shipped"]
    assert points["own"]
    assert points["own"] != points["shipped"]
    for options, word in (
        (["--integrator", "quasi-newton", "--weights", str(own)], "has no weights"),
        (["--integrator", "physgraph", "--weights", str(NETWORKS["physgraph-paper"].file)], "not of 'physgraph'"),
        (["--integrator", "physgraph", "--weights", str(tmp_path / "none")], "no weights at"),
    ):
        result = CliRunner().invoke(main, ["refine", str(stage), "-o", str(tmp_path / "x.usda"), *options])
        assert result.exit_code != 0
        assert word in result.stderr
        assert not (tmp_path / "x.usda").exists()
