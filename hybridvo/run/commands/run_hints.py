"""What a finished run shows of its recording: one likely cause, and the command that removes it.

``hybridvo doctor`` asks more, and measures longer. Here is what costs little at the end of a run.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hybridvo.core.geometry import invert
from hybridvo.io.data.sequence import Sequence as Recording
from hybridvo.run.calibration import MAX_SCALE_ERROR
from hybridvo.run.commands.diagnosis.clocks import one_clock
from hybridvo.run.commands.diagnosis.rate import seems_in_milliseconds

CLOCK_PAIRS = 40
"""Pairs of neighbours by which the clocks of colour and depth are compared: a second or two."""
MIN_TRUE_MOTION_M = 0.01
"""Length of a true motion, m, from which it shows a scale."""
MIN_SCALE_PAIRS = 6
"""Motions by which a scale is known."""
REPLACED = ("--overwrite", "--resume")
"""Words of a command that do not belong into the next one."""


class Hint(NamedTuple):
    """The likely cause of wrong answers, and the option that removes it."""

    cause: str
    option: tuple[str, str]


def hint_of_run(
    recording: Recording,
    rows: Iterable[Mapping[str, Any]],
    readout_ms: float = 0.0,
    passes: int = 1,
) -> Hint | None:
    """Return what a finished run shows of its recording; None where that is nothing.

    Args:
        recording: The frames.
        rows: The steps, as ``RunFolder`` keeps them.
        readout_ms: What the turns of the camera show of a rolling shutter, ms; 0: nothing.
        passes: How often the recording was tracked.

    Returns:
        The first of these that applies: stamps in milliseconds, a wrong scale of depth, a late
        clock of depth, a rolling shutter.
    """
    return (
        _of_stamps(recording)
        or _of_scale(recording, rows)
        or _of_clocks(recording)
        or _of_shutter(readout_ms, passes)
    )


def next_command(
    command: Sequence[str], recording: Recording, hint: Hint, out: Path
) -> str:
    """Return the command line that does a run again, with the option of a hint.

    Args:
        command: The words of the run; none where a program started it.
        recording: Its frames.
        hint: The hint.
        out: Its output folder, which is left as it is.

    Example:
        >>> hint = Hint("", ("--fps", "15"))
        >>> words = ["hybridvo", "run", "my walk", "--out", "a", "--overwrite"]
        >>> next_command(words, None, hint, Path("a"))  # type: ignore[arg-type]
        "hybridvo run 'my walk' --fps 15 --out a-again"
    """
    words = list(command) or ["hybridvo", "run", str(recording.root)]
    name, value = hint.option
    kept = _without_options([w for w in words if w not in REPLACED], "--out", name)
    again = out.with_name(f"{out.name}-again")
    return shlex.join([*kept, name, value, "--out", str(again)])


def _without_options(words: list[str], *names: str) -> list[str]:
    """Return words without some options, and without their values."""
    kept = list[str]()
    is_value = False
    for word in words:
        if is_value:
            is_value = False
        elif word in names:
            is_value = True
        elif word.partition("=")[0] not in names:
            kept.append(word)
    return kept


def _of_stamps(recording: Recording) -> Hint | None:
    """Stamps that are milliseconds."""
    if not seems_in_milliseconds(recording.timestamps):
        return None
    usual = float(np.median(np.diff(recording.timestamps)))
    fps = f"{1000 / usual:.4g}"
    return Hint(
        f"frames are {usual:.4g} s apart by their stamps, which seem to be milliseconds: state "
        f"{fps} frames a second",
        ("--fps", fps),
    )


def _of_scale(
    recording: Recording, rows: Iterable[Mapping[str, Any]]
) -> Hint | None:
    """Motions that are longer or shorter than the true ones by one factor: that of depth."""
    poses = recording.poses
    if poses is None:
        return None
    ratios = []
    for row in rows:
        index, prev = row["index"], row["prev_index"]
        if row["status"] != "ok" or prev is None:
            continue
        T_true = invert(poses[index]) @ poses[prev]
        true_length = float(np.linalg.norm(T_true[:3, 3]))
        # NaN where a pose is not known
        if true_length > MIN_TRUE_MOTION_M:
            moved = np.array(row["T_curr_prev"])[:3, 3]
            ratios.append(float(moved @ T_true[:3, 3]) / true_length**2)
    if len(ratios) < MIN_SCALE_PAIRS:
        return None
    low, scale, high = np.quantile(ratios, (0.25, 0.5, 0.75))
    if abs(scale - 1) <= MAX_SCALE_ERROR or low <= 1 <= high or scale <= 0:
        return None
    units = float(recording.opened_with().get("depth_scale") or 1.0) * float(scale)
    right = f"{units:.4g}"
    return Hint(
        f"motions are {scale:.3g} times as long as the true ones, and so is depth: state "
        f"{right} units per metre",
        ("--depth-scale", right),
    )


def _of_clocks(recording: Recording) -> Hint | None:
    """Stamps of depth that are late or early against those of the images."""
    if recording.depth_timestamps is None:
        return None
    answer = one_clock(recording, CLOCK_PAIRS)
    if not answer.differs or answer.option is None:
        return None
    return Hint(answer.message, answer.option)


def _of_shutter(readout_ms: float, passes: int) -> Hint | None:
    """A rolling shutter that was seen, and not taken out."""
    if not readout_ms or passes > 1:
        return None
    return Hint(
        f"the rows of an image take {readout_ms:.0f} ms (rolling shutter)",
        ("--passes", "3"),
    )
