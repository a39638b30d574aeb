"""The networks that the methods use: which file, which device, read once."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hybridvo.errors import CheckpointError, InputError

SELECTION = {
    "pwvo": "softmax",
    "pwvo-paper": "softmax",
    "pwvo-uncertain": "mean",
    "pwvo-naive": "mean",
    "pixelwise": "mean",
    "vonet": "mean",
    "vonet-attention": "mean",
}
"""Methods that are a network alone, and how one motion is selected from its pixels, if any."""


def load_weights(name_or_path: str | Path) -> tuple[Any, dict[str, Any]]:
    """Network of pretrained or other weights and its card; see ``weights.read_network``."""
    from hybridvo.network.layers import NetworkOptions
    from hybridvo.network.pwvo import build_network
    from hybridvo.network.selector_net import SelectorNetwork, SelectorNetworkOptions
    from hybridvo.network.weights import read_network

    def make(options: dict[str, Any]) -> Any:
        if options.get("kind") == "selector":
            return SelectorNetwork(SelectorNetworkOptions(**options))
        return build_network(NetworkOptions(**options))

    return read_network(name_or_path, make)


class Models:
    """Networks by name, read on first use; ``weights``: files instead of the pretrained ones.

    Raises:
        InputError: a device, a network or a file that is not there.
    """

    def __init__(
        self, device: str = "cpu", weights: Mapping[str, str | Path] | None = None
    ) -> None:
        self.device = torch_device(device)
        self.weights = {name: Path(file) for name, file in (weights or {}).items()}
        known = ("selector", *SELECTION)
        for name, path in self.weights.items():
            if name not in known or not path.is_file():
                expected = f"NAME=FILE with {' or '.join(known)} and a file that exists"
                raise InputError(f"weights: expected {expected}, got {name}={path}.")
        self._networks: dict[str, Any] = {}

    def path(self, name: str) -> Path:
        """File of the weights of a network."""
        from hybridvo.network.weights import weights_file

        return self.weights.get(name) or weights_file(name)

    def network(self, name: str) -> Any:
        """A network, in the form that is fastest on its device."""
        import torch

        if name not in self._networks:
            path = self.path(name)
            network, _ = load_weights(path)
            own = name == "selector" or name.startswith("vonet")  # the other names are PWVOs
            if (kind := network.options.kind) != (name if own else "pwvo"):
                raise CheckpointError(f"{path}: expected the weights of a {name}, got a {kind}'s.")
            self._networks[name] = network.to(self.device, memory_format=torch.channels_last)
        return self._networks[name]


@functools.cache
def default_models(device: str = "cpu") -> Models:
    """The pretrained networks, shared by all estimates of a process."""
    return Models(device)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run torch's CPU kernels on one thread: several wait for each other on a single pair."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def torch_device(device: str) -> str:
    """``cpu`` or ``cuda`` for a device asked for; refuses ``cuda`` where there is none."""
    if device == "cpu":
        return device
    import torch

    there = torch.cuda.is_available()
    if device == "cuda" and not there:
        raise InputError("device cuda: this machine, or this torch, has no CUDA device; use cpu.")
    return "cuda" if there else "cpu"
