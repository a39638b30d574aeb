"""Images of trajectories and of the maps of a pair, by matplotlib.

Uses the object interface with the Agg canvas: no window, no pyplot, no global state.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hybridvo.errors import InputError
from hybridvo.evaluation.maps import colour_wheel, flow_colours
from hybridvo.evaluation.metrics import Alignment, TrajectoryError, aligned
from hybridvo.files import atomic_write
from hybridvo.geometry import invert
from hybridvo.trajectory import Trajectory

# Okabe and Ito's palette without yellow: told apart by colour-blind readers, in print too
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_STYLES = ("-", "--", "-.", ":")
_TRUTH_COLOUR = "#222222"
_FORMATS = (".png", ".pdf", ".svg")


@dataclass(frozen=True, eq=False)
class _Path:
    """A line of the figure: label, positions (N, 3) in the first camera, and its errors."""

    label: str
    positions: np.ndarray
    style: dict[str, Any]
    error: TrajectoryError | None = None


def plot_trajectories(
    trajectories: Mapping[str, Trajectory],
    path: str | os.PathLike[str],
    *,
    truth: Trajectory | None = None,
    alignment: Alignment = "se3",
    title: str = "",
) -> None:
    """Draw trajectories from above and from the side, and their errors where truth is given.

    Everything is drawn in the first camera of the truth (or of each trajectory without truth):
    x right, y down, z forward. Estimates are aligned as ``alignment`` says, or by their first pose
    where a path does not determine it (the legend says which).

    Args:
        trajectories: name to trajectory, at least one.
        path: picture to write: .png, .pdf or .svg.
        truth: true trajectory, or None.
        alignment: see :func:`hybridvo.evaluation.metrics.ate`.
        title: line above the picture.

    Raises:
        InputError: no trajectory, or another kind of file. OutputError: it cannot be written.
    """
    path = Path(path)
    if not trajectories:
        raise InputError("plot_trajectories: expected at least one trajectory, got none.")
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: expected a picture name ending in {', '.join(_FORMATS)}.")
    paths = _paths(trajectories, truth, alignment)
    has_errors = any(line.error is not None for line in paths)
    figure = _figure(10.0, 7.4 if has_errors else 4.8, dpi=130)
    heights = [2.0, 1.0] if has_errors else [1.0]
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    above, aside = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    _draw_view(above, paths, (0, 2), "Top view", "x right [m]", "z forward [m]")
    _draw_view(aside, paths, (2, 1), "Side view", "z forward [m]", "y down [m]")
    aside.invert_yaxis()  # y points down in the camera: down on the page as well
    if has_errors:
        _draw_errors(figure.add_subplot(grid[1, :]), paths, truth)
    figure.legend(
        above.lines[: len(paths)],
        [line.label for line in paths],
        loc="outside lower center",
        ncols=min(3, len(paths)),
        frameon=False,
        fontsize=9,
    )
    # a folder's name: bytes that are no UTF-8 cannot be drawn, dollars in it are no formula
    title = title.encode("utf-8", "replace").decode("utf-8")
    figure.suptitle(title, fontsize=11, parse_math=False)
    # a name in letters that the font lacks is drawn as boxes, without a word on stderr for each
    quiet = warnings.catch_warnings(action="ignore", category=UserWarning)
    with atomic_write(path, "wb") as file, quiet:
        figure.savefig(file, format=path.suffix.lower()[1:])


def _figure(width: float, height: float, dpi: int = 100) -> Figure:
    """A figure with a canvas of its own: nothing is registered with pyplot, threads do not meet."""
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _paths(
    trajectories: Mapping[str, Trajectory], truth: Trajectory | None, alignment: Alignment
) -> list[_Path]:
    """The truth and every estimate, aligned to it, in the first camera."""
    found = []
    if truth is not None:
        style: dict[str, Any] = {"color": _TRUTH_COLOUR, "linewidth": 2.6, "alpha": 0.55}
        found.append(_Path("ground truth", _in_first_camera(truth, truth), style))
    for k, (name, trajectory) in enumerate(trajectories.items()):
        line = _STYLES[k // len(_COLOURS) % len(_STYLES)]
        style = {"color": _COLOURS[k % len(_COLOURS)], "linestyle": line, "linewidth": 1.4}
        if truth is None:
            found.append(_Path(name, _in_first_camera(trajectory, trajectory), style))
            continue
        fitted, error = aligned(trajectory, truth, alignment)
        found.append(_Path(_label(name, error), _in_first_camera(fitted, truth), style, error))
    return found


def _in_first_camera(path: Trajectory, first: Trajectory) -> np.ndarray:
    return path.transformed(invert(first.T_world_cam[0])).positions


def _label(name: str, error: TrajectoryError | None) -> str:
    if error is None or error.rmse is None:
        return f"{name} (no error: poses do not match)"
    unit, factor = ("m", 1.0) if error.rmse >= 1.0 else ("cm", 100.0)
    return f"{name}: ATE {error.rmse * factor:.3g} {unit} ({error.alignment})"


def _draw_view(
    axes: Any, paths: Sequence[_Path], plane: tuple[int, int], title: str, x: str, y: str
) -> None:
    """Paths in a plane of the first camera, with the same metres per inch on both axes."""
    _style(axes, title, x, y)
    for line in paths:
        axes.plot(*line.positions[:, plane].T, **line.style)
    axes.plot(*paths[0].positions[0, plane], "o", color=_TRUTH_COLOUR, markersize=5, zorder=5)
    centre = np.concatenate([line.positions for line in paths])[:, plane].mean(axis=0)
    axes.update_datalim([centre - 5e-4, centre + 5e-4])  # for a camera that does not move
    axes.margins(0.06)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()


def _draw_errors(axes: Any, paths: Sequence[_Path], truth: Trajectory | None) -> None:
    """Position error over time, or over the frames of a truth without time stamps."""
    known = [(line.error, line.style) for line in paths if line.error is not None]
    is_timed = truth is not None and truth.has_timestamps
    start = truth.timestamps[0] if truth is not None and is_timed else 0.0
    largest = max(float(np.max(error.translation)) for error, _ in known)
    unit, factor = ("m", 1.0) if largest >= 1.0 else ("cm", 100.0)
    _style(axes, "Position error", "time [s]" if is_timed else "frame", f"error [{unit}]")
    for error, style in known:
        axes.plot(error.timestamps - start, error.translation * factor, **style)
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0.01)


def _style(axes: Any, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10, loc="left", parse_math=False)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(True, color="#e4e4e4", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


# -- maps of a pair -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ImagePanel:
    """An image: (H, W, 3) uint8."""

    title: str
    image: np.ndarray


@dataclass(frozen=True, eq=False)
class FlowPanel:
    """A flow (H, W, 2) px; ``longest`` is the length at the rim of the wheel, px."""

    title: str
    flow: np.ndarray
    longest: float


@dataclass(frozen=True, eq=False)
class ScalarPanel:
    """A map (h, w).

    Args:
        title: above it.
        values: NaN is grey.
        unit: beside the bar; panels of one unit share its ends.
        high: value at the upper end of the bar; default: the 99th percentile.
        outline: (H, W) bool, whose border is drawn, or None.
    """

    title: str
    values: np.ndarray
    unit: str = ""
    high: float | None = None
    outline: np.ndarray | None = None


Panel = ImagePanel | FlowPanel | ScalarPanel


def maps_png(panels: Sequence[Panel], heading: str, aspect: float) -> bytes:
    """PNG of the panels, two in a row.

    Args:
        panels: at least one.
        heading: above all.
        aspect: width over height of the pair's images.

    Raises:
        InputError: no panel.
    """
    if not panels:
        raise InputError("maps_png: expected at least one panel, got none.")
    rows, width = -(-len(panels) // 2), 5.4  # inches a panel
    figure = _figure(2 * width, rows * (width / aspect * 0.92 + 0.42) + 0.45)
    grid = figure.add_gridspec(rows, 2)
    tops = _shared_tops(panels)
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(grid[k // 2, k % 2])
        axes.set_title(panel.title, fontsize=10, loc="left", parse_math=False)
        axes.set_xticks([])
        axes.set_yticks([])
        if isinstance(panel, ImagePanel):
            axes.imshow(panel.image)
        elif isinstance(panel, FlowPanel):
            axes.imshow(flow_colours(panel.flow, panel.longest), interpolation="nearest")
            _legend(axes, panel.longest)
        else:
            _scalar(figure, axes, panel, tops[panel.unit], aspect)
    figure.suptitle(heading, fontsize=11, x=0.01, ha="left", parse_math=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _shared_tops(panels: Sequence[Panel]) -> dict[str, float]:
    """Unit -> upper end of the bars: what stands side by side has one scale."""
    tops: dict[str, float] = {}
    for panel in panels:
        if isinstance(panel, ScalarPanel):
            known = panel.values[np.isfinite(panel.values)]
            top = panel.high
            if top is None:
                top = float(np.percentile(known, 99)) if known.size else 1e-12
            tops[panel.unit] = max(tops.get(panel.unit, 1e-12), top)
    return tops


def _legend(axes: Any, longest: float) -> None:
    """The colour wheel in the upper right corner, with the length at its rim."""
    inset = axes.inset_axes((0.86, 0.62, 0.13, 0.36))
    inset.imshow(colour_wheel())
    inset.set_axis_off()
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0}
    place = {"transform": axes.transAxes, "ha": "center", "va": "top"}
    axes.text(0.925, 0.6, f"{longest:.3g} px", fontsize=8, bbox=box, **place)


def _scalar(figure: Any, axes: Any, panel: ScalarPanel, top: float, aspect: float) -> None:
    colours = colormaps["magma"].with_extremes(bad="#9a9a9a")
    # networks see another shape of image; shown in that of the sequence
    shape = {"extent": (0.0, aspect, 1.0, 0.0), "interpolation": "nearest"}
    drawn = axes.imshow(panel.values, cmap=colours, vmin=0.0, vmax=top, **shape)
    if panel.outline is not None and panel.outline.any() and not panel.outline.all():
        rows, cols = panel.outline.shape
        x, y = (np.arange(cols) + 0.5) * aspect / cols, (np.arange(rows) + 0.5) / rows
        axes.contour(x, y, panel.outline, levels=[0.5], colors="#4fd1ff", linewidths=0.8)
    bar = figure.colorbar(drawn, ax=axes, fraction=0.04, pad=0.02, label=panel.unit)
    bar.ax.tick_params(labelsize=8)
