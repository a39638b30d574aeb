"""Weights on disk: safetensors, strict, with the network's options and a model card in the header.

No pickle: a weights file is data and cannot run anything. What a file says of itself is checked
before memory is spent on it: options, names, shapes and types first, then the values.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from hybridvo.errors import CheckpointError, InputError, OutputError
from hybridvo.network.judge import JudgeNetwork, JudgeOptions
from hybridvo.network.pwvo import NetworkOptions, build_network

__all__ = ["FORMAT", "load_weights", "pretrained", "pretrained_names", "save_weights"]

FORMAT = "hybridvo-network-1"
"""Value of the header's ``format`` key."""

SHIPPED = Path(__file__).parent / "shipped"

SAVED_TYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16, "float32": torch.float32}
AnyOptions = NetworkOptions | JudgeOptions

STORED_TYPES = {"F16": 2, "BF16": 2, "F32": 4}
"""safetensors type -> bytes per number."""

LISTED = 6
"""Mismatches named in an error before the rest is only counted."""


def save_weights(
    path: str | Path,
    network: nn.Module,
    options: AnyOptions,
    card: Mapping[str, Any],
    dtype: str = "float32",
) -> Path:
    """Write a network's weights, atomically: a half-written file never stands under ``path``.

    Args:
        path: of the file, by custom ``*.safetensors``; its folder must exist.
        network: built by ``build_network(options)``, or a :class:`JudgeNetwork`.
        options: of the network; stored in the header.
        card: model card, JSON values only: preset, samples seen, seed, command, commit, figures.
        dtype: ``float32``, or ``float16`` or ``bfloat16`` for half the size.

    Returns:
        The path.

    Raises:
        InputError: weights that are not of ``options``, not finite or not representable in
            ``dtype``, a card that is not JSON, an unknown ``dtype``.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if dtype not in SAVED_TYPES:
        raise InputError(f"save_weights: dtype {dtype!r} unknown; known: {', '.join(SAVED_TYPES)}.")
    try:
        metadata = {
            "format": FORMAT,
            "options": json.dumps(asdict(options), sort_keys=True),
            "card": json.dumps(dict(card), sort_keys=True, allow_nan=False),
        }
    except (TypeError, ValueError) as error:
        raise InputError(f"save_weights: the card must hold JSON values only: {error}.") from None
    state = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items()}
    problems = _mismatches({k: tuple(v.shape) for k, v in state.items()}, _expected(options))
    if problems:
        raise InputError(f"save_weights: the network is not of {options}: {_join(problems)}.")
    tensors = {name: value.to(SAVED_TYPES[dtype]) for name, value in state.items()}
    broken = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    if broken:
        raise InputError(
            f"save_weights: values that are not finite as {dtype} in {_join(broken)}. "
            f"Nothing was written."
        )
    _write(path, save(tensors, metadata=metadata))
    return path


def load_weights(path: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """Network of a weights file, in evaluation mode and float32 on the CPU.

    Args:
        path: of a file that :func:`save_weights` wrote.

    Returns:
        The network, whose ``options`` attribute says what it is, and the model card.

    Raises:
        CheckpointError: missing, truncated, no safetensors file (a pickle, text), of another
            program or architecture, or with values that are not finite; names the file and what
            does not match.
    """
    path = Path(path)
    if not os.path.isfile(path):  # where Path.is_file() raises: a name that is too long
        raise CheckpointError(f"{path}: no such weights file. {_known()}")
    try:
        # older safetensors makes its tensors on torch's default device
        with torch.device("cpu"), safe_open(path, framework="pt") as file:
            options, card = _read_header(path, file.metadata() or {})
            slices = {name: file.get_slice(name) for name in file.keys()}
            found = {name: tuple(s.get_shape()) for name, s in slices.items()}
            problems = _mismatches(found, _expected(options))
            problems += [
                f"{name} is stored as {s.get_dtype()}, expected one of {', '.join(STORED_TYPES)}"
                for name, s in slices.items()
                if s.get_dtype() not in STORED_TYPES
            ]
            if problems:
                raise CheckpointError(
                    f"{path}: the weights do not fit their own options {options}: "
                    f"{_join(problems)}."
                )
            state = {name: file.get_tensor(name).float() for name in found}
    except SafetensorError as error:
        raise CheckpointError(
            f"{path}: not a whole safetensors file ({str(error)[:200]}). Pickled checkpoints (.pt, "
            f".pth) are refused on purpose; if this was a weights file, copy or download it again."
        ) from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}.") from None
    broken = [name for name, value in state.items() if not torch.isfinite(value).all()]
    if broken:
        raise CheckpointError(f"{path}: values that are not finite in {_join(broken)}.")
    network = _skeleton(options)
    network.load_state_dict(state, strict=True, assign=True)
    for parameter in network.parameters():
        parameter.requires_grad_(True)
    return network.eval(), card


def pretrained_names() -> tuple[str, ...]:
    """Names of the weights that are shipped with the package."""
    return tuple(sorted(p.stem for p in SHIPPED.glob("*.safetensors")))


def pretrained(name: str) -> Path:
    """File of shipped weights.

    Args:
        name: one of :func:`pretrained_names`.

    Raises:
        CheckpointError: unknown name; the message lists those known.
    """
    if name not in pretrained_names():
        near = difflib.get_close_matches(str(name), pretrained_names(), n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise CheckpointError(f"weights {name!r} unknown.{hint} {_known()}")
    return SHIPPED / f"{name}.safetensors"


def _known() -> str:
    names = pretrained_names()
    return f"Shipped weights: {', '.join(names)}." if names else "No weights are shipped."


def _skeleton(options: AnyOptions) -> nn.Module:
    """Network without memory for its weights."""
    with torch.device("meta"):
        if isinstance(options, JudgeOptions):
            return JudgeNetwork(options)
        return build_network(options)


def _expected(options: AnyOptions) -> dict[str, tuple[int, ...]]:
    return {name: tuple(v.shape) for name, v in _skeleton(options).state_dict().items()}


def _read_header(path: Path, metadata: Mapping[str, str]) -> tuple[AnyOptions, dict[str, Any]]:
    """Options and card of a header, or an error that says what is foreign about it."""
    if metadata.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: a safetensors file, but not hybridvo's: expected format {FORMAT!r} in its "
            f"header, got {str(metadata.get('format'))[:80]!r}."
        )
    parsed = {}
    for key in ("options", "card"):
        try:
            parsed[key] = json.loads(metadata.get(key, ""))
        except (ValueError, RecursionError):
            raise CheckpointError(f"{path}: the header's {key!r} is not JSON.") from None
        if not isinstance(parsed[key], dict):
            raise CheckpointError(f"{path}: expected the header's {key!r} to be a JSON object.")
    kind = JudgeOptions if parsed["options"].get("kind") == "judge" else NetworkOptions
    names = {field.name for field in fields(kind)}
    unknown = set(parsed["options"]) - names
    if unknown:
        raise CheckpointError(
            f"{path}: unknown network options {str(sorted(unknown))[:200]}; known: "
            f"{sorted(names)}. Was it written by a later version of hybridvo?"
        )
    # An option that is younger than the file has its default, which is what the file was made with.
    try:
        return kind(**parsed["options"]), parsed["card"]
    except (InputError, TypeError) as error:
        raise CheckpointError(f"{path}: {str(error)[:300]}") from None


def _mismatches(
    found: Mapping[str, tuple[int, ...]], expected: Mapping[str, tuple[int, ...]]
) -> list[str]:
    """What separates two tables of names and shapes, in words."""
    problems = [f"missing {name}" for name in expected if name not in found]
    problems += [f"unexpected {name}" for name in found if name not in expected]
    problems += [
        f"{name} is {found[name]}, expected {shape}"
        for name, shape in expected.items()
        if name in found and found[name] != shape
    ]
    return problems


def _join(problems: list[str]) -> str:
    text = "; ".join(problem[:200] for problem in problems[:LISTED])
    return text + (f"; and {len(problems) - LISTED} more" if len(problems) > LISTED else "")


def _write(path: Path, content: bytes) -> None:
    """Beside the target, flushed, then renamed over it."""
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:64]}.")
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}.") from error
