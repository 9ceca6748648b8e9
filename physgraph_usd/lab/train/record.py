"""A training run as a folder: configuration, log, checkpoint, and at the end the weights and their card."""

from __future__ import annotations

import dataclasses
import platform
import shlex
import tomllib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch

from ...errors import UsageError
from ...shot.plain_json import to_json
from ...solver.integrate.network import VECTORS
from ...solver.integrate.weights import NETWORKS, save_network
from ...version import __version__
from .loop import TrainConfig, Trainer
from .patches import PatchConfig, describe
from .rounds import RoundConfig

T = TypeVar("T")
CHECKPOINT, LOG = "checkpoint.pt", "log.jsonl"


def run_training(
    config_file: Path,
    out: Path,
    *,
    device: str = "cpu",
    resume: bool = False,
    minutes: float | None = None,
    say: Callable[[str], None] | None = None,
) -> Path:
    """Train a network and write its weights and card.

    Args:
        config_file: TOML with the keys of `TrainConfig` and tables ``network``, ``patches`` and ``rounds``.
        out: Folder for the log, the checkpoint, the weights and the card; created when missing.
        resume: Go on from the folder's checkpoint.
        minutes: In place of the configuration's.
        say: Called with a line of JSON at each measurement.

    Returns:
        The weights' file.

    Raises:
        UsageError: The configuration is wrong, or the folder's state does not fit ``resume``.
    """
    config = read_config(config_file)
    if minutes is not None:
        config = dataclasses.replace(config, minutes=minutes)
    checkpoint, log = out / CHECKPOINT, out / LOG
    if resume and not checkpoint.exists():
        raise UsageError(f"nothing to resume in {out}: there is no {CHECKPOINT}")
    weights = out / f"{config.kind}.safetensors"
    if not resume and any(file.exists() for file in (checkpoint, log, weights, weights.with_suffix(".json"))):
        raise UsageError(f"{out} holds a run; resume it or choose another folder")
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(config, device=device)
    if resume:
        trainer.resume(checkpoint)

    def note(line: str) -> None:
        with log.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
        if say:
            say(line)

    trainer.train(say=note, keep=checkpoint)
    digest = save_network(trainer.averaged(), weights)
    card = to_json(_card(trainer, digest, config_file=config_file, out=out))
    weights.with_suffix(".json").write_text(card + "\n", encoding="utf-8")
    return weights


def read_config(file: Path) -> TrainConfig:
    """Read a configuration; the path of the weights to start from is absolute or relative to the configuration.

    Raises:
        UsageError: The file is missing, is not TOML or has an unknown key or value.
    """
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"no configuration at {file}") from error
    except (ValueError, RecursionError) as error:  # no TOML, no UTF-8, or nested without end
        raise UsageError(f"{file} is not TOML: {error}") from error
    kind = values.get("kind", "physgraph")
    if kind not in NETWORKS:
        raise UsageError(f"{file}: unknown kind '{kind}'; known: {', '.join(NETWORKS)}")
    network = _filled(NETWORKS[kind].config, values.pop("network", {}), where=f"{file}, [network]")
    patches = _filled(PatchConfig, values.pop("patches", {}), where=f"{file}, [patches]")
    rounds = _filled(RoundConfig, values.pop("rounds", {}), where=f"{file}, [rounds]")
    unknown = [name for name in getattr(network, "vectors", ()) if name not in VECTORS]
    if unknown:
        raise UsageError(f"{file}: unknown vectors {', '.join(unknown)}; known: {', '.join(VECTORS)}")
    if start := values.get("start"):
        values["start"] = str(file.parent / str(start))
    return _filled(TrainConfig, values | {"network": network, "patches": patches, "rounds": rounds}, where=str(file))


def _card(trainer: Trainer, digest: str, *, config_file: Path, out: Path) -> dict[str, Any]:
    config = trainer.config
    cuda = trainer.device.startswith("cuda")
    command = ["physgraph-usd", "train", "--config", str(config_file), "--device", trainer.device, "-o", str(out)]
    return {
        "kind": config.kind,
        "sha256": digest,
        "package": __version__,
        "command": shlex.join(command),
        "config": asdict(config),
        "data": "procedural patches and moving scenes (lab/train/patches.py, scenes.py); no assets",
        "patches": describe(trainer.patches),
        "weights": sum(parameter.numel() for parameter in trainer.network.parameters()),
        "hardware": torch.cuda.get_device_name() if cuda else f"CPU, one thread, {platform.machine()}",
        "minutes": round(trainer.seconds / 60.0, 2),
        "iterations": trainer.iteration,
        "held_out": "gap over quasi-Newton's at as many evaluations, geometric mean over patches and rounds",
        "curve": trainer.curve,
    }


def _filled(kind: type[T], values: dict[str, Any], *, where: str) -> T:
    if not isinstance(values, dict):
        raise UsageError(f"{where} is {values!r}, no table")
    known = {field.name for field in dataclasses.fields(kind)}  # pyright: ignore[reportArgumentType]
    unknown = sorted(set(values) - known)
    if unknown:
        raise UsageError(f"{where}: unknown {', '.join(unknown)}; known: {', '.join(sorted(known))}")
    return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})
