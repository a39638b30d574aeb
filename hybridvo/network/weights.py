"""Weights on disk: safetensors, with the network's options and a model card in the header."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from hybridvo.errors import CheckpointError, InputError
from hybridvo.files import atomic_write

FORMAT = "hybridvo-network-1"  # value of the header's ``format`` key
SCALE = ":scale"  # behind the name of a tensor of 8 bits: what it is to be multiplied by
PRETRAINED = Path(__file__).parent / "pretrained"


def save_weights(path: str | Path, network: nn.Module, card: Mapping[str, Any]) -> Path:
    """Write a network's finite weights, its ``options`` and a model card of JSON values.

    A weight is a multiple of its output's largest over 127, in 8 bits; biases are float16.
    """
    header = {"options": asdict(network.options), "card": dict(card)}  # type: ignore[call-overload]
    texts = {name: json.dumps(x, sort_keys=True, allow_nan=False) for name, x in header.items()}
    state = {name: x.detach().cpu().contiguous() for name, x in network.state_dict().items()}
    tensors = {name: value for pair in state.items() for name, value in _rounded(*pair)}
    if broken := _broken(tensors):
        raise InputError(f"save_weights: {broken}.")
    with atomic_write(path, "wb") as file:
        file.write(save(tensors, {"format": FORMAT, **texts}))
    return Path(path)


def read_network(
    name_or_path: str | Path, make: Callable[[dict[str, Any]], nn.Module]
) -> tuple[nn.Module, dict[str, Any]]:
    """Network, float32 on the CPU, and card of a file of :func:`save_weights`."""
    path = weights_file(name_or_path)
    try:
        # older safetensors makes its tensors on torch's default device
        with torch.device("cpu"), safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}
        for name in [name for name in tensors if name.endswith(SCALE)]:
            tensors[name.removesuffix(SCALE)] *= tensors.pop(name)
        if (found := str(header.get("format"))) != FORMAT:
            raise ValueError(f"the header's format is {found[:80]!r}")
        options, card = (dict(json.loads(header[key])) for key in ("options", "card"))
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"{path}: expected a whole safetensors file of the format {FORMAT!r} with JSON options "
            f"and card in its header: {str(error)[:200]}. Pickled checkpoints (.pt, .pth) are "
            f"refused on purpose."
        ) from None
    if broken := _broken(tensors):
        raise CheckpointError(f"{path}: {broken}.")
    try:
        network = make(options)
        network.load_state_dict(tensors)
    except (InputError, TypeError, RuntimeError) as error:
        what = str(error).replace("\n\t", " ")[:600]
        raise CheckpointError(
            f"{path}: the weights do not fit their own options {options}: {what}"
        ) from None
    return network.eval(), card


def _rounded(name: str, value: torch.Tensor) -> Iterator[tuple[str, torch.Tensor]]:
    """A tensor (N, ...) in whole numbers of 8 bits, and the scale of each of N; (N,) as float16."""
    if value.dim() < 2:
        yield name, value.half()
        return
    scale = value.abs().flatten(1).amax(1).clamp(min=1e-30).view(-1, *[1] * (value.dim() - 1)) / 127
    yield name, torch.round(value / scale).to(torch.int8)
    yield name + SCALE, scale


def _broken(tensors: Mapping[str, torch.Tensor]) -> str:
    """Says which tensors hold values that are not finite; empty where none does."""
    names = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    return f"values that are not finite in {', '.join(names[:6])}" if names else ""


def weights_file(name_or_path: str | Path) -> Path:
    """The file of a pretrained name, else the path itself; a CheckpointError where it is none."""
    known = {path.stem: path for path in PRETRAINED.glob("*.safetensors")}
    path = known.get(str(name_or_path), name_or_path)
    if not os.path.isfile(path):  # where Path.is_file() raises: a name that is too long
        raise CheckpointError(f"{path}: no such weights. Pretrained: {', '.join(sorted(known))}.")
    return Path(path)
