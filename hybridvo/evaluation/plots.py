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
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hybridvo.errors import InputError
from hybridvo.evaluation.metrics import Alignment, PathError, aligned
from hybridvo.files import atomic_write
from hybridvo.geometry import invert
from hybridvo.trajectory import Trajectory

# Okabe and Ito's palette without yellow: told apart by colour-blind readers, in print too
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_STYLES = ("-", "--", "-.", ":")
_TRUTH_COLOUR = "#222222"
_FORMATS = (".png", ".pdf", ".svg")


class _Line(NamedTuple):
    """A path of the figure: positions (N, 3) in the first camera, and its errors."""

    label: str
    positions: np.ndarray
    style: dict[str, Any]
    error: PathError | None = None


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
    """
    path = Path(path)
    if not trajectories:
        raise InputError("plot_trajectories: expected at least one trajectory, got none.")
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: expected a picture name ending in {', '.join(_FORMATS)}.")
    lines = _lines(trajectories, truth, alignment)
    heights = [2.0, 1.0] if any(line.error is not None for line in lines) else [1.0]
    figure = _figure(10.0, 2.2 + 2.6 * len(heights), dpi=130)
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    above = _axes(figure, grid[0, 0], "Top view", "x right [m]", "z forward [m]")
    _draw_view(above, lines, (0, 2))
    aside = _axes(figure, grid[0, 1], "Side view", "z forward [m]", "y down [m]")
    _draw_view(aside, lines, (2, 1))
    aside.invert_yaxis()  # y points down in the camera: down on the page as well
    if len(heights) > 1:
        is_timed = truth is not None and truth.has_timestamps
        label = "time [s]" if is_timed else "frame"
        axes = _axes(figure, grid[1, :], "Position error", label, "error [cm]")
        for line in lines:
            if line.error is not None:
                stamps = line.error.stamps
                start = truth.timestamps[0] if truth is not None and is_timed else 0.0
                axes.plot(stamps - start, 100 * line.error.translation, **line.style)
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.01)
    labels, columns = [line.label for line in lines], min(3, len(lines))
    legend: dict[str, Any] = {"loc": "outside lower center", "frameon": False, "fontsize": 9}
    figure.legend(above.lines[: len(lines)], labels, ncols=columns, **legend)
    # a folder's name: bytes that are no UTF-8 cannot be drawn, dollars in it are no formula
    title = title.encode("utf-8", "replace").decode("utf-8")
    figure.suptitle(title, fontsize=11, parse_math=False)
    # a name in letters that the font lacks is drawn as boxes, without a word on stderr for each
    quiet = warnings.catch_warnings(action="ignore", category=UserWarning)
    with atomic_write(path, "wb") as file, quiet:
        figure.savefig(file, format=path.suffix.lower()[1:])


def _lines(
    trajectories: Mapping[str, Trajectory], truth: Trajectory | None, alignment: Alignment
) -> list[_Line]:
    """The truth and every estimate, aligned to it, in the first camera."""

    def positions(path: Trajectory, first: Trajectory) -> np.ndarray:
        return path.transformed(invert(first.T_world_cam[0])).positions

    found = []
    if truth is not None:
        style: dict[str, Any] = {"color": _TRUTH_COLOUR, "linewidth": 2.6, "alpha": 0.55}
        found.append(_Line("ground truth", positions(truth, truth), style))
    for k, (name, path) in enumerate(trajectories.items()):
        line = _STYLES[k // len(_COLOURS) % len(_STYLES)]
        style = {"color": _COLOURS[k % len(_COLOURS)], "linestyle": line, "linewidth": 1.4}
        if truth is None:
            found.append(_Line(name, positions(path, path), style))
            continue
        fitted, error, kind = aligned(path, truth, alignment)
        told = "no error: poses do not match"
        if error is not None:
            told = f"ATE {100 * error.rmse:.3g} cm, {kind}"
        found.append(_Line(f"{name} ({told})", positions(fitted, truth), style, error))
    return found


def _figure(width: float, height: float, dpi: int = 100) -> Figure:
    """A figure with a canvas of its own: nothing is registered with pyplot, threads do not meet."""
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _axes(figure: Figure, place: Any, title: str, x: str, y: str) -> Any:
    axes = figure.add_subplot(place)
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(True, color="#e4e4e4", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _draw_view(axes: Any, lines: Sequence[_Line], plane: tuple[int, int]) -> None:
    """Paths in a plane of the first camera, with the same metres per inch on both axes."""
    for line in lines:
        axes.plot(*line.positions[:, plane].T, **line.style)
    axes.plot(*lines[0].positions[0, plane], "o", color=_TRUTH_COLOUR, markersize=5, zorder=5)
    centre = np.concatenate([line.positions for line in lines])[:, plane].mean(axis=0)
    axes.update_datalim([centre - 5e-4, centre + 5e-4])  # for a camera that does not move
    axes.margins(0.06)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()


# -- maps of a pair -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Panel:
    """An image (H, W, 3) uint8, or a map (h, w) with a bar; NaN is grey.

    Bars of one ``unit`` share their ends: 0 and ``high``, by default the 99th percentile. The
    border of the ``outline`` (H, W) bool is drawn.
    """

    title: str
    values: np.ndarray
    unit: str = ""
    high: float | None = None
    outline: np.ndarray | None = None


def draw_panels(
    panels: Sequence[Panel],
    heading: str,
    aspect: float,
    *,
    columns: int = 2,
    inches: float = 5.4,
    format: str = "png",
) -> bytes:
    """Encoded image of panels (at least one), ``columns`` in a row, each ``inches`` wide.

    ``aspect`` is width over height of the pair's images; networks see images of another shape,
    which are shown in it.
    """
    rows = -(-len(panels) // columns)
    height = rows * (inches / aspect * 0.92 + 0.42) + (0.45 if heading else 0.0)
    figure = _figure(columns * inches, height)
    grid = figure.add_gridspec(rows, columns)
    tops = _shared_tops(panels)
    shape: dict[str, Any] = {"extent": (0.0, aspect, 1.0, 0.0), "interpolation": "nearest"}
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(grid[k // columns, k % columns])
        axes.set_title(panel.title, fontsize=min(10, 2 + 1.5 * inches), loc="left")
        axes.set_xticks([])
        axes.set_yticks([])
        if panel.values.ndim == 3:
            axes.imshow(panel.values, **shape)
            continue
        colours = colormaps["magma"].with_extremes(bad="#9a9a9a")
        drawn = axes.imshow(panel.values, cmap=colours, vmin=0.0, vmax=tops[panel.unit], **shape)
        if panel.outline is not None and panel.outline.any() and not panel.outline.all():
            h, w = panel.outline.shape
            x, y = (np.arange(w) + 0.5) * aspect / w, (np.arange(h) + 0.5) / h
            axes.contour(x, y, panel.outline, levels=[0.5], colors="#4fd1ff", linewidths=0.8)
        bar = figure.colorbar(drawn, ax=axes, fraction=0.04, pad=0.02)
        bar.set_label(panel.unit, fontsize=8)
        bar.ax.tick_params(labelsize=8)
    figure.suptitle(heading, fontsize=11, x=0.01, ha="left", parse_math=False)
    stream = io.BytesIO()
    figure.savefig(stream, format=format)
    return stream.getvalue()


def _shared_tops(panels: Sequence[Panel]) -> dict[str, float]:
    """Unit -> upper end of the bars: what stands side by side has one scale."""
    tops: dict[str, float] = {}
    for panel in panels:
        if panel.values.ndim == 2:
            known = panel.values[np.isfinite(panel.values)]
            top = panel.high
            if top is None:
                top = float(np.percentile(known, 99)) if known.size else 1e-12
            tops[panel.unit] = max(tops.get(panel.unit, 1e-12), top)
    return tops


# -- flow in colours ------------------------------------------------------------------------------

# Baker et al., "A Database and Evaluation Methodology for Optical Flow" (IJCV 2011): hues between
# six corners of the colour circle, as many steps as the eye tells apart in each part
_HUE_STEPS = np.cumsum([0, 15, 6, 4, 11, 13, 6])
_HUES = 255 * np.array(
    [[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [1, 0, 0]]
)


def flow_colours(flow: np.ndarray, longest: float | None = None) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a flow (H, W, 2) in the standard colours of Middlebury.

    Hue is the direction (red to the right, yellow-green downwards), saturation the length. Vectors
    of ``longest`` px have full saturation (default: the 99th percentile), longer ones are darker;
    no motion is white, NaN and inf are black.
    """
    flow = np.asarray(flow)
    known = np.isfinite(flow).all(axis=2)
    u, v = np.moveaxis(np.where(known[..., None], flow, 0.0), 2, 0)
    radius = (np.hypot(u, v) / (longest or longest_flow(flow)))[..., None]
    step = (np.arctan2(-v, -u) / np.pi + 1) / 2 * (_HUE_STEPS[-1] - 1)
    colour = np.stack([np.interp(step, _HUE_STEPS, channel) for channel in _HUES.T], axis=-1)
    colour = np.where(radius <= 1, 255 - radius * (255 - colour), 0.75 * colour)
    return (np.where(known[..., None], colour, 0.0) + 0.5).astype(np.uint8)


def longest_flow(flow: np.ndarray) -> float:
    """99th percentile of the lengths of a flow, px; 1 where nothing is known."""
    length = np.hypot(flow[..., 0], flow[..., 1])
    length = length[np.isfinite(length)]
    return max(float(np.percentile(length, 99)), 1e-6) if length.size else 1.0
