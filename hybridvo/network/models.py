"""The networks that the methods use: which file, which device, read once."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridvo.errors import CheckpointError, InputError

if TYPE_CHECKING:
    import torch

    from hybridvo.hypotheses.selector import Scorer


class Models:
    """Networks by name, read on first use.

    Args:
        device: ``cpu``, ``cuda``, or ``auto`` for cuda where there is one.
        weights: files to be read instead of the pretrained weights of a name.

    Raises:
        InputError: a device that is not there.
    """

    def __init__(
        self, device: str = "cpu", weights: Mapping[str, str | Path] | None = None
    ) -> None:
        self.device = torch_device(device)
        self.weights = {name: Path(file) for name, file in (weights or {}).items()}
        self._networks: dict[str, Any] = {}

    def path(self, name: str) -> Path:
        """File of the weights of a network.

        Raises:
            CheckpointError: there are none (the message lists those known).
        """
        from hybridvo.network.weights import pretrained

        return self.weights.get(name) or pretrained(name)

    def network(self, name: str) -> torch.nn.Module:
        """A network, in the form that is fastest on its device.

        Raises:
            CheckpointError: no such weights, or damaged ones.
        """
        import torch

        from hybridvo.network.weights import load_weights

        if name not in self._networks:
            network = load_weights(self.path(name))[0].eval().to(self.device)
            self._networks[name] = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return self._networks[name]

    def scorer(self) -> Scorer:
        """The selector network.

        Raises:
            CheckpointError: no such weights, weights of another network, or damaged ones.
        """
        from hybridvo.network.judge import JudgeNetwork
        from hybridvo.network.scorer import NetworkScorer

        network = self.network("judge")
        if not isinstance(network, JudgeNetwork):
            raise CheckpointError(
                f"{self.path('judge')}: expected the weights of a selector, got another network's."
            )
        return NetworkScorer(network, self.device)


@functools.cache
def default_models(device: str = "cpu") -> Models:
    """The pretrained networks, shared by all estimates of a process."""
    return Models(device)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run torch's CPU kernels on one thread, and as before afterwards.

    A pair at 128x256 is too little work for several threads, which wait for each other: on a busy
    machine that takes ten times as long.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def torch_device(device: str) -> str:
    """``cpu`` or ``cuda`` for a device asked for.

    Raises:
        InputError: ``cuda`` on a machine, or with a build of torch, that has none.
    """
    if device == "cpu":
        return device
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if device == "cuda":
        raise InputError(
            "device cuda: this machine, or this build of torch, has no CUDA device; use cpu."
        )
    return "cpu"
