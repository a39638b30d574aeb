"""Weights on disk: safetensors, with the network's options and a model card in the header.

A checksum in the header covers names, types, shapes and bytes of all tensors, options and card.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from hybridvo.checks import brief
from hybridvo.errors import CheckpointError, InputError
from hybridvo.files import atomic_write

FORMAT = "hybridvo-network-2"  # value of the header's ``format`` key
UNSUMMED = "hybridvo-network-1"  # of files until 0.1.0, which have no checksum
# behind the name of a tensor of 8 bits: what it is to be multiplied by
SCALE = ":scale"
PRETRAINED = Path(__file__).parent / "pretrained"
_logger = logging.getLogger(__name__)


def save_weights(
    path: str | Path, network: nn.Module, card: Mapping[str, Any]
) -> Path:
    """Write a network's finite weights, its ``options`` and a model card of JSON values.

    A weight is a multiple of its output's largest over 127, in 8 bits; biases are float16.
    """
    header = {"options": asdict(network.options), "card": dict(card)}  # type: ignore[call-overload]
    texts = {
        name: json.dumps(x, sort_keys=True, allow_nan=False)
        for name, x in header.items()
    }
    texts["format"] = FORMAT
    state = {
        name: x.detach().cpu().contiguous()
        for name, x in network.state_dict().items()
    }
    tensors = {
        name: value for pair in state.items() for name, value in _rounded(*pair)
    }
    if broken := _broken(tensors):
        raise InputError(f"save_weights: {broken}.")
    with atomic_write(path, "wb") as file:
        file.write(save(tensors, texts | {"checksum": checksum(tensors, texts)}))
    return Path(path)


def checksum(tensors: Mapping[str, torch.Tensor], header: Mapping[str, str]) -> str:
    """SHA-256 of all tensors, by name, and of the header's texts but the checksum."""
    total = hashlib.sha256()
    for key in sorted(set(header) - {"checksum"}):
        total.update(json.dumps([key, header[key]]).encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        total.update(
            json.dumps([name, str(value.dtype), list(value.shape)]).encode()
        )
        total.update(value.flatten().view(torch.uint8).numpy().data)
    return total.hexdigest()


def read_network(
    name_or_path: str | Path, make: Callable[[dict[str, Any]], nn.Module]
) -> tuple[nn.Module, dict[str, Any]]:
    """Network, float32 on the CPU, and card of a file of :func:`save_weights`.

    A file whose checksum is wrong or missing is refused; of an older format, which has none, it is
    read with a warning.
    """
    path = weights_file(name_or_path)
    try:
        # older safetensors makes its tensors on torch's default device
        with torch.device("cpu"), safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            stored = {name: file.get_tensor(name) for name in file.keys()}
        if (found := str(header.get("format"))) not in (FORMAT, UNSUMMED):
            raise ValueError(f"the header's format is {found[:80]!r}")
        options = dict(json.loads(header["options"]))
        card = dict(json.loads(header["card"]))
    except (
        *(SafetensorError, OSError, KeyError, ValueError, TypeError),
        RecursionError,  # JSON of many levels
    ) as error:
        raise CheckpointError(
            f"{path}: expected a whole safetensors file of the format {FORMAT!r} with JSON options "
            f"and card in its header: {str(error)[:200]}. Pickled checkpoints (.pt, .pth) are "
            f"refused on purpose."
        ) from None
    _check_sum(path, stored, header)
    tensors = {name: value.float() for name, value in stored.items()}
    for name in [name for name in tensors if name.endswith(SCALE)]:
        tensors[name.removesuffix(SCALE)] *= tensors.pop(name)
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


def _check_sum(
    path: Path, tensors: Mapping[str, torch.Tensor], header: Mapping[str, str]
) -> None:
    """Refuse a file that is not as it was written; warn where that cannot be told."""
    if header["format"] == UNSUMMED:
        remedy = (
            "whether it is damaged cannot be told; save_weights writes it with one"
        )
        _logger.warning(
            "%s: an older weights file without checksum: %s.", path, remedy
        )
        return
    stated = header.get("checksum", "none")
    true = checksum(tensors, header)
    if stated != true:
        raise CheckpointError(
            f"{path}: expected the checksum {true[:16]} of its tensors, options and card, got "
            f"{stated[:16]!r} in its header: the file was damaged or changed after it was "
            f"written. Copy or download it again, or write it with save_weights."
        )


def _rounded(name: str, value: torch.Tensor) -> Iterator[tuple[str, torch.Tensor]]:
    """A tensor (N, ...) in whole numbers of 8 bits, and the scale of each of N; (N,) as float16."""
    if value.dim() < 2:
        yield name, value.half()
        return
    scale = (
        value.abs()
        .flatten(1)
        .amax(1)
        .clamp(min=1e-30)
        .view(-1, *[1] * (value.dim() - 1))
        / 127
    )
    yield name, torch.round(value / scale).to(torch.int8)
    yield name + SCALE, scale


def _broken(tensors: Mapping[str, torch.Tensor]) -> str:
    """Says which tensors hold values that are not finite; empty where none does."""
    names = [
        name for name, value in tensors.items() if not torch.isfinite(value).all()
    ]
    return f"values that are not finite in {', '.join(names[:6])}" if names else ""


def weights_file(name_or_path: str | Path) -> Path:
    """The file of a pretrained name, else the path itself; a CheckpointError where it is none."""
    known = {path.stem: path for path in PRETRAINED.glob("*.safetensors")}
    path = known.get(str(name_or_path), name_or_path)
    is_path = isinstance(path, str | os.PathLike)
    # os.path.isfile: Path.is_file() raises where a name is too long
    if not is_path or not os.path.isfile(path):
        name = path if is_path else brief(path)
        raise CheckpointError(
            f"{name}: no such weights. Pretrained: {', '.join(sorted(known))}."
        )
    return Path(path)
