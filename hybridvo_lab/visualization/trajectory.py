"""A picture of a trajectory from above, beside the true one; no global state is touched."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from hybridvo.core.files import atomic_write
from hybridvo.core.geometry import invert
from hybridvo.core.trajectory import Trajectory
from hybridvo_lab.evaluation.metrics import (
    DegenerateError,
    PathError,
    aligned,
    ate,
    match,
)

# Colours of Okabe and Ito, which people with any kind of colour vision can distinguish.
BLUE = "#0072B2"
BLACK = "#222222"
ORANGE = "#E69F00"
RED = "#D55E00"
GRID_GREY = "#e4e4e4"
BAND_ALPHA = 0.2
SIGMAS = 3
"""Half of the width of the bands, standard deviations."""
MAX_BAND = 10.0
"""Height of the band of the error that is drawn, in largest errors."""
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
    covariances: np.ndarray | None = None,
) -> None:
    """Draw a trajectory from above as a PNG.

    Args:
        name: Name of the method, for the legend.
        est: The trajectory.
        path: The file.
        truth: The true one, if it is known.
        title: A text above the picture.
        states: State of the motion to each pose, as in :func:`trajectory_figure`.
        covariances: Of each position, as in :func:`trajectory_figure`.

    Raises:
        OutputError: The file cannot be written.
    """
    figure = trajectory_figure(
        name,
        est,
        truth=truth,
        title=title,
        states=states,
        covariances=covariances,
    )
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
    covariances: np.ndarray | None = None,
) -> Figure:
    """Draw a trajectory from above; with a true one, align it and draw its error over time.

    Args:
        name: Name of the method, for the legend.
        est: The trajectory.
        truth: The true one, if it is known.
        title: A text above the picture.
        states: State of the motion to each pose (``ok``, ``degraded``, ``failed``). Poses that
            are not ok are marked.
        covariances: (N, 3, 3) m^2, of each position since the first one, in the axes of ``est``;
            NaN where nothing is known. Three standard deviations are drawn as a band around the
            path, and as one that the error has to stay in.

    Returns:
        A figure with the path, and below it the position error if the ground truth is known.
    """
    figure = Figure(figsize=(10.0, 7.4), dpi=130, layout="constrained")
    style: dict[str, Any] = {"color": BLUE, "linewidth": 1.4}
    if truth is None:
        above = figure.subplots()
        first_pose = est.T_world_cam[0]
    else:
        start_error = _error_from_the_start(est, truth)
        above, below = figure.subplots(2, height_ratios=[2.0, 1.0])
        first_pose = truth.T_world_cam[0]
        _draw_truth(above, truth)
        below.set(xlabel="time [s]", ylabel="position error [cm]")
        alignment = aligned(est, truth)
        if covariances is not None:
            _draw_error_band(below, est, truth, covariances, start_error)
            R = alignment.trajectory.T_world_cam[0, :3, :3]
            turn = R @ est.T_world_cam[0, :3, :3].T
            covariances = turn @ covariances @ turn.T
        est = alignment.trajectory
        error = alignment.error
        if error is not None:
            seconds = error.stamps - truth.timestamps[0]
            below.plot(seconds, 100 * error.translation, label="aligned", **style)
            name = f"{name} ({_ate_in_words(error, alignment.kind)})"
    x, z = _from_above(est, first_pose)
    if covariances is not None:
        _draw_path_band(above, x, z, covariances, first_pose)
    above.plot(x, z, label=name, **style)
    _mark_poses(above, x, z, [] if states is None else list(states))
    _finish_axes(figure, above)
    handles, labels = above.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        frameon=False,
        fontsize=9,
        ncols=3,
    )
    for axes in figure.axes[1:]:
        if covariances is not None:
            axes.legend(loc="upper left", frameon=False, fontsize=8)
    printable_title = title.encode("utf-8", "replace").decode()
    figure.suptitle(printable_title, fontsize=11, parse_math=False)
    return figure


def _draw_truth(axes: Any, truth: Trajectory) -> None:
    """Draw the true path as a broad line."""
    x, z = _from_above(truth, truth.T_world_cam[0])
    axes.plot(x, z, label="ground truth", color=BLACK, linewidth=2.6, alpha=0.55)


def _error_from_the_start(est: Trajectory, truth: Trajectory) -> PathError | None:
    """Return the error of a path that begins at the true pose; None where nothing matches."""
    matched = match(est, truth)
    if matched.reason:
        return None
    try:
        return ate(matched, "origin")
    except DegenerateError:
        return None


def _draw_error_band(
    axes: Any,
    est: Trajectory,
    truth: Trajectory,
    covariances: np.ndarray,
    error: PathError | None,
) -> None:
    """Draw the error from the start on, and the three standard deviations that it should keep."""
    sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    band = 100 * SIGMAS * sigma
    seconds = est.timestamps - truth.timestamps[0]
    axes.fill_between(
        seconds,
        0,
        band,
        color=BLUE,
        alpha=BAND_ALPHA,
        linewidth=0,
        label=f"{SIGMAS} sigma since the start",
    )
    if error is not None:
        cm = 100 * error.translation
        axes.plot(
            error.stamps - truth.timestamps[0],
            cm,
            color=BLACK,
            linestyle="--",
            linewidth=1.0,
            label="started at the true pose",
        )
        if np.nanmax(band, initial=0.0) > MAX_BAND * cm.max() > 0:
            axes.set_ylim(0, MAX_BAND * cm.max())


def _draw_path_band(
    axes: Any,
    x: np.ndarray,
    z: np.ndarray,
    covariances: np.ndarray,
    first_pose: np.ndarray,
) -> None:
    """Draw three standard deviations to both sides of the path; it does not set the scale."""
    R = first_pose[:3, :3].T
    in_plane = (R @ covariances @ R.T)[:, [0, 2]][:, :, [0, 2]]
    path = np.stack([x, z], axis=1)
    forward = np.gradient(path, axis=0) if len(path) > 1 else np.zeros_like(path)
    # a camera that stands keeps its side
    forward[~forward.any(axis=1)] = (0.0, 1.0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    side = np.stack([forward[:, 1], -forward[:, 0]], axis=1)
    variance = np.einsum("ni,nij,nj->n", side, in_plane, side)
    offset = SIGMAS * np.sqrt(np.maximum(variance, 0.0))[:, None] * side
    known = np.isfinite(offset).all(axis=1)
    pieces = []
    for piece in np.split(np.arange(len(path)), np.flatnonzero(~known)):
        inside = piece[known[piece]]
        if len(inside) > 1:
            left = path[inside] + offset[inside]
            right = path[inside] - offset[inside]
            pieces.append(np.concatenate([left, right[::-1]]))
    band = PolyCollection(
        pieces,
        facecolor=BLUE,
        alpha=BAND_ALPHA,
        linewidth=0,
        label=f"{SIGMAS} sigma",
    )
    axes.add_collection(band, autolim=False)


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
