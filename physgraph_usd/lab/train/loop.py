"""The training loop: unroll steps on patches, follow the energy down, keep a record."""

from __future__ import annotations

import math
import os
import pickle
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import UsageError
from ...shot.plain_json import to_json
from ...solver.integrate.network import Physgraph, PhysgraphConfig
from ...solver.integrate.weights import integrator_of, load_network, make_network
from ..methods.paper_network import PaperConfig, PaperNetwork
from .bundle import Bundle, RoundBundle, Twin, deal, detached, unrolled
from .held_out import HeldOut
from .patches import Patch, PatchConfig, make_patches
from .rounds import Round, RoundConfig, make_rounds

HARMLESS = 0.02
"""Fraction of the energy at the start below which the logarithm of the gap stops to reward."""
MOST_GRADIENT = 1.0
"""Largest norm of the gradient."""
TWINS = 1 / 3
"""Fraction of the iterations in which a second descent shows how differences grow; the weight makes up for the rest."""
EVERY = 120.0
"""Seconds between measurements on held-out patches and rounds."""
HELD_OUT = 10_000
"""Seed of held-out patches and rounds, whatever the run's seed: runs are compared on equal ones."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run.

    Attributes:
        kind: "physgraph" or "physgraph-paper".
        seed: Of patches, weights and order.
        minutes: How long to train, patches not counted.
        iterations: Most iterations, or None.
        batch: Most patches an iteration; they are dealt into batches once, and a batch is stepped as one.
        unroll: Steps with gradient flow.
        segments: Most consecutive unrolls on a patch; each starts from the previous result.
        through_forces: Gradients flow through forces too, by differences; else through displacements only.
        loss: "ratio" or "log" of the gap, averaged over the steps.
        late: Weight of step k in that average, as the power of k: 0 counts all alike, more counts where an unroll ends.
        steady: Weight of how much an unroll magnifies the difference of two descents whose starts differ by noise, as a
            logarithm. Without, rounding decides where cloth folds.
        raw: Fraction of the starts that are the upsampled cage.
        middle: Fraction of the starts where an earlier unroll ended; the others come from a solved level below.
        own: Fraction of starts from a level below solved by the network itself; quasi-Newton solves the rest.
        turn: Turn each start at random; only where neither gravity nor guide has a direction.
        rate: Adam's first rate; it falls to a hundredth along a cosine.
        average: Decay of the weights' running mean, which is the result.
        held_out: Patches to measure on.
        rounds: Rounds of moving scenes with contact to train on beside the patches.
        start: File of weights to begin with, in TOML relative to it; "" for none.
    """

    kind: str = "physgraph"
    network: PhysgraphConfig | PaperConfig = field(default_factory=PhysgraphConfig)
    patches: PatchConfig = field(default_factory=PatchConfig)
    seed: int = 1
    minutes: float = 5.0
    iterations: int | None = None
    batch: int = 4
    unroll: int = 10
    segments: int = 3
    through_forces: bool = False
    loss: str = "log"
    late: float = 0.0
    steady: float = 0.0
    raw: float = 0.4
    middle: float = 0.15
    own: float = 0.5
    turn: bool = False
    rate: float = 3e-3
    average: float = 0.99
    held_out: int = 8
    rounds: RoundConfig = field(default_factory=RoundConfig)
    start: str = ""


