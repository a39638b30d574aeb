"""One picture of the maps of a pair: flow in colours with their wheel, scalars with their bars."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.evaluation.maps import colour_wheel, flow_colours

COLUMNS = 2
PANEL_WIDTH_INCHES = 5.4


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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not panels:
        raise InputError("maps_png: expected at least one panel, got none.")
    rows = -(-len(panels) // COLUMNS)
    height = rows * (PANEL_WIDTH_INCHES / aspect * 0.92 + 0.42) + 0.45
    # the figure's own canvas: nothing is registered with pyplot, so threads do not meet
    figure = Figure(figsize=(COLUMNS * PANEL_WIDTH_INCHES, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(rows, COLUMNS)
    tops = _shared_tops(panels)
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(grid[k // COLUMNS, k % COLUMNS])
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
    figure.savefig(stream, format="png", metadata={"Software": None})
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
    from matplotlib import colormaps

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
