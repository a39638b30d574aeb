"""What goes into a run: the flow, the weights, and facts of the machine and the images."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.flow import FlowProvider, dis_flow, fallback, file_flow
from hybridvo.options import Options
from hybridvo.pipeline import networks_of

DARK_LEVEL = 20.0
"""Grey levels (of 255) below which nine tenths of a dark image lie; lit rooms and night streets
have a tenth above 60."""


def flow_provider(sequence: Sequence, options: Options) -> FlowProvider:
    """Provider of the flow that the options ask for.

    Raises:
        InputError: flow files asked for where there are none, or with a stride above 1.
    """
    source, stride = options.flow.source, options.run.stride
    if source == "file":
        if not sequence.has_flow:
            raise InputError(f"{sequence.name}: there are no flow files; pass --flow dis.")
        if stride > 1:
            raise InputError(
                f"{sequence.name}: flow files lead from one frame to the next, not over a stride "
                f"of {stride}; pass --flow dis."
            )
        return file_flow(sequence, strict=options.run.strict)
    dis = dis_flow(options.flow.dis_preset, options.flow.forward_backward)
    if source == "auto" and sequence.has_flow and stride == 1:
        # a damaged file is no reason to stop where DIS can stand in
        return fallback(file_flow(sequence, strict=options.run.strict), dis)
    return dis


def weight_files(weights: Iterable[str], methods: Iterable[str]) -> dict[str, str]:
    """Network -> file of the ``NAME=FILE`` that ``--weights`` was given.

    Raises:
        InputError: another form, no such file, or a name that none of the methods uses.
    """
    files = {}
    known = sorted({name for method in methods for name in networks_of(method)})
    for text in weights:
        name, sign, path = text.partition("=")
        if not sign or name not in known:
            raise InputError(
                f"--weights: expected NAME=FILE with {' or '.join(known) or 'no name'} for these "
                f"methods, got {text!r}."
            )
        if not Path(path).is_file():
            raise InputError(f"--weights {name}: {path}: no such file.")
        files[name] = path
    return files


def is_dark(rgb: np.ndarray | None) -> bool:
    """Whether an image (H, W, 3) uint8 is too dark to see anything in."""
    if rgb is None:
        return False
    return float(np.percentile(rgb[::4, ::4].max(axis=2), 90)) < DARK_LEVEL