class Trainer:
    """A network in training.

    Attributes:
        iteration: Iterations made.
        seconds: Time taken [s].
        curve: Measurements on held-out patches and rounds.
    """

    def __init__(self, config: TrainConfig, *, device: str = "cpu", data: Data | None = None) -> None:
        """Make patches, rounds and a network on "cpu" or a CUDA device; data that `data_of` gave are not made anew.

        Raises:
            UsageError: The weights to begin with are of another size.
            WeightsError: The weights cannot be read.
        """
        self.config, self.device = config, device
        torch.manual_seed(config.seed)
        self.network = make_network(config.network).to(device)
        if config.start:
            begun = load_network(Path(config.start), kind=config.kind)
            if begun.config != config.network:
                raise UsageError(f"{config.start} holds a network of another size than this configuration's")
            self.network.load_state_dict(begun.state_dict())
        self._mean = torch.optim.swa_utils.AveragedModel(
            self.network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(config.average), use_buffers=True
        )
        self._optimiser = torch.optim.Adam(self.network.parameters(), lr=config.rate)
        self.patches, rounds, rest, few = data or data_of(config)
        self._held_out = HeldOut(rest, few)
        through = config.through_forces
        self._bundles = [
            Bundle(batch, device=device, through_forces=through) for batch in deal(self.patches, config.batch)
        ]
        self._round_bundles = [
            RoundBundle(batch, device=device, through_forces=through) for batch in deal(rounds, config.batch)
        ]
        self._rng = np.random.default_rng(config.seed + 1)
        self.iteration, self.seconds = 0, 0.0
        self.curve: list[dict[str, Any]] = []

    def train(self, *, say: Callable[[str], None] | None = None, keep: Path | None = None) -> None:
        """Train until the time or the iterations are spent.

        Args:
            say: Called with a line of JSON at each measurement.
            keep: File for checkpoints, or None.
        """
        config = self.config
        measured, losses = self.seconds, []
        while self.progress < 1.0:
            began = time.perf_counter()
            losses.append(self.iterate())
            self.seconds += time.perf_counter() - began
            if self.seconds - measured >= EVERY or self.progress >= 1.0:
                measured = self.seconds
                row = {"iteration": self.iteration, "minutes": self.seconds / 60, "loss": float(np.mean(losses))}
                row |= {"held_out": self.held_out_ratios()} if config.held_out else {}
                losses = []
                self.curve.append(row)
                if say:
                    say(to_json(row, indent=None))
                if keep:
                    self.save(keep)

    @property
    def progress(self) -> float:
        """Finished fraction of the run."""
        by_time, most = self.seconds / (60.0 * self.config.minutes), self.config.iterations
        return by_time if most is None else max(by_time, self.iteration / most)

    def iterate(self) -> float:
        """Run an iteration; returns the mean loss."""
        config, done = self.config, self.progress
        for group in self._optimiser.param_groups:
            group["lr"] = config.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * min(done, 1.0))))
        steps = max(2, round(config.unroll * min(1.0, 0.3 + 2.8 * done)))
        self._optimiser.zero_grad()
        self.network.train()
        loss = self._descend(steps)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), MOST_GRADIENT)
        if all(bool(p.grad.isfinite().all()) for p in self.network.parameters() if p.grad is not None):
            self._optimiser.step()
            self._mean.update_parameters(self.network)
        self.iteration += 1
        return loss

    def _descend(self, steps: int) -> float:
        """Unroll a batch, segment after segment; gradients add up. Returns the mean loss."""
        config = self.config
        touching = bool(self._round_bundles) and self._rng.random() < config.rounds.share
        bundles = self._round_bundles if touching else self._bundles
        bundle = bundles[int(self._rng.integers(len(bundles)))]
        index = int(self._rng.integers(len(bundle.systems)))
        system = bundle.systems[index]
        system.energies.clear()

        def dice() -> Tensor:
            return torch.as_tensor(self._rng.random(system.garments), device=self.device)

        x = bundle.begin(index, dice, config=config)
        integrator = integrator_of(self.network)
        segments = int(self._rng.integers(1, config.segments + 1))
        if config.turn:
            turn = np.linalg.qr(self._rng.normal(size=(3, 3)))[0]
            x = x @ torch.as_tensor(turn * np.linalg.det(turn), dtype=x.dtype, device=x.device)
        twin = Twin(integrator, system, x) if config.steady and self._rng.random() < TWINS else None
        carry, total = integrator.start(system, x), 0.0
        before = system.energies[-1].detach()
        for _ in range(segments):
            before = system.energies[-1].detach()
            if twin is not None:
                twin.unroll(steps, other=carry.x)
            system.energies.clear()
            carry = unrolled(integrator, system, detached(carry), steps)
            reached = torch.stack(system.energies)  # K P
            bundle.learn(index, reached.detach())
            loss = loss_of(reached, before, bundle.least[index], kind=config.loss, late=config.late)
            if twin is not None:
                loss = loss + config.steady / TWINS * twin.growth(carry.x).log().mean()
            if not bool(loss.isfinite()):
                break
            (loss / segments).backward()
            total += float(loss.detach()) / segments
        bundle.keep(index, carry.x.detach(), system.energies[-1].detach() <= before)
        return total

    def averaged(self) -> Physgraph | PaperNetwork:
        """The running mean of the weights, ready for use."""
        network = make_network(self.config.network).to(self.device)
        network.load_state_dict(self._mean.module.state_dict())
        return network.requires_grad_(False).eval()

    def held_out_ratios(self) -> dict[str, float]:
        """`HeldOut.ratios` of the running mean."""
        return self._held_out.ratios(integrator_of(self.averaged().to("cpu")))

    def save(self, file: Path) -> None:
        """Write a checkpoint from which the run can go on."""
        state = {
            "network": self.network.state_dict(),
            "mean": self._mean.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "rng": self._rng.bit_generator.state,
            "torch": torch.get_rng_state(),
            "iteration": self.iteration,
            "seconds": self.seconds,
            "curve": self.curve,
            "bundles": [bundle.state() for bundle in (*self._bundles, *self._round_bundles)],
        }
        part = file.with_suffix(".part")
        torch.save(state, part)
        part.replace(file)

    def resume(self, file: Path) -> None:
        """Go on from a checkpoint of the same configuration.

        Raises:
            UsageError: The file is damaged, or holds anything but tensors and plain values.
        """
        try:
            with warnings.catch_warnings(action="ignore"):  # of what is refused anyway
                # Anything else in a pickle could run a command.
                state = torch.load(file, map_location=self.device, weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
            raise UsageError(f"{file} is no checkpoint of ours or is damaged: {str(error).splitlines()[0]}") from error
        try:
            self._take(state)
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise UsageError(f"{file} does not fit this configuration: {error}") from error

    def _take(self, state: dict[str, Any]) -> None:
        self.network.load_state_dict(state["network"])
        self._mean.load_state_dict(state["mean"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._rng.bit_generator.state = state["rng"]
        torch.set_rng_state(state["torch"].cpu())
        self.iteration, self.seconds, self.curve = state["iteration"], state["seconds"], state["curve"]
        for bundle, values in zip((*self._bundles, *self._round_bundles), state["bundles"], strict=True):
            bundle.restore(values)


Data = tuple[list[Patch], list[Round], list[Patch], list[Round]]
"""Patches and rounds to train on, and those to measure on."""


def data_of(config: TrainConfig) -> Data:
    """Patches and rounds of a configuration, the same for a seed with any number of processes."""
    workers, held = os.cpu_count() or 1, config.held_out
    patches = make_patches(config.patches, seed=config.seed, workers=min(workers, config.patches.count // 8))
    rest = make_patches(replace(config.patches, count=held), seed=HELD_OUT, workers=min(workers, held // 4))
    own = make_rounds(config.rounds, seed=config.seed, workers=workers)
    few = replace(config.rounds, scenes=config.rounds.held_out)
    return patches, own, rest, make_rounds(few, seed=HELD_OUT, workers=workers)


def loss_of(
    energies: Float[Tensor, "steps patches"],
    before: Float[Tensor, " patches"],
    least: Float[Tensor, " patches"],
    *,
    kind: str,
    late: float = 0.0,
) -> Float[Tensor, ""]:
    """Mean over patches of the gap or of its logarithm, relative to the start, step k weighted by a power of k.

    Args:
        energies: Energies after each step [J].
        before: Energies at the start [J].
        least: Least energies known [J].
        kind: "ratio" or "log".
        late: The power.
    """
    scale = torch.maximum(before - least, 1e-6 * before.abs()).clamp_min(1e-30)
    gap = (energies - least) / scale
    # Beyond the start's own gap only the logarithm counts: one patch that blows up must not outweigh the rest.
    if kind == "ratio":
        loss = torch.where(gap < 1.0, gap, 1.0 + gap.clamp_min(1.0).log())
    else:
        loss = (gap.clamp_min(0.0) + HARMLESS).log()
    weight = torch.arange(1, len(gap) + 1, dtype=gap.dtype, device=gap.device) ** late  # K
    return (weight / weight.sum()) @ loss.mean(dim=1)
