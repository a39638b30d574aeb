"""A 3-D view of camera paths as SVG: drawn without a browser, turned by hand within one.

Every line carries its points (``data-p``), which the page's script projects again when the view is
dragged. The projection is orthographic, from above and behind; y points down in the camera, so up
in the picture is -y.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import numpy as np

from hybridvo.evaluation.report_data import Path3D, shown_box

__all__ = ["ELEVATION", "project", "view_svg"]

ELEVATION = 0.55
"""How far the viewer stands over the ground at first, radians."""
WIDTH, HEIGHT = 374.0, 259.0
MAX_POINTS = 200
_LINES = 9


def project(points: np.ndarray, azimuth: float, elevation: float) -> np.ndarray:
    """(N, 2) picture coordinates, v downwards, of (N, 3) points; the script does the same.

    Args:
        points: (N, 3) metres, x right, y down, z forward, about the middle of the view.
        azimuth: turn about the vertical, radians; at 0 the viewer looks along z.
        elevation: radians above the ground; at pi / 2 the view is from above, z upwards.
    """
    x, y, z = np.asarray(points, dtype=float).T
    side = math.cos(azimuth) * x - math.sin(azimuth) * z
    away = math.sin(azimuth) * x + math.cos(azimuth) * z
    return np.stack([side, math.cos(elevation) * y - math.sin(elevation) * away], axis=1)


def _nice(value: float) -> float:
    """1, 2 or 5 times a power of ten, at least ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(f * power for f in (1, 2, 5, 10) if f * power >= value * (1 - 1e-9))


def _fitting_scale(points: np.ndarray, azimuth: float) -> float:
    """Units of the picture per metre with which points about its middle fill it."""
    reach = np.maximum(np.abs(project(points, azimuth, ELEVATION)).max(axis=0), 1e-9)
    return float(min(0.44 * WIDTH / reach[0], 0.44 * HEIGHT / reach[1]))


def _polyline(points: np.ndarray, azimuth: float, attributes: str) -> str:
    """Line through points that are in units of the picture already."""
    flat = project(points, azimuth, ELEVATION)
    shown = " ".join(f"{u:.1f},{v:.1f}" for u, v in flat)
    kept = " ".join(f"{value:.1f}" for value in points.ravel())
    return f'<polyline {attributes} data-p="{kept}" points="{shown}"/>'


def _text(point: np.ndarray, azimuth: float, text: str) -> str:
    (u, v) = project(point[None], azimuth, ELEVATION)[0]
    kept = " ".join(f"{x:.1f}" for x in point)
    return f'<text data-p="{kept}" x="{u:.1f}" y="{v:.1f}">{html.escape(text)}</text>'


def view_svg(paths: Sequence[Path3D], title: str) -> str:
    """Paths over a grid on their lowest level, within the picture as it stands at first.

    Args:
        paths: at least one; in the first camera, metres.
        title: for readers that do not see.
    """
    low, high = shown_box(paths)
    step = _nice(float((high - low)[[0, 2]].max()) / (_LINES - 1))
    x, z = (step * np.arange(np.floor(low[i] / step), np.ceil(high[i] / step) + 1) for i in (0, 2))
    ground = float(high[1])
    centre = (low + high) / 2
    inside = np.concatenate([np.clip(path.positions, low, high) for path in paths]) - centre
    # seen from where the paths are spread out most
    azimuth, scale = max(
        ((turn, _fitting_scale(inside, turn)) for turn in np.linspace(-math.pi, math.pi, 17)[:-1]),
        key=lambda pair: pair[1],
    )

    def grid(a: tuple[float, float], b: tuple[float, float]) -> str:
        ends = np.array([[a[0], ground, a[1]], [b[0], ground, b[1]]]) - centre
        return _polyline(ends * scale, azimuth, 'class="g"')

    parts = [grid((value, z[0]), (value, z[-1])) for value in x]
    parts += [grid((x[0], value), (x[-1], value)) for value in z]
    for path in paths:
        positions = path.positions
        keep = np.unique(np.linspace(0, len(positions) - 1, MAX_POINTS).round().astype(int))
        which = "truth" if path.series is None else f"m{path.series.m} f{path.series.f}"
        parts.append(_polyline((positions[keep] - centre) * scale, azimuth, f'class="{which}"'))
    start = (paths[0].positions[:1] - centre) * scale
    parts.append(_polyline(np.repeat(start, 2, axis=0), azimuth, 'class="start"'))
    for axis, name in enumerate(("x", "y down", "z")):
        end = start[0] + 30.0 * np.eye(3)[axis]
        parts.append(_polyline(np.stack([start[0], end]), azimuth, 'class="axis"'))
        parts.append(_text(end + 6.0 * np.eye(3)[axis], azimuth, name))
    note = f'<text class="note" x="{-WIDTH / 2 + 6}" y="{HEIGHT / 2 - 8}">grid {step:g} m</text>'
    box = f"{-WIDTH / 2} {-HEIGHT / 2} {WIDTH} {HEIGHT}"
    label = html.escape(title, quote=True)
    return (
        f'<svg viewBox="{box}" role="img" aria-label="{label}" class="plot view3d" '
        f'data-az="{azimuth:.4f}" data-el="{ELEVATION}" tabindex="0">{"".join(parts)}{note}</svg>'
    )
