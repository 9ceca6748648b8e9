"""Weights on disk: safetensors with a self-description, refused with a clear error if the description does not match.

The file's metadata holds the kind of network, the configuration, the format's version and a hash of the numbers. A
truncated, edited or incompatible file never reaches a garment.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ...errors import WeightsError
from .base import Carry, Integrator, System
from .learned import LearnedMetric
from .network import VECTORS, Physgraph, PhysgraphConfig

VERSION = "2"
"""Format of the file and meaning of the features; different versions are refused."""
FOLDER = Path(__file__).resolve().parents[2] / "weights"
"""Folder of the shipped weights."""


class Learned(Integrator, Protocol):
    """An integrator with steps proposed by a network."""

    def propose(self, system: System, carry: Carry) -> Float[Tensor, "vertices 3"]:
        """The displacement of the next step [m]."""
        ...


@dataclass(frozen=True)
class Kind:
    """A kind of network.

    Attributes:
        config: Class of the configuration, a dataclass.
        network: Class of the network, constructed from a configuration and keeping the configuration as ``config``.
        integrator: Makes the unguarded integrator of a network.
        file: The shipped .safetensors.
    """

    config: type[Any]
    network: type[nn.Module]
    integrator: Callable[[Any], Learned]
    file: Path


NETWORKS = {"physgraph": Kind(PhysgraphConfig, Physgraph, LearnedMetric, FOLDER / "physgraph.safetensors")}
"""All kinds of networks by their name in weights files; `register_kind` adds a kind."""


def register_kind(name: str, kind: Kind) -> None:
    """Add a kind of network to `NETWORKS`."""
    NETWORKS[name] = kind


def kind_of(network: nn.Module) -> str:
    """The name of a network's kind."""
    return next(name for name, kind in NETWORKS.items() if isinstance(network, kind.network))


def integrator_of(network: nn.Module) -> Learned:
    """The unguarded integrator of a network."""
    return NETWORKS[kind_of(network)].integrator(network)


def make_network(config: Any) -> Any:
    """An untrained network of the configuration's kind."""
    return next(kind.network for kind in NETWORKS.values() if isinstance(config, kind.config))(config)


def save_network(network: nn.Module, file: Path) -> str:
    """Write weights with their self-description.

    Args:
        file: The .safetensors to write.

    Returns:
        The hash of the weights, in hexadecimal.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    metadata = {
        "kind": kind_of(network),
        "version": VERSION,
        "config": json.dumps(asdict(cast(Any, network).config)),
        "sha256": hash_of(tensors),
    }
    save_file(tensors, file, metadata=metadata)
    return metadata["sha256"]


def load_network(file: Path, *, kind: str, device: str = "cpu") -> nn.Module:
    """Read weights.

    Args:
        file: A file written by `save_network`.
        kind: A name in `NETWORKS`.
        device: Device for the weights.

    Returns:
        The network, ready for use.

    Raises:
        WeightsError: The file is missing, damaged, of a different kind or of a different version.
    """
    tensors, metadata = _read(Path(file))
    if metadata.get("version") != VERSION:
        raise WeightsError(f"{file} has version {metadata.get('version')!r}; this release reads {VERSION!r}")
    if metadata.get("kind") != kind:
        raise WeightsError(f"{file} holds weights of '{metadata.get('kind')}', not of '{kind}'")
    if metadata.get("sha256") != hash_of(tensors):
        raise WeightsError(f"{file} is damaged: its numbers do not have the hash that it names")
    try:
        network = make_network(_config(kind, json.loads(metadata.get("config", ""))))
        network.load_state_dict(tensors)
    except KeyError as error:
        raise WeightsError(f"{file} does not fit its own configuration: {error} is missing from it") from error
    except (ValueError, TypeError, RuntimeError) as error:  # RuntimeError: also endless nesting
        raise WeightsError(f"{file} does not fit its own configuration: {error}") from error
    if not all(bool(value.isfinite().all()) for value in tensors.values() if value.is_floating_point()):
        raise WeightsError(f"{file} holds numbers that are not finite")
    return network.requires_grad_(False).eval().to(device)


@cache
def shipped_network(kind: str) -> Any:
    """The network of a kind with the shipped weights.

    Raises:
        WeightsError: The weights are missing.
    """
    return load_network(NETWORKS[kind].file, kind=kind)


def weights_hash(file: Path) -> str:
    """The hash recorded in a weights file, "" if missing."""
    return _read(Path(file))[1].get("sha256", "")


def hash_of(tensors: dict[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and numbers, in hexadecimal."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def _read(file: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    if not file.is_file():
        raise WeightsError(f"no weights at {file}; `physgraph-usd train` makes them")
    try:
        with safe_open(str(file), framework="pt") as opened:
            names = list(opened.keys())
            return {name: opened.get_tensor(name) for name in names}, dict(opened.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{file} cannot be read: {error}") from error


def _config(kind: str, values: dict[str, Any]) -> Any:
    """A configuration from a file, with every field present; lists become tuples."""
    config = NETWORKS[kind].config
    for field in fields(config):
        _ = values[field.name]
    built = config(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})
    unknown = [name for name in getattr(built, "vectors", ()) if name not in VECTORS]
    if unknown:
        raise ValueError(f"unknown vectors {unknown}")
    return built
