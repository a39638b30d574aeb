"""Images and maps with colour bars, side by side in a PNG; flow in colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from mpl_toolkits.axes_grid1 import ImageGrid

from hybridvo.core.files import atomic_write
from hybridvo.flow.colours import flow_colours, high_value, positive_percentile

COLOUR_MAP = "magma"
UNKNOWN_COLOUR = "#9a9a9a"
OUTLINE_COLOUR = "#4fd1ff"
LOW_PERCENTILE = 1
BAR_TICKS = 4
"""Ticks of a logarithmic colour bar."""
TITLE_INCHES = 0.34
"""Height of the title of a panel, with the gap above it."""
MARGIN_INCHES = 0.08
"""Below the last row."""
PANEL_SHARE = 0.87
"""Share of the width of a column that a panel takes; its colour bar takes the rest."""
UNIT = (0.0, 1.0, 1.0, 0.0)
"""Left, right, lower and upper end of every panel in its own axes."""


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
    rows = -(-len(panels) // columns)
    heading_height = 0.4 if heading else 0.0
    row_height = TITLE_INCHES + PANEL_SHARE * inches / aspect
    height = rows * row_height + heading_height + MARGIN_INCHES
    figure = Figure(figsize=(columns * inches, height))
    grid = ImageGrid(
        figure,
        # left, bottom, width and height of all
        (
            0.02 / columns,
            MARGIN_INCHES / height,
            1 - 0.1 / columns,
            1 - (heading_height + TITLE_INCHES) / height,
        ),
        (rows, columns),
        axes_pad=((1 - PANEL_SHARE - 0.03) * inches, TITLE_INCHES),
        aspect=False,
        cbar_mode="each",
        cbar_size=0.02 * inches,
        cbar_pad=0.01 * inches,
    )
    for axes in (*grid, *grid.cbar_axes):
        axes.set_visible(False)
    cells = zip(panels, _bar_ranges(panels), grid, grid.cbar_axes, strict=False)
    for panel, bar_range, axes, bar_axes in cells:
        _draw_panel(axes, bar_axes, panel, bar_range, inches)
    y = 1 - TITLE_INCHES / height
    figure.text(0.02 / columns, y, heading, fontsize=11, parse_math=False)
    with atomic_write(path, "wb") as file:
        figure.savefig(file, format="png")


def _draw_panel(
    axes: Any, bar_axes: Any, panel: Panel, bar_range: BarRange, inches: float
) -> None:
    """Draw a panel with its title and its colour bar."""
    axes.set_visible(True)
    unit = f" [{panel.unit}]" if panel.unit else ""
    title_size = min(10, 2 + 1.5 * inches)
    axes.set_title(f"{panel.title}{unit}", fontsize=title_size, loc="left", pad=3)
    axes.set(xticks=[], yticks=[])
    if not panel.is_map:
        axes.imshow(
            panel.values, extent=UNIT, aspect="auto", interpolation="nearest"
        )
        return
    drawn = _draw_map(axes, panel, bar_range)
    bar_axes.set_visible(True)
    bar = axes.figure.colorbar(drawn, cax=bar_axes)
    if panel.log:
        ticks = np.geomspace(*bar_range, BAR_TICKS).tolist()
        bar.set_ticks(ticks, labels=[f"{tick:.2g}" for tick in ticks], minor=False)
        bar.minorticks_off()
    bar_axes.tick_params(labelsize=min(7, 1.6 * inches), length=2, pad=1)


def _draw_map(axes: Any, panel: Panel, bar_range: BarRange) -> Any:
    """Draw a map and its outline; returns what its colour bar is for."""
    norm_class = LogNorm if panel.log else Normalize
    drawn = axes.imshow(
        panel.values,
        cmap=colormaps[COLOUR_MAP].with_extremes(bad=UNKNOWN_COLOUR),
        norm=norm_class(*bar_range),
        extent=UNIT,
        aspect="auto",
        interpolation="nearest",
    )
    outline = panel.outline
    if outline is not None and outline.any() and not outline.all():
        height, width = outline.shape
        x = (np.arange(width) + 0.5) / width
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
