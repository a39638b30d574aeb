"""Weights on disk: safetensors, with the network's options and a model card in the header.

A checksum in the header covers names, types, shapes and bytes of all tensors, the options
and the card. A weight matrix is stored in 8 bits: whole numbers, and beside them a tensor
of one scale for each output, by which they are to be multiplied.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from hybridvo.core import laboratory
from hybridvo.core.checks import brief
from hybridvo.core.errors import CheckpointError, InputError

FORMAT = "hybridvo-network-2"
"""Value of the header's key ``format``."""
SCALE = ":scale"
"""End of the name of a tensor of scales; before it stands the name of the 8-bit tensor."""
MAX_INT8 = 127
MIN_LARGEST = 1e-30
"""Numerical guard: smallest value by which the weights of an output are divided."""
NAMES_SHOWN = 6
"""Tensors that an error message names."""
PRETRAINED = Path(__file__).parent / "pretrained"
"""The folder of the network that the methods use."""


def save_weights(
    path: str | Path, network: nn.Module, card: Mapping[str, Any]
) -> Path:
    """Write a network's weights, its ``options`` and a model card.

    Weight matrices are rounded to multiples of their output's largest value over 127, in 8
    bits; biases to float16.

    Args:
        path: the file to write.
        network: with finite weights, and a dataclass as ``options``.
        card: JSON values that describe the weights.

    Returns:
        The path.

    Raises:
        InputError: a weight is not finite.
        OutputError: the file cannot be written.
    """
    # a tracker writes nothing
    from hybridvo.core.files import atomic_write

    options = asdict(network.options)  # type: ignore[call-overload]
    header = {
        "options": _to_json(options),
        "card": _to_json(dict(card)),
        "format": FORMAT,
    }
    tensors: dict[str, torch.Tensor] = {}
    for name, value in network.state_dict().items():
        tensors |= _rounded(name, value.detach().cpu().contiguous())
    if broken := _not_finite(tensors):
        raise InputError(f"save_weights: {broken}.")
    header["checksum"] = checksum(tensors, header)
    with atomic_write(path, "wb") as file:
        file.write(save(tensors, header))
    return Path(path)


def _to_json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, allow_nan=False)


