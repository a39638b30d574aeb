"""The networks that the methods use: which file, which device; each is read once."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hybridvo.core import laboratory
from hybridvo.core.errors import CheckpointError, InputError

PWVO_KIND = "pwvo-hypotheses"
"""``kind`` in the options of our PWVO; the paper's is ``pwvo``."""


def load_weights(name_or_path: str | Path) -> tuple[Any, dict[str, Any]]:
    """Read a network and its model card.

    Args:
        name_or_path: the name of pretrained weights, or a file.

    Returns:
        The network, in evaluation mode on the CPU, and its card.

    Raises:
        CheckpointError: see :func:`hybridvo.network.weights.read_network`.
    """
    # torch is imported on first use: the method classical works without it
    from hybridvo.network.weights import read_network

    def make(options: dict[str, Any]) -> Any:
        if options.get("kind") == PWVO_KIND:
            from hybridvo.network.pwvo import PWVO, PWVOOptions

            return PWVO(PWVOOptions(**options))
        build = laboratory.wanted(
            laboratory.FUNCTIONS, "network_of_options", f"{name_or_path}"
        )
        return build(options)

    return read_network(name_or_path, make)


class Models:
    """Networks by name, read on first use.

    Args:
        device: ``cpu``, ``cuda``, or ``auto``: cuda where there is one.
        weights: files to use instead of the pretrained ones, by the network's name.
    """

    def __init__(
        self, device: str = "cpu", weights: Mapping[str, str | Path] | None = None
    ) -> None:
        # torch takes a second to import: not before a network is wanted
        self._wanted = torch_device(device) if device == "cuda" else device
        self.weights = dict(weights or {})
        self._networks: dict[str, Any] = {}

    @functools.cached_property
    def device(self) -> str:
        """``cpu`` or ``cuda``."""
        return torch_device(self._wanted)

    def __reduce__(self) -> tuple[Any, ...]:
        """In another process, take part in networks that are read there once."""
        files = {
            name: os.path.abspath(path) if Path(path).is_file() else path
            for name, path in self.weights.items()
        }
        return _models_of_process, (self.device, tuple(files.items()))

    def path(self, name: str) -> Path:
        """The file of a network's weights."""
        from hybridvo.network.weights import weights_file

        return weights_file(self.weights.get(name, name))

    def network(self, name: str) -> Any:
        """Return a network, in the memory format that is fastest on its device.

        Raises:
            CheckpointError: the file holds another kind of network.
        """
        import torch

        if name not in self._networks:
            # weights that were read in inference mode could never have a gradient
            with torch.inference_mode(False):
                self._networks[name] = self._read(name)
        return self._networks[name]

    def _read(self, name: str) -> Any:
        """Read a network and put it on the device."""
        import torch

        path = self.path(name)
        network, _ = load_weights(path)
        kind = network.options.kind
        expected = _kind_of(name)
        if kind != expected:
            raise CheckpointError(
                f"{path}: expected the weights of a {name}, got a {kind}'s."
            )
        return network.to(self.device, memory_format=torch.channels_last)


def network_names() -> tuple[str, ...]:
    """Names of the networks whose weights may be given."""
    papers = laboratory.find(laboratory.FUNCTIONS, "weights")
    files = [] if papers is None else papers.glob("*.safetensors")
    return ("pwvo", *sorted(file.stem for file in files))


def _kind_of(name: str) -> str:
    """The ``kind`` in the options of a network of a method."""
    if name == "pwvo":
        return PWVO_KIND
    return name if name.startswith("vonet") else "pwvo"


@functools.cache
def _models_of_process(device: str, weights: tuple[tuple[str, Any], ...]) -> Models:
    """The networks of a process that got a copy of some from another."""
    return Models(device, dict(weights))


@functools.cache
def default_models(device: str = "cpu") -> Models:
    """The pretrained networks, which all estimates of a process use.

    Args:
        device: see :class:`Models`.
    """
    return Models(device)


def torch_device(device: str) -> str:
    """Resolve a device to ``cpu`` or ``cuda``.

    Args:
        device: ``cpu``, ``cuda``, or ``auto``: cuda where there is one.

    Raises:
        InputError: ``cuda`` on a machine without one.
    """
    if device == "cpu":
        return device
    if find_spec("torch") is None:
        if device == "cuda":
            raise InputError("device cuda: torch is not installed; use cpu.")
        return "cpu"
    import torch

    is_available = torch.cuda.is_available()
    if device == "cuda" and not is_available:
        raise InputError(
            "device cuda: this machine, or this torch, has no CUDA device; use cpu."
        )
    return "cuda" if is_available else "cpu"
