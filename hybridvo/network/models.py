"""The networks that the methods use: which file, which device, read once."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hybridvo.errors import CheckpointError, InputError

AVERAGED = ("pwvo-uncertain", "pwvo-naive", "pixelwise", "vonet", "vonet-attention")
SELECTION = {
    "pwvo": "softmax",
    "pwvo-paper": "softmax",
    **dict.fromkeys(AVERAGED, "mean"),
}
"""Methods that are a network alone, and how one motion is selected from its pixels."""


def load_weights(name_or_path: str | Path) -> tuple[Any, dict[str, Any]]:
    """Network of pretrained or other weights and its card; see ``weights.read_network``."""
    from hybridvo.network.pwvo import NetworkOptions, build_network
    from hybridvo.network.selector_net import (
        SelectorNetwork,
        SelectorNetworkOptions,
    )
    from hybridvo.network.weights import read_network

    def make(options: dict[str, Any]) -> Any:
        if options.get("kind") == "selector":
            return SelectorNetwork(SelectorNetworkOptions(**options))
        return build_network(NetworkOptions(**options))

    return read_network(name_or_path, make)


class Models:
    """Networks by name, read on first use; ``weights``: files instead of the pretrained ones."""

    def __init__(
        self, device: str = "cpu", weights: Mapping[str, str | Path] | None = None
    ) -> None:
        self.device = torch_device(device)
        self.weights = dict(weights or {})
        self._networks: dict[str, Any] = {}

    def path(self, name: str) -> Path:
        """File of the weights of a network."""
        from hybridvo.network.weights import weights_file

        return weights_file(self.weights.get(name, name))

    def network(self, name: str) -> Any:
        """A network, in the form that is fastest on its device."""
        import torch

        if name not in self._networks:
            path = self.path(name)
            network, _ = load_weights(path)
            # the other names are PWVOs
            own = name == "selector" or name.startswith("vonet")
            if (kind := network.options.kind) != (name if own else "pwvo"):
                raise CheckpointError(
                    f"{path}: expected the weights of a {name}, got a {kind}'s."
                )
            self._networks[name] = network.to(
                self.device, memory_format=torch.channels_last
            )
        return self._networks[name]


@functools.cache
def default_models(device: str = "cpu", selector: str = "selector") -> Models:
    """The pretrained networks, or another selector, shared by all estimates of a process."""
    return Models(device, {"selector": selector})


def torch_device(device: str) -> str:
    """``cpu`` or ``cuda`` for a device asked for; refuses ``cuda`` where there is none."""
    if device == "cpu":
        return device
    if find_spec("torch") is None:
        if device == "cuda":
            raise InputError("device cuda: torch is not installed; use cpu.")
        return "cpu"
    import torch

    there = torch.cuda.is_available()
    if device == "cuda" and not there:
        raise InputError(
            "device cuda: this machine, or this torch, has no CUDA device; use cpu."
        )
    return "cuda" if there else "cpu"
