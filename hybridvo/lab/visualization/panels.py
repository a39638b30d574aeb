"""Images and maps with colour bars, side by side in a PNG; flow in colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from hybridvo.core.files import atomic_write
from hybridvo.flow.colours import flow_colours, high_value, positive_percentile

COLOUR_MAP = "magma"
UNKNOWN_COLOUR = "#9a9a9a"
OUTLINE_COLOUR = "#4fd1ff"
LOW_PERCENTILE = 1
BAR_TICKS = 4
"""Ticks of a logarithmic colour bar."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One image of a figure, or a map with a colour bar, in which NaN is grey.

    Attributes:
        title: Text above it.
        values: (H, W, 3) uint8, an image, or (h, w), a map.
        unit: Unit of the map. Bars of one unit have the same ends, unless ``high`` is given.
        high: Upper end of the bar; by default the 99th percentile.
        outline: (H, W) bool, a region whose border is drawn, or None.
        log: Whether the bar is logarithmic, from the 1st percentile on.
    """

    title: str
    values: np.ndarray
    unit: str = ""
    high: float | None = None
    outline: np.ndarray | None = None
    log: bool = False

    @property
    def is_map(self) -> bool:
        """Whether it is a map with a colour bar, not an image."""
        return self.values.ndim == 2


class BarRange(NamedTuple):
    """The ends of a colour bar."""

    low: float
    high: float


@dataclass(frozen=True)
class _Layout:
    """Where the panels of a figure lie, in inches.

    matplotlib's automatic layouts leave gaps between images of a fixed aspect.
    """

    aspect: float  # width over height of a panel
    columns: int
    rows: int
    column_width: float  # of a panel with its bar
    heading_height: float

    title_height = 0.26

    @property
    def gap(self) -> float:
        return 0.02 * self.column_width

    @property
    def panel_width(self) -> float:
        bar_width = 0.11 * self.column_width
        return self.column_width - bar_width - self.gap

    @property
    def panel_height(self) -> float:
        return self.panel_width / self.aspect

    @property
    def row_height(self) -> float:
        return self.panel_height + self.title_height + self.gap

    @property
    def width(self) -> float:
        return self.columns * self.column_width

    @property
    def height(self) -> float:
        return self.rows * self.row_height + self.heading_height

    def left_of(self, k: int) -> float:
        """Return the left end of a panel."""
        return k % self.columns * self.column_width + self.gap

    def top_of(self, k: int) -> float:
        """Return the upper end of a panel, from the top of the figure."""
        row = k // self.columns
        return self.heading_height + row * self.row_height + self.title_height

    def axes(self, figure: Figure, left: float, top: float, width: float) -> Any:
        """Add axes of the height of a panel to the figure."""
        bottom = top + self.panel_height
        return figure.add_axes(
            (
                left / self.width,
                1 - bottom / self.height,
                width / self.width,
                self.panel_height / self.height,
            )
        )


def write_panels(
    path: str | Path,
    panels: list[Panel],
    heading: str,
    aspect: float,
    *,
    columns: int = 2,
    inches: float = 5.4,
) -> None:
    """Write panels as a PNG, all with the same width over height.

    Args:
        path: The file.
        panels: From left to right, row by row.
        heading: A text above all panels.
        aspect: Width over height of every panel.
        columns: Panels in a row.
        inches: Width of a panel with its bar.

    Raises:
        OutputError: The file cannot be written.
    """
    layout = _Layout(
        aspect=aspect,
        columns=columns,
        rows=-(-len(panels) // columns),
        column_width=inches,
        heading_height=0.4 if heading else 0.0,
    )
    figure = Figure(figsize=(layout.width, layout.height))
    ranges = _bar_ranges(panels)
    for k, panel in enumerate(panels):
        _add_panel(figure, layout, k, panel, ranges[k])
    x = layout.gap / layout.width
    y = 1 - layout.title_height / layout.height
    figure.text(x, y, heading, fontsize=11, parse_math=False)
    with atomic_write(path, "wb") as file:
        figure.savefig(file, format="png")


def _add_panel(
    figure: Figure, layout: _Layout, k: int, panel: Panel, bar_range: BarRange
) -> None:
    """Draw panel number ``k`` with its title and its colour bar."""
    left = layout.left_of(k)
    top = layout.top_of(k)
    axes = layout.axes(figure, left, top, layout.panel_width)
    title = panel.title
    if panel.unit:
        title += f" [{panel.unit}]"
    title_size = min(10, 2 + 1.5 * layout.column_width)
    axes.set_title(title, fontsize=title_size, loc="left", pad=3)
    axes.set(xticks=[], yticks=[])
    if not panel.is_map:
        _draw_image(axes, panel, layout.aspect)
        return
    drawn = _draw_map(axes, panel, layout.aspect, bar_range)
    bar_left = left + layout.panel_width + layout.gap / 2
    bar_axes = layout.axes(figure, bar_left, top, 0.02 * layout.column_width)
    bar = figure.colorbar(drawn, cax=bar_axes)
    if panel.log:
        ticks = np.geomspace(*bar_range, BAR_TICKS).tolist()
        bar.set_ticks(ticks, labels=[f"{tick:.2g}" for tick in ticks], minor=False)
        bar.minorticks_off()
    label_size = min(7, 1.6 * layout.column_width)
    bar_axes.tick_params(labelsize=label_size, length=2, pad=1)


def _draw_image(axes: Any, panel: Panel, aspect: float) -> None:
    """Draw an image."""
    extent = (0.0, aspect, 1.0, 0.0)
    axes.imshow(panel.values, extent=extent, interpolation="nearest")


def _draw_map(axes: Any, panel: Panel, aspect: float, bar_range: BarRange) -> Any:
    """Draw a map and its outline; returns what its colour bar is for."""
    norm_class = LogNorm if panel.log else Normalize
    drawn = axes.imshow(
        panel.values,
        cmap=colormaps[COLOUR_MAP].with_extremes(bad=UNKNOWN_COLOUR),
        norm=norm_class(*bar_range),
        extent=(0.0, aspect, 1.0, 0.0),
        interpolation="nearest",
    )
    outline = panel.outline
    if outline is not None and outline.any() and not outline.all():
        height, width = outline.shape
        x = (np.arange(width) + 0.5) * aspect / width
        y = (np.arange(height) + 0.5) / height
        axes.contour(
            x, y, outline, levels=[0.5], colors=OUTLINE_COLOUR, linewidths=0.8
        )
    return drawn


def _bar_ranges(panels: list[Panel]) -> list[BarRange]:
    """Return the ends of every panel's colour bar; maps of one unit share them."""
    own = [_own_range(panel) for panel in panels]
    shared: dict[str, BarRange] = {}
    for panel, bar_range in zip(panels, own, strict=True):
        if panel.high is None and panel.is_map:
            before = shared.get(panel.unit, bar_range)
            shared[panel.unit] = BarRange(
                min(bar_range.low, before.low), max(bar_range.high, before.high)
            )
    ranges = []
    for panel, bar_range in zip(panels, own, strict=True):
        if panel.high is None:
            bar_range = shared.get(panel.unit, bar_range)
        ranges.append(bar_range)
    return ranges


def _own_range(panel: Panel) -> BarRange:
    """Return the ends of the colour bar that suit a panel alone."""
    if not panel.is_map:
        return BarRange(0.0, panel.high or 1.0)
    high = high_value(panel.values) if panel.high is None else panel.high or 1.0
    low = min(_low_value(panel.values), 0.5 * high) if panel.log else 0.0
    return BarRange(low, high)


def flow_panel(title: str, flow: np.ndarray, longest: float) -> Panel:
    """Make a panel of a flow (H, W, 2), pixels, whose colours are full at ``longest``."""
    colours = flow_colours(flow, longest)
    return Panel(f"{title} (full colour: {longest:.3g} px)", colours)


def _low_value(values: np.ndarray) -> float:
    """Return the 1st percentile of the positive values; almost zero where there are none."""
    positive = values[np.isfinite(values) & (values > 0)]
    return positive_percentile(positive, LOW_PERCENTILE)
