"""A picture of a trajectory from above, beside the true one; no global state is touched."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from hybridvo.core.files import atomic_write
from hybridvo.core.geometry import invert
from hybridvo.core.trajectory import Trajectory
from hybridvo.lab.evaluation.metrics import PathError, aligned

# Colours of Okabe and Ito, which people with any kind of colour vision can distinguish.
BLUE = "#0072B2"
BLACK = "#222222"
ORANGE = "#E69F00"
RED = "#D55E00"
GRID_GREY = "#e4e4e4"
SMALLEST_EXTENT_M = 5e-4
"""Half of the smallest extent of the drawing, metres, for a camera that does not move."""


class _Marker(NamedTuple):
    """How poses with an uncertain motion are marked."""

    state: str
    colour: str
    shape: str


MARKERS = (_Marker("degraded", ORANGE, "D"), _Marker("failed", RED, "X"))


def plot_trajectory(
    name: str,
    est: Trajectory,
    path: str | Path,
    *,
    truth: Trajectory | None = None,
    title: str = "",
    states: Iterable[str] | None = None,
) -> None:
    """Draw a trajectory from above as a PNG.

    Args:
        name: Name of the method, for the legend.
        est: The trajectory.
        path: The file.
        truth: The true one, if it is known.
        title: A text above the picture.
        states: State of the motion to each pose, as in :func:`trajectory_figure`.

    Raises:
        OutputError: The file cannot be written.
    """
    figure = trajectory_figure(name, est, truth=truth, title=title, states=states)
    with atomic_write(path, "wb") as file:
        # The font lacks some characters, of which matplotlib warns.
        with warnings.catch_warnings(action="ignore"):
            figure.savefig(file, format="png")


def trajectory_figure(
    name: str,
    est: Trajectory,
    *,
    truth: Trajectory | None = None,
    title: str = "",
    states: Iterable[str] | None = None,
) -> Figure:
    """Draw a trajectory from above; with a true one, align it and draw its error over time.

    Args:
        name: Name of the method, for the legend.
        est: The trajectory.
        truth: The true one, if it is known.
        title: A text above the picture.
        states: State of the motion to each pose (``ok``, ``degraded``, ``failed``). Poses that
            are not ok are marked.

    Returns:
        A figure with the path, and below it the position error if the ground truth is known.
    """
    figure = Figure(figsize=(10.0, 7.4), dpi=130, layout="constrained")
    style: dict[str, Any] = {"color": BLUE, "linewidth": 1.4}
    if truth is None:
        above = figure.subplots()
        first_pose = est.T_world_cam[0]
    else:
        above, below = figure.subplots(2, height_ratios=[2.0, 1.0])
        first_pose = truth.T_world_cam[0]
        _draw_truth(above, truth)
        below.set(xlabel="time [s]", ylabel="position error [cm]")
        alignment = aligned(est, truth)
        est = alignment.trajectory
        error = alignment.error
        if error is not None:
            seconds = error.stamps - truth.timestamps[0]
            below.plot(seconds, 100 * error.translation, **style)
            name = f"{name} ({_ate_in_words(error, alignment.kind)})"
    x, z = _from_above(est, first_pose)
    above.plot(x, z, label=name, **style)
    _mark_poses(above, x, z, [] if states is None else list(states))
    _finish_axes(figure, above)
    figure.legend(loc="outside lower center", frameon=False, fontsize=9, ncols=3)
    printable_title = title.encode("utf-8", "replace").decode()
    figure.suptitle(printable_title, fontsize=11, parse_math=False)
    return figure


def _draw_truth(axes: Any, truth: Trajectory) -> None:
    """Draw the true path as a broad line."""
    x, z = _from_above(truth, truth.T_world_cam[0])
    axes.plot(x, z, label="ground truth", color=BLACK, linewidth=2.6, alpha=0.55)


def _finish_axes(figure: Figure, above: Any) -> None:
    """Label the axes, make both scales of the path equal, and draw grids."""
    above.set(xlabel="x right [m]", ylabel="z forward [m]")
    size = SMALLEST_EXTENT_M
    above.update_datalim([[-size, -size], [size, size]])
    above.set_aspect("equal", adjustable="datalim")
    above.autoscale_view()
    for axes in figure.axes:
        axes.grid(True, color=GRID_GREY, linewidth=0.8)


def _ate_in_words(error: PathError, kind: str) -> str:
    """Return the error of an aligned path, or why there is no number."""
    if kind == "origin":
        return (
            "ATE -: not enough poses, or all on a line; drawn from the first pose"
        )
    return f"ATE {100 * error.rmse:.3g} cm, {kind}"


def _mark_poses(axes: Any, x: np.ndarray, z: np.ndarray, states: list[str]) -> None:
    """Mark the start, the end, and the poses whose motion is not ok."""
    points: dict[str, Any] = {"linestyle": "none"}
    axes.plot(
        x[:1],
        z[:1],
        label="start",
        marker="o",
        color=BLACK,
        markersize=5,
        zorder=5,
        **points,
    )
    axes.plot(
        x[-1:],
        z[-1:],
        label="end",
        marker="s",
        color=BLUE,
        markersize=7,
        zorder=5,
        **points,
    )
    for marker in MARKERS:
        places = [k for k, state in enumerate(states) if state == marker.state]
        if places:
            axes.plot(
                x[places],
                z[places],
                label=f"{marker.state} ({len(places)})",
                marker=marker.shape,
                color=marker.colour,
                markersize=6,
                zorder=6,
                **points,
            )


def _from_above(path: Trajectory, first_pose: np.ndarray) -> np.ndarray:
    """Return x and z (2, N) of a path in the camera frame of a first pose, metres."""
    positions = path.transformed(invert(first_pose)).positions
    return positions[:, [0, 2]].T
