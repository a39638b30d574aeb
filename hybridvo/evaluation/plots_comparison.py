"""Plots of a comparison as SVG that takes its colours from the page: light, dark and printed.

Every function returns one ``<svg>`` element. Colours are CSS variables (``--ink``, ``--grid``,
``--s0`` ...), and what belongs to a method and a source of flow has the classes ``mN fN``, so that
a page can show and hide them. Text stays text.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from hybridvo.evaluation.report_data import Path3D, Series, shown_box

__all__ = [
    "PALETTE",
    "difference_svg",
    "duration_svg",
    "error_svg",
    "factor_svg",
    "failure_svg",
    "timing_svg",
    "top_view_svg",
]

PALETTE = (
    # Okabe and Ito without yellow for the light page, lightened for the dark one
    *(("#0072b2", "#56a8e0"), ("#d55e00", "#ff8a3c"), ("#009e73", "#2fc79b")),
    *(("#b8528f", "#e08fc0"), ("#8a6d00", "#d9b53b"), ("#3a9bd1", "#8fd0f5")),
    *(("#6b4fbb", "#a992f0"), ("#7a7a7a", "#a8a8a8"), ("#a01c2c", "#f0707f")),
    *(("#4c7a1e", "#94c95c"), ("#006b75", "#3fb8c4"), ("#9c5a2e", "#d69a6b")),
    *(("#30508f", "#86a3e3"), ("#c2410c", "#fb9d6f"), ("#5f6f52", "#a6ba96")),
    *(("#84468a", "#cd92d3"),),
)
"""Colours of the methods: (on light paper, on dark paper)."""
MARKERS = "osD^vPX<>phd*8HH"
_STYLES = ("-", (0, (4, 2)), (0, (1, 1.5)), (0, (6, 1.5, 1, 1.5)))
_INK, _MUTED, _GRID, _BAND = "#0a0c01", "#0a0c02", "#0a0c03", "#0a0c04"
_NAMES = {_INK: "ink", _MUTED: "muted", _GRID: "grid", _BAND: "band"}
_WIDTH = 5.4
_ASPECT = 1.55
MAX_POINTS = 300
"""Points of a line: more cannot be told apart at the size of the plots."""
FLOOR_PX = 1e-5
"""Errors of less are drawn there: rounding must not stretch a logarithmic axis."""


def _colour(series: Series) -> str:
    """Stands for the CSS variable of the method until the SVG is written."""
    return f"#0a0b{series.m % len(PALETTE):02x}"


def _style(series: Series) -> dict[str, Any]:
    return {"color": _colour(series), "linestyle": _STYLES[series.f % len(_STYLES)]}


def _gid(series: Series) -> str:
    return f"series-{series.m}-{series.f}"


def _figure(
    height: float = 3.3, rows: int = 1, *, left: float = 0.75, bottom: float = 0.48, **grid: Any
) -> tuple[Figure, list[Any]]:
    """Figure of a height with margins in inches; plots below each other."""
    # fixed margins: the layout engine draws everything twice to find them
    figure = Figure(figsize=(_WIDTH, height), dpi=72)
    FigureCanvasAgg(figure)
    figure.patch.set_visible(False)
    axes = np.atleast_1d(figure.subplots(rows, 1, **grid))
    figure.subplots_adjust(
        left / _WIDTH, bottom / height, 1 - 0.12 / _WIDTH, 1 - 0.1 / height, hspace=0.06
    )
    for one in axes:
        one.patch.set_visible(False)
        one.tick_params(labelsize=8.5, colors=_INK, which="both")
        one.grid(True, color=_GRID, linewidth=0.7)
        one.set_axisbelow(True)
        for side, spine in one.spines.items():
            spine.set_color(_MUTED)
            spine.set_visible(side in ("left", "bottom"))
    return figure, list(axes)


def _logarithmic(axes: Any, which: str) -> None:
    """Make the ``x`` or ``y`` axis logarithmic, its powers written out."""
    getattr(axes, f"set_{which}scale")("log")
    axis = getattr(axes, f"{which}axis")
    axis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
    axis.set_minor_formatter(NullFormatter())


def _widen(axes: Any) -> None:
    """Room about one single value on a logarithmic axis, of which rounding may leave none.

    After all points are drawn: it fixes the limits of that axis.
    """
    for which in ("x", "y"):
        low, high = getattr(axes.dataLim, f"interval{which}")
        if getattr(axes, f"get_{which}scale")() == "log" and 0 < low <= high < 1.001 * low:
            getattr(axes, f"set_{which}lim")(low / 2, high * 2)


def _mark(axes: Any, which: str, at: float) -> None:
    """A line across at a value of the ``x`` or ``y`` axis; after all points are drawn."""
    _widen(axes)  # the line asks where the axes end
    line = axes.axvline if which == "x" else axes.axhline
    line(at, color=_MUTED, linewidth=0.9, linestyle=":")


def _power(value: float) -> str:
    """Power of ten as short as it can be read."""
    return (
        f"{value:g}"
        if 1e-3 <= abs(value) < 1e4
        else re.sub(r"e([+-])0*", r"e\1", f"{value:.0e}").replace("e+", "e")
    )


def _label(axes: Any, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize=9, color=_INK)
    axes.set_ylabel(y, fontsize=9, color=_INK)


def _svg(figure: Figure, title: str, name: str) -> str:
    """The figure as one element whose ids begin with ``name``."""
    for axes in figure.axes:
        _widen(axes)
    stream = io.StringIO()
    # text as text: small, searchable, in the font of the page; equal input gives equal bytes
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "hybridvo"}):
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(stream, format="svg", metadata=nothing)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'id="series-(\d+)-(\d+)[^"]*"', r'class="m\1 f\2"', text)
    text = re.sub(r"#0a0b([0-9a-f]{2})", lambda m: f"var(--s{int(m[1], 16)})", text)
    for sentinel, variable in _NAMES.items():
        text = text.replace(sentinel, f"var(--{variable})")
    text = re.sub(r"font: ([\d.]+)px [^;\"]+", r"font-size: \1px", text)
    text = re.sub(r"font-family: [^;\"]+;?", "", text)
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    text = re.sub(r' id="([^"]+)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", text)
    text = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", text)
    text = text.replace("xlink:href", "href")
    # line breaks and far digits of coordinates are a third of the file; text keeps its digits
    text = re.sub(r"\s*\n\s*", " ", text).replace("> <", "><")
    text = re.sub(r"<[^>]*>", lambda m: re.sub(r"(\d\.\d\d)\d+", r"\1", m[0]), text)
    size = re.search(r'viewBox="([^"]+)"', text)
    box = size[1] if size else "0 0 1 1"
    body = text[text.index(">") + 1 :]
    label = html.escape(title, quote=True)
    return f'<svg viewBox="{box}" role="img" aria-label="{label}" class="plot">{body}'


def _thin(*columns: np.ndarray) -> list[np.ndarray]:
    count = len(columns[0])
    if count <= MAX_POINTS:
        return list(columns)
    keep = np.unique(np.linspace(0, count - 1, MAX_POINTS).round().astype(int))
    return [column[keep] for column in columns]


def top_view_svg(paths: Sequence[Path3D], title: str, name: str) -> str:
    """Paths from above: x to the right, z upwards, in metres, equal scales."""
    figure, (axes,) = _figure(3.6)
    _label(axes, "x, right [m]", "z, forward [m]")
    for path in paths:
        x, z = _thin(path.positions[:, 0], path.positions[:, 2])
        if path.series is None:
            axes.plot(x, z, color=_INK, alpha=0.35, linewidth=4, solid_capstyle="round")
        else:
            axes.plot(x, z, linewidth=1.4, gid=_gid(path.series), **_style(path.series))
    start = paths[0].positions[0]
    axes.plot(start[0], start[2], "o", color=_INK, markersize=5, zorder=5)
    low, high = shown_box(paths)
    middle, size = (low + high) / 2, high - low
    # the shape of the picture, so that equal scales leave no empty border
    half = max(size[0] / _ASPECT, size[2]) / 2
    axes.set_xlim(middle[0] - _ASPECT * half, middle[0] + _ASPECT * half)
    axes.set_ylim(middle[2] - half, middle[2] + half)
    axes.set_aspect("equal", adjustable="box")
    return _svg(figure, title, name)


def error_svg(
    lines: Sequence[tuple[Series, np.ndarray, np.ndarray]],
    labels: tuple[str, str],
    title: str,
    name: str,
    *,
    limit: float | None = None,
) -> str:
    """Errors over time or index, logarithmic; gaps where a value is not known.

    Args:
        lines: series, x, y of each line.
        labels: of the axes.
        title: for readers that do not see.
        name: prefix of ids.
        limit: a horizontal mark, or None.
    """
    figure, (axes,) = _figure(3.3)
    _label(axes, *labels)
    _logarithmic(axes, "y")
    for series, x, y in lines:
        x, y = _thin(x, np.maximum(y, FLOOR_PX))
        marker = {"marker": MARKERS[series.m % len(MARKERS)], "markersize": 3}
        single = marker if len(x) < 30 else {}
        axes.plot(x, y, linewidth=1.1, gid=_gid(series), **single, **_style(series))
    if limit is not None:
        _mark(axes, "y", limit)
    axes.margins(x=0.02)
    if labels[0] == "frame":
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return _svg(figure, title, name)


def _bin_name(low: float | None, high: float | None, share: bool) -> str:
    factor = 100.0 if share else 1.0
    unit = "%" if share else ""
    if high is None:
        return f"≥ {_short(low, factor)}{unit}"
    return f"{_short(low, factor)}–{_short(high, factor)}{unit}"


def _short(value: float | None, factor: float) -> str:
    return f"{(value or 0.0) * factor:.4g}"


def _points(axes: Any, series: Series, x: Any, y: Any, low: Any, high: Any, **more: Any) -> None:
    """Points with intervals; ``more`` may say xerr instead of yerr by ``across=True``."""
    across = more.pop("across", False)
    error = np.array(
        [np.subtract(y if not across else x, low), np.subtract(high, y if not across else x)]
    )
    error = np.maximum(error, 0.0)
    drawn = axes.errorbar(
        x, y, **({"xerr": error} if across else {"yerr": error}),
        color=_colour(series), marker=MARKERS[series.m % len(MARKERS)], markersize=5,
        linestyle="none", elinewidth=1.1,
        markerfacecolor=_colour(series) if series.f == 0 else "none", **more,
    )  # fmt: skip
    for artist in drawn.get_children():
        artist.set_gid(_gid(series))


def factor_svg(
    factor: Mapping[str, Any],
    cells: Sequence[Mapping[str, Any]],
    series: Mapping[tuple[str, str], Series],
    title: str,
    name: str,
) -> str:
    """Median error with quartiles, and failure rate with its interval, over the bins of a factor.

    Args:
        factor: entry of ``breakdown.factors``.
        cells: its cells.
        series: by method and flow.
        title: for readers that do not see.
        name: prefix of ids.
    """
    figure, (upper, lower) = _figure(4.6, 2, bottom=0.66, sharex=True, height_ratios=(3, 2))
    bins = sorted({int(cell["bin"]) for cell in cells})
    share = factor["name"] == "dynamic_fraction"
    bounds = {int(c["bin"]): (c["low"], c["high"], c["pairs"]) for c in cells}
    groups = list(dict.fromkeys((c["method"], c["flow_source"]) for c in cells))
    step = 0.8 / max(len(groups), 1)
    _logarithmic(upper, "y")
    for k, group in enumerate(groups):
        if group not in series:
            continue
        mine = {int(c["bin"]): c for c in cells if (c["method"], c["flow_source"]) == group}
        offset = (k - (len(groups) - 1) / 2) * step
        for axes, names, floor in (
            (upper, ("epe_l2_px_median", "epe_l2_px_q25", "epe_l2_px_q75"), FLOOR_PX),
            (lower, ("failure_rate", "failure_rate_low", "failure_rate_high"), 0.0),
        ):
            known = [b for b in bins if b in mine and mine[b][names[0]] is not None]
            if known:
                values = np.array([[mine[b][n] for n in names] for b in known], float)
                x = np.array([bins.index(b) for b in known]) + offset
                _points(axes, series[group], x, *np.maximum(values, floor).T, clip_on=False)
    for k in range(0, len(bins), 2):
        for axes in (upper, lower):
            axes.axvspan(k - 0.5, k + 0.5, color=_BAND, zorder=0, linewidth=0)
    for axes in (upper, lower):
        axes.grid(visible=False, axis="x")
        axes.set_xlim(-0.5, len(bins) - 0.5)
    _mark(upper, "y", 1.0)
    lower.set_ylim(-0.03, 1.03)
    lower.set_yticks([0, 0.5, 1], ["0 %", "50 %", "100 %"])
    ticks = [f"{_bin_name(*bounds[b][:2], share)}\n({bounds[b][2]})" for b in bins]
    lower.set_xticks(range(len(bins)), ticks, fontsize=8)
    unit = f" [{factor['unit']}]" if factor["unit"] else ""
    _label(upper, "", "EPE [px]")
    _label(lower, f"{factor['label']}{unit}, (pairs)", "failures")
    return _svg(figure, title, name)


def _named_figure(groups: Sequence[Series]) -> tuple[Figure, Any]:
    """Figure with a line for each series, its name on the left."""
    flows = len({one.f for one in groups})
    names = [one.label if flows > 1 else one.method for one in groups]
    longest = max((len(name) for name in names), default=0)
    figure, (axes,) = _figure(0.75 + 0.24 * max(len(names), 1), left=0.2 + 0.072 * longest)
    axes.set_yticks(range(len(names)), names, fontsize=8.5)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    return figure, axes


def failure_svg(
    rates: Sequence[Mapping[str, Any]],
    series: Mapping[tuple[str, str], Series],
    title: str,
    name: str,
) -> str:
    """Failure rate of each series with its Wilson interval; ``rates`` as in the breakdown."""
    known = [r for r in rates if r["failure_rate"] is not None and _key(r) in series]
    known.sort(key=lambda rate: (series[_key(rate)].m, series[_key(rate)].f))
    groups = [series[_key(r)] for r in known]
    figure, axes = _named_figure(groups)
    for k, rate in enumerate(known):
        ends = [100 * rate[f"failure_rate{end}"] for end in ("", "_low", "_high")]
        _points(axes, groups[k], [ends[0]], [k], [ends[1]], [ends[2]], across=True, clip_on=False)
    axes.set_xlim(-2, 102)
    _label(axes, "failure rate [%], 95 % interval", "")
    return _svg(figure, title, name)


def _key(row: Mapping[str, Any]) -> tuple[str, str]:
    return str(row["method"]), str(row["flow_source"])


def difference_svg(
    differences: Sequence[Mapping[str, Any]],
    reference: str,
    series: Mapping[tuple[str, str], Series],
    title: str,
    name: str,
) -> str:
    """Error of every other method over that of ``reference`` on the same pairs, with intervals.

    Args:
        differences: of the breakdown, between ``reference`` and others, either way round.
        reference: name of a method.
        series: by method and flow.
        title: for readers that do not see.
        name: prefix of ids.
    """
    rows = []
    for row in differences:
        ends = [row[f"epe_ratio{end}"] for end in ("", "_low", "_high")]
        if ends[0] is None or reference not in (row["method"], row["other"]):
            continue
        if row["method"] == reference:  # turned round: other over reference
            other, ends = (
                row["other"],
                [1 / ends[0], *(1 / e if e else None for e in (ends[2], ends[1]))],
            )
        else:
            other = row["method"]
        key = (str(other), str(row["flow_source"]))
        if key in series:
            rows.append((series[key], *(ends[0] if end is None else end for end in ends)))
    rows.sort(key=lambda row: (row[0].m, row[0].f))
    figure, axes = _named_figure([row[0] for row in rows])
    _logarithmic(axes, "x")
    for k, (one, middle, low, high) in enumerate(rows):
        _points(axes, one, [middle], [k], [low], [high], across=True)
    _mark(axes, "x", 1.0)
    _label(axes, f"EPE over that of {reference}, geometric mean", "")
    return _svg(figure, title, name)


def timing_svg(lines: Sequence[Mapping[str, Any]], title: str, name: str) -> str:
    """Error over time per pair: medians with quartiles, both logarithmic; ``lines``: headline."""
    known = [r for r in lines if r["ms_median"] is not None and r["epe_l2_px_median"] is not None]
    figure, (axes,) = _figure(3.4)
    _logarithmic(axes, "x")
    _logarithmic(axes, "y")
    for row in known:
        y, low, high = (
            [max(row[f"epe_l2_px_{end}"], FLOOR_PX)] for end in ("median", "q25", "q75")
        )
        _points(axes, row["series"], [row["ms_median"]], y, low, high)
        ends = [row["ms_q25"]], [row["ms_q75"]]
        _points(axes, row["series"], [row["ms_median"]], y, *ends, across=True)
    _mark(axes, "y", 1.0)
    _label(axes, "time per pair [ms]", "EPE [px]")
    return _svg(figure, title, name)


def duration_svg(lines: Sequence[Mapping[str, Any]], title: str, name: str) -> str:
    """Time per pair of each series, medians with quartiles, logarithmic; ``lines``: headline."""
    known = [row for row in lines if row["ms_median"] is not None]
    figure, axes = _named_figure([row["series"] for row in known])
    _logarithmic(axes, "x")
    for k, row in enumerate(known):
        ends = [row["ms_median"]], [k], [row["ms_q25"]], [row["ms_q75"]]
        _points(axes, row["series"], *ends, across=True)
    _label(axes, "time per pair [ms]", "")
    return _svg(figure, title, name)
