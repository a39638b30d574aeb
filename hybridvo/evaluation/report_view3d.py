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

__all__ = ["AZIMUTH", "ELEVATION", "project", "view_svg"]

AZIMUTH, ELEVATION = -0.6, 0.55
"""Where the viewer stands at first, radians: turned about the vertical, raised over the ground."""
WIDTH, HEIGHT = 374.0, 259.0
MAX_POINTS = 200
_LINES = 6


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


def _polyline(points: np.ndarray, scale: float, attributes: str) -> str:
    scaled = np.atleast_2d(points) * scale
    flat = project(scaled, AZIMUTH, ELEVATION)
    shown = " ".join(f"{u:.1f},{v:.1f}" for u, v in flat)
    kept = " ".join(f"{value:.1f}" for value in scaled.ravel())
    return f'<polyline {attributes} data-p="{kept}" points="{shown}"/>'


def _text(point: np.ndarray, scale: float, text: str) -> str:
    scaled = point[None] * scale
    (u, v), kept = project(scaled, AZIMUTH, ELEVATION)[0], " ".join(f"{x:.1f}" for x in scaled[0])
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
    half = (high - low) / 2
    across = max(float(np.hypot(half[0], half[2])), 1e-9)
    upright = math.cos(ELEVATION) * half[1] + math.sin(ELEVATION) * across
    scale = min(0.48 * WIDTH / across, 0.48 * HEIGHT / upright)

    def grid(a: tuple[float, float], b: tuple[float, float]) -> str:
        ends = np.array([[a[0], ground, a[1]], [b[0], ground, b[1]]]) - centre
        return _polyline(ends, scale, 'class="g"')

    parts = [grid((value, z[0]), (value, z[-1])) for value in x]
    parts += [grid((x[0], value), (x[-1], value)) for value in z]
    for path in paths:
        positions = path.positions
        keep = np.unique(np.linspace(0, len(positions) - 1, MAX_POINTS).round().astype(int))
        which = "truth" if path.series is None else f"m{path.series.m} f{path.series.f}"
        parts.append(_polyline(positions[keep] - centre, scale, f'class="{which}"'))
    start = paths[0].positions[:1] - centre
    parts.append(_polyline(np.repeat(start, 2, axis=0), scale, 'class="start"'))
    parts.append(_text(np.array([x[-1], ground, z[0]]) - centre, scale, "x"))
    parts.append(_text(np.array([x[0], ground, z[-1]]) - centre, scale, "z"))
    note = f'<text class="note" x="{-WIDTH / 2 + 6}" y="{HEIGHT / 2 - 8}">grid {step:g} m</text>'
    box = f"{-WIDTH / 2} {-HEIGHT / 2} {WIDTH} {HEIGHT}"
    label = html.escape(title, quote=True)
    return (
        f'<svg viewBox="{box}" role="img" aria-label="{label}" class="plot view3d" '
        f'data-az="{AZIMUTH}" data-el="{ELEVATION}" tabindex="0">{"".join(parts)}{note}</svg>'
    )
