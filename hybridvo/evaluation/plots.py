"""Images of trajectories and of the maps of a pair, by matplotlib without global state."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure

from hybridvo.evaluation.metrics import aligned
from hybridvo.files import atomic_write
from hybridvo.geometry import invert
from hybridvo.trajectory import Trajectory

_BLUE, _BLACK = "#0072B2", "#222222"


def plot_trajectory(
    name: str,
    est: Trajectory,
    path: str | os.PathLike[str],
    *,
    truth: Trajectory | None = None,
    title: str = "",
) -> None:
    """Draw a trajectory from above, aligned to the truth and with its error, as a ``.png``."""
    figure = Figure(figsize=(10.0, 7.4), dpi=130, layout="constrained")
    heights = [1.0] if truth is None else [2.0, 1.0]
    above, *below = figure.subplots(len(heights), squeeze=False, height_ratios=heights)[:, 0]
    above.set(xlabel="x right [m]", ylabel="z forward [m]")
    style: dict[str, Any] = {"color": _BLUE, "linewidth": 1.4}
    if truth is not None:
        bold = {"label": "ground truth", "color": _BLACK, "linewidth": 2.6, "alpha": 0.55}
        above.plot(*_from_above(truth, truth), **bold)
        start = truth.timestamps[0] if truth.has_timestamps else 0.0
        unit = "time [s]" if truth.has_timestamps else "frame"
        below[0].set(xlabel=unit, ylabel="position error [cm]")
        est, error, kind = aligned(est, truth)
        if error is not None:
            below[0].plot(error.stamps - start, 100 * error.translation, **style)
            name = f"{name} (ATE {100 * error.rmse:.3g} cm, {kind})"
    above.plot(*_from_above(est, truth or est), label=name, **style)
    above.plot(0, 0, "o", color=_BLACK, markersize=5, zorder=5)
    above.update_datalim([[-5e-4, -5e-4], [5e-4, 5e-4]])  # a camera that does not move
    above.set_aspect("equal", adjustable="datalim")
    above.autoscale_view()
    for axes in (above, *below):
        axes.grid(True, color="#e4e4e4", linewidth=0.8)
        axes.set_axisbelow(True)
    figure.legend(loc="outside lower center", frameon=False, fontsize=9, ncols=3)
    figure.suptitle(title.encode("utf-8", "replace").decode(), fontsize=11, parse_math=False)
    with warnings.catch_warnings(action="ignore"), atomic_write(path, "wb") as file:  # of the font
        figure.savefig(file, format="png")


def _from_above(path: Trajectory, first: Trajectory) -> np.ndarray:
    """(2, N) x and z in the first camera of another path."""
    return path.transformed(invert(first.T_world_cam[0])).positions[:, [0, 2]].T


# -- maps of a pair -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Panel:
    """An image (H, W, 3) uint8, or a map (h, w) with a bar; NaN is grey."""

    title: str
    values: np.ndarray
    unit: str = ""  # bars of one unit share their ends
    high: float | None = None  # upper end of the bar; default: the 99th percentile
    outline: np.ndarray | None = None  # (H, W) bool, whose border is drawn

    @property
    def top(self) -> float:
        """Upper end of the bar."""
        known = self.values[np.isfinite(self.values)]
        top = float(np.percentile(known, 99)) if known.size and self.high is None else self.high
        return max(top or 0.0, 1e-12)


def flow_panel(title: str, flow: np.ndarray, longest: float) -> Panel:
    """A flow (H, W, 2) in colours, of full saturation at ``longest`` px."""
    return Panel(f"{title} (full colour: {longest:.3g} px)", flow_colours(flow, longest))


def write_panels(
    path: str | os.PathLike[str],
    panels: Sequence[Panel],
    heading: str,
    aspect: float,
    *,
    columns: int = 2,
    inches: float = 5.4,
) -> None:
    """Write a PNG of panels, all with one ratio of width over height, ``columns`` in a row."""
    rows = -(-len(panels) // columns)
    height = rows * (inches / aspect * 0.92 + 0.42) + (0.45 if heading else 0.0)
    figure = Figure(figsize=(columns * inches, height), layout="constrained")
    shape: dict[str, Any] = {"extent": (0.0, aspect, 1.0, 0.0), "interpolation": "nearest"}
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(rows, columns, k + 1)
        axes.set_title(panel.title, fontsize=min(10, 2 + 1.5 * inches), loc="left")
        axes.set_xticks([])
        axes.set_yticks([])
        if panel.values.ndim == 3:
            axes.imshow(panel.values, **shape)
            continue
        # what stands side by side has one scale
        top = max(p.top for p in panels if p.values.ndim == 2 and p.unit == panel.unit)
        colours = colormaps["magma"].with_extremes(bad="#9a9a9a")
        drawn = axes.imshow(panel.values, cmap=colours, vmin=0.0, vmax=top, **shape)
        if panel.outline is not None and panel.outline.any() and not panel.outline.all():
            h, w = panel.outline.shape
            x, y = (np.arange(w) + 0.5) * aspect / w, (np.arange(h) + 0.5) / h
            axes.contour(x, y, panel.outline, levels=[0.5], colors="#4fd1ff", linewidths=0.8)
        bar = figure.colorbar(drawn, ax=axes, fraction=0.04, pad=0.02)
        bar.set_label(panel.unit, fontsize=8)
        bar.ax.tick_params(labelsize=8)
    figure.suptitle(heading, fontsize=11, x=0.01, ha="left", parse_math=False)
    with atomic_write(path, "wb") as file:
        figure.savefig(file, format="png")


# -- flow in colours ------------------------------------------------------------------------------


def flow_colours(flow: np.ndarray, longest: float | None = None) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a flow (H, W, 2): hue is the direction, saturation the length.

    Vectors of ``longest`` px are fully saturated (default: the 99th percentile), longer ones dark;
    no motion is white, unknown is black.
    """
    known = np.isfinite(flow).all(axis=2)
    u, v = np.moveaxis(np.where(known[..., None], flow, 0.0), 2, 0)
    length = np.hypot(u, v) / (longest or longest_flow(flow))
    value = np.where(known, np.where(length > 1, 0.75, 1.0), 0.0)
    hsv = np.stack([np.arctan2(v, u) / (2 * np.pi) % 1, np.minimum(length, 1), value], axis=-1)
    return (255 * hsv_to_rgb(hsv) + 0.5).astype(np.uint8)


def longest_flow(flow: np.ndarray) -> float:
    """99th percentile of the lengths of a flow, px; 1 where nothing is known."""
    length = np.hypot(flow[..., 0], flow[..., 1])
    length = length[np.isfinite(length)]
    return max(float(np.percentile(length, 99)), 1e-6) if length.size else 1.0
