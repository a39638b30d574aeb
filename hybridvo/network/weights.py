"""Weights on disk: safetensors, with the network's options and a model card in the header."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from hybridvo.errors import CheckpointError, InputError
from hybridvo.files import atomic_write

FORMAT = "hybridvo-network-1"
"""Value of the header's ``format`` key."""
PRETRAINED = Path(__file__).parent / "pretrained"
DTYPES = {"float16": torch.float16, "float32": torch.float32}


class Weights(NamedTuple):
    """Content of a weights file: the network's options, its model card, float32 tensors by name."""

    path: Path
    options: dict[str, Any]
    card: dict[str, Any]
    tensors: dict[str, torch.Tensor]

    def build(self, kind: Callable[..., Any], network_of: Callable[[Any], nn.Module]) -> nn.Module:
        """The network of the file in evaluation mode, by the class of its options and its maker."""
        try:
            network = network_of(kind(**self.options))
            network.load_state_dict(self.tensors)
        except (InputError, TypeError, RuntimeError) as error:
            raise CheckpointError(
                f"{self.path}: the weights do not fit their own options {self.options}: "
                + str(error).replace("\n\t", " ")[:600]
            ) from None
        return network.eval()


def save_weights(
    path: str | Path, network: nn.Module, card: Mapping[str, Any], dtype: str = "float32"
) -> Path:
    """Write a network's weights, its ``options`` and a model card of JSON values.

    Raises:
        InputError: weights that are not finite or not representable in ``dtype`` (float32 or
            float16), a card that is not JSON.
        OutputError: the file cannot be written.
    """
    if dtype not in DTYPES:
        raise InputError(f"save_weights: dtype {dtype!r} unknown; known: {', '.join(DTYPES)}.")
    try:
        text = json.dumps(dict(card), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"save_weights: the card must hold JSON values only: {error}.") from None
    options = json.dumps(asdict(network.options), sort_keys=True)  # type: ignore[call-overload]
    tensors = {
        name: value.detach().cpu().contiguous().to(DTYPES[dtype])
        for name, value in network.state_dict().items()
    }
    _check_finite(f"save_weights ({dtype})", tensors, InputError)
    with atomic_write(path, "wb") as file:
        file.write(save(tensors, {"format": FORMAT, "options": options, "card": text}))
    return Path(path)


def read_weights(path: str | Path) -> Weights:
    """Content of a file of :func:`save_weights`, on the CPU.

    Raises:
        CheckpointError: missing, truncated, of another program, or with values that are not finite.
    """
    path = Path(path)
    if not os.path.isfile(path):  # where Path.is_file() raises: a name that is too long
        known = ", ".join(pretrained_names())
        raise CheckpointError(f"{path}: no such weights file. Pretrained weights: {known}.")
    try:
        # older safetensors makes its tensors on torch's default device
        with torch.device("cpu"), safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}
        if (found := str(header.get("format"))) != FORMAT:
            raise ValueError(f"the header's format is {found[:80]!r}")
        options, card = (dict(json.loads(header[key])) for key in ("options", "card"))
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"{path}: expected a whole safetensors file of the format {FORMAT!r} with JSON options "
            f"and card in its header: {str(error)[:200]}. Pickled checkpoints (.pt, .pth) are "
            f"refused on purpose."
        ) from None
    _check_finite(str(path), tensors, CheckpointError)
    return Weights(path, options, card, tensors)


def pretrained_names() -> tuple[str, ...]:
    """Names of the weights that come with the package."""
    return tuple(sorted(p.stem for p in PRETRAINED.glob("*.safetensors")))


def pretrained(name: str | Path) -> Path:
    """File of pretrained weights.

    Raises:
        CheckpointError: not one of :func:`pretrained_names`; the message lists them.
    """
    if name not in pretrained_names():
        known = ", ".join(pretrained_names())
        raise CheckpointError(f"weights {str(name)!r} unknown. Pretrained weights: {known}.")
    return PRETRAINED / f"{name}.safetensors"


def weights_file(name_or_path: str | Path) -> Path:
    """A pretrained name's file, else the path itself."""
    name = str(name_or_path)
    return pretrained(name) if name in pretrained_names() else Path(name_or_path)


def _check_finite(
    where: str, tensors: Mapping[str, torch.Tensor], error: type[InputError | CheckpointError]
) -> None:
    broken = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    if broken:
        raise error(f"{where}: values that are not finite in {', '.join(broken[:6])}.")
