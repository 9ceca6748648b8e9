"""Networks with random weights, to stress the guard."""

from __future__ import annotations

from typing import Any

import torch

from ...solver.integrate.weights import make_network


def random_network(config: Any, *, seed: int, scale: float = 1.0) -> Any:
    """A network with random weights, including the last layer."""
    generator = torch.Generator().manual_seed(seed)
    network = make_network(config)
    with torch.no_grad():
        for parameter in network.parameters():
            fan = parameter.shape[-1] if parameter.dim() > 1 else 1
            parameter.copy_(scale * torch.randn(parameter.shape, generator=generator) / fan**0.5)
    return network.requires_grad_(False).eval()