def checksum(tensors: Mapping[str, torch.Tensor], header: Mapping[str, str]) -> str:
    """SHA-256 of all tensors, by name, and of the header's texts except the checksum."""
    total = hashlib.sha256()
    for key in sorted(set(header) - {"checksum"}):
        total.update(json.dumps([key, header[key]]).encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        kind = [name, str(value.dtype), list(value.shape)]
        total.update(json.dumps(kind).encode())
        total.update(value.flatten().view(torch.uint8).numpy().data)
    return total.hexdigest()


def read_network(
    name_or_path: str | Path, make: Callable[[dict[str, Any]], nn.Module]
) -> tuple[nn.Module, dict[str, Any]]:
    """Read a file of :func:`save_weights`.

    Args:
        name_or_path: the name of pretrained weights, or a file.
        make: makes a network from the options in the file.

    Returns:
        The network, float32 in evaluation mode on the CPU, and its card.

    Raises:
        CheckpointError: there is no such file, it is damaged, its checksum is wrong or
            missing, or the weights do not fit the options.
    """
    path = weights_file(name_or_path)
    header, stored = _read_file(path)
    options, card = _parse_header(path, header)
    _verify_checksum(path, stored, header)
    tensors = _unrounded(path, stored)
    if broken := _not_finite(tensors):
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


NetworkT = TypeVar("NetworkT", bound=nn.Module)


def read_network_of(
    kind: type[NetworkT],
    name_or_path: str | Path,
    make: Callable[[dict[str, Any]], nn.Module],
) -> NetworkT:
    """Read a network that is of one class, in the memory format that is fastest on a CPU.

    Args:
        kind: the class.
        name_or_path: the name of pretrained weights, or a file.
        make: makes a network from the options in the file.

    Returns:
        The network, float32 in evaluation mode on the CPU.

    Raises:
        CheckpointError: the file is damaged, or holds another kind of network.
    """
    network, _ = read_network(name_or_path, make)
    if not isinstance(network, kind):
        raise CheckpointError(
            f"{name_or_path}: expected the weights of a PWVO, got another's."
        )
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def _read_file(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Header and tensors of a safetensors file."""
    try:
        # older safetensors makes its tensors on torch's default device
        with torch.device("cpu"), safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            stored = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise _unreadable(path, error) from None
    return header, stored


def _parse_header(
    path: Path, header: Mapping[str, str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options and card of a header."""
    try:
        stated = str(header.get("format"))
        if stated != FORMAT:
            raise ValueError(f"the header's format is {stated[:80]!r}")
        options = dict(json.loads(header["options"]))
        card = dict(json.loads(header["card"]))
    # JSON of many levels ends in a RecursionError
    except (KeyError, ValueError, TypeError, RecursionError) as error:
        raise _unreadable(path, error) from None
    return options, card


def _unreadable(path: Path, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"{path}: expected a whole safetensors file of the format {FORMAT!r} with JSON "
        f"options and card in its header: {str(error)[:200]}. Pickled checkpoints (.pt, "
        f".pth) are refused on purpose."
    )


def _verify_checksum(
    path: Path, tensors: Mapping[str, torch.Tensor], header: Mapping[str, str]
) -> None:
    """Refuse a file whose checksum is wrong."""
    stated = header.get("checksum", "none")
    computed = checksum(tensors, header)
    if stated != computed:
        raise CheckpointError(
            f"{path}: expected the checksum {computed[:16]} of its tensors, options and "
            f"card, got {stated[:16]!r} in its header: the file was damaged or changed "
            f"after it was written. Copy or download it again, or write it with "
            f"save_weights."
        )


def _rounded(name: str, value: torch.Tensor) -> dict[str, torch.Tensor]:
    """The tensors that stand for a weight in a file, by name.

    A tensor (N, ...) of two and more dimensions becomes one of 8 bits, and N scales; others
    become float16.
    """
    if value.dim() <= 1:
        return {name: value.half()}
    largest = value.abs().flatten(1).amax(1).clamp(min=MIN_LARGEST)
    scale = largest.view(-1, *[1] * (value.dim() - 1)) / MAX_INT8
    whole = torch.round(value / scale).to(torch.int8)
    return {name: whole, name + SCALE: scale}


def _unrounded(
    path: Path, stored: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """The weights, float32, of the tensors of a file."""
    tensors = {name: value.float() for name, value in stored.items()}
    scale_names = [name for name in tensors if name.endswith(SCALE)]
    for scale_name in scale_names:
        name = scale_name.removesuffix(SCALE)
        scale = tensors.pop(scale_name)
        try:
            tensors[name] *= scale
        except (KeyError, RuntimeError):
            raise CheckpointError(
                f"{path}: expected a tensor {name!r} that the scales {scale_name!r} fit, "
                f"got none. Write the file again with save_weights."
            ) from None
    return tensors


def _not_finite(tensors: Mapping[str, torch.Tensor]) -> str:
    """State which tensors hold values that are not finite; empty where none does."""
    names = [
        name for name, value in tensors.items() if not torch.isfinite(value).all()
    ]
    if not names:
        return ""
    return f"values that are not finite in {', '.join(names[:NAMES_SHOWN])}"


def pretrained() -> dict[str, Path]:
    """Name -> file, of all pretrained weights that are installed."""
    folders = [PRETRAINED]
    papers = laboratory.find(laboratory.FUNCTIONS, "weights")
    if papers is not None:
        folders.append(papers)
    files = [path for folder in folders for path in folder.glob("*.safetensors")]
    return {path.stem: path for path in files}


def weights_file(name_or_path: str | Path) -> Path:
    """Find the file of pretrained weights by their name, or check a path.

    Raises:
        CheckpointError: there is no such file.
    """
    known = pretrained()
    path = known.get(str(name_or_path), name_or_path)
    is_path = isinstance(path, str | os.PathLike)
    # os.path.isfile: Path.is_file() raises where a name is too long
    if is_path and os.path.isfile(path):
        return Path(path)
    name = path if is_path else brief(path)
    names = ", ".join(sorted(known))
    raise CheckpointError(
        f"{name}: no such weights. Pretrained: {names}{laboratory.more_with_it()}."
    )
