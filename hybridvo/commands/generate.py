"""``hybridvo generate``: draw training samples into a folder, and show some of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from hybridvo.errors import InputError
from hybridvo.synthetic.contact_sheet import write_contact_sheet
from hybridvo.synthetic.dataset import read_sample, write_samples
from hybridvo.synthetic.presets import PRESETS, Preset, load_preset


def generate(
    preset: str,
    count: int,
    out: str | Path,
    *,
    seed: int = 0,
    size: tuple[int, int] | None = None,
    workers: int = 1,
    report: Callable[[int, int], None] | None = None,
) -> Path:
    """Draw samples; a call that was interrupted goes on where it was.

    Args:
        preset: ``paper``, ``diverse`` or a YAML file such as ``configs/data_paper.yaml``, which
            names every range with its default.
        count: number of samples.
        out: folder; gets the shards, ``samples.json`` and ``contact_sheet.png``.
        seed: of the samples.
        size: (height, width) in pixels instead of the preset's.
        workers: processes.
        report: called with the samples done and asked for.

    Returns:
        The contact sheet.

    Raises:
        InputError: an unknown preset, a value that cannot be meant, or a folder of other samples.
        OutputError: a file that cannot be written.
    """
    for done in write_samples(_preset(preset, size), count, out, seed, workers):
        if report is not None:
            report(done, count)
    sheet = Path(out) / "contact_sheet.png"
    write_contact_sheet([read_sample(out, i) for i in range(min(6, count))], sheet)
    return sheet


def _preset(name: str, size: tuple[int, int] | None) -> Preset:
    if name in PRESETS:
        options = PRESETS[name]()
        if size is None:
            return options
        return cast(Preset, dataclasses.replace(cast(Any, options), height=size[0], width=size[1]))
    if not Path(name).is_file():
        known = ", ".join(PRESETS)
        raise InputError(f"--preset: expected {known} or a YAML file, got {name!r}.")
    return load_preset(name, size=size)
