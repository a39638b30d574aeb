"""Pictures of stated doubt: reliability of a probability, normalised errors of covariances."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hybridvo.errors import InputError
from hybridvo.files import atomic_write

__all__ = ["plot_calibration"]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_MARKERS = ("o", "s", "D", "^", "v", "P")
FEW = 5
"""Answers below which a bin's point is hollow, without its interval, which covers the axis."""
_SIZES = (lambda n: n >= FEW, lambda n: 0 < n < FEW)


def plot_calibration(
    groups: Mapping[str, Mapping[str, Any]], path: str | os.PathLike[str], *, title: str = ""
) -> None:
    """Draw stated probability against observed frequency, and how often each is stated.

    Args:
        groups: name to what :func:`hybridvo.evaluation.calibration.reliability` returned.
        path: picture to write, .png.
        title: line above the picture.

    Raises:
        InputError: no group, or another kind of file. OutputError: it cannot be written.
    """
    if not groups or Path(path).suffix != ".png":
        raise InputError(
            f"plot_calibration: expected at least one group and a .png, got {len(groups)} groups "
            f"and {Path(path).name}."
        )
    figure = Figure(figsize=(7.2, 7.0), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, height_ratios=[3.0, 1.0], sharex=True)
    upper.plot([0, 1], [0, 1], color="#999999", linewidth=1.0, zorder=1)
    width = 0.8 / len(groups)
    for k, (name, found) in enumerate(groups.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        marker = _MARKERS[k % len(_MARKERS)]
        many, few = ([b for b in found["bins"] if test(b["answers"])] for test in _SIZES)
        x, y = _points(many)
        spread = [
            [b["observed"]["share"] - b["observed"]["low"] for b in many],
            [b["observed"]["high"] - b["observed"]["share"] for b in many],
        ]
        upper.errorbar(x, y, spread, color=colour, linestyle="none", elinewidth=0.9, alpha=0.6)
        label = f"{name}: {found['answers']} answers, Brier {found['brier']:.3f}"
        label += f", ECE {found['ece']:.3f}"
        upper.plot(x, y, marker=marker, color=colour, linewidth=1.2, label=label, markersize=6)
        upper.plot(*_points(few), marker, color=colour, markerfacecolor="white", markersize=5)
        steps = found["bins"]
        lower.bar(
            [0.5 * (b["low"] + b["high"]) + (k + 0.5 - len(groups) / 2) * width / len(steps)
             for b in steps],
            [b["answers"] for b in steps], width / len(steps), color=colour,
        )  # fmt: skip
    upper.set_ylabel("share that is right (95 % interval)", fontsize=9)
    upper.set_ylim(-0.02, 1.02)
    figure.legend(frameon=False, fontsize=8, loc="outside lower center", ncols=2)
    lower.set_yscale("symlog", linthresh=10)
    lower.set_ylim(bottom=0)
    lower.set_ylabel("answers", fontsize=9)
    lower.set_xlabel("stated probability of being right", fontsize=9)
    lower.set_xlim(-0.02, 1.02)
    for axes in (upper, lower):
        axes.grid(True, color="#e4e4e4", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=8)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    if title:
        upper.set_title(title, fontsize=10, loc="left")
    with atomic_write(path, "wb") as file:
        figure.savefig(file, format="png", metadata={"Software": None})


def _points(bins: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    """Stated and observed of some bins."""
    return [b["stated"] for b in bins], [b["observed"]["share"] for b in bins]
