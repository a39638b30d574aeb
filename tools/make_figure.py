"""The README's picture: the inputs of a pair, the weights of
its pixels, and the path.

    python tools/make_figure.py --out docs/teaser.png

A rendered scene in which objects cover more than half of the image; flow is OpenCV
DIS, depth is the renderer's.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from golden_inputs import SIZE, rendered
from matplotlib.figure import Figure
from measuring import parser_of

BLUE = "#0072B2"
ORANGE = "#D55E00"
GREY = "#222222"
"""Colours of Okabe and Ito, which colour-blind readers can distinguish."""
POINT_SOLVER = "pnp-ransac-tuned"
"""Its path is drawn beside ours: the limit on its inliers
follows the noise of the flow."""
SHOWN_FRAME = 9
"""The frame whose inputs and weights are shown."""
FRAMES = 20
"""Frames of the scene."""


class Drawn(NamedTuple):
    """What the picture shows."""

    rgb: np.ndarray  # (H, W, 3)
    flow: np.ndarray  # (H, W, 2) px
    weights: np.ndarray  # (h, w) from 0 to 1
    moving: np.ndarray  # (H, W) bool
    moving_fraction: float  # median over the frames
    paths: dict[str, np.ndarray]  # (N, 3) metres by method
    truth: np.ndarray  # (N, 3) metres


class Line(NamedTuple):
    """A path in the picture."""

    path: np.ndarray
    name: str
    colour: str
    style: str
    width: float


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    default = Path("docs/teaser.png")
    parser.add_argument("--out", type=Path, default=default, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    args.out.write_bytes(draw(track("heavy_two", seed=0)))
    print(args.out)
    return 0


def track(kind: str, seed: int) -> Drawn:
    """Track a scene with two methods."""
    from hybridvo import Odometry
    from hybridvo.flow import dis_flow

    sequence = rendered(kind, seed, SIZE, FRAMES)
    flow = dis_flow()
    trackers = {name: Odometry(method=name) for name in ("hybrid", POINT_SOLVER)}
    paths: dict[str, list[np.ndarray]] = {name: [] for name in trackers}
    prev = None
    shown: dict[str, Any] = {}
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        field = None if prev is None else flow(prev, frame)
        for name, tracker in trackers.items():
            step = tracker.track(frame, field)
            paths[name].append(step.T_world_cam[:3, 3])
            is_shown = prev is not None and prev.index == SHOWN_FRAME
            if is_shown and name == "hybrid":
                weights = step.motion.weights
                shown = {"rgb": prev.rgb, "flow": field.flow, "weights": weights}
        prev = frame

    scene = sequence.scene
    fractions = [
        float((scene.object_id(i) > 0).mean()) for i in range(len(sequence))
    ]
    truth = np.linalg.inv(sequence.poses[0]) @ sequence.poses
    return Drawn(
        **shown,
        moving=scene.object_id(SHOWN_FRAME) > 0,
        moving_fraction=float(np.median(fractions)),
        paths={name: np.array(path) for name, path in paths.items()},
        truth=truth[:, :3, 3],
    )


def draw(drawn: Drawn) -> bytes:
    """PNG of the four panels, from left to right."""
    from hybridvo.visualization.panels import flow_colours, longest_flow

    figure = Figure(figsize=(12.8, 3.25), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1.62, 1.12))
    height, width = drawn.rgb.shape[:2]
    weights = cv2.resize(
        drawn.weights, (width, height), interpolation=cv2.INTER_NEAREST
    )
    colours = flow_colours(drawn.flow, longest_flow(drawn.flow))
    fraction = f"{100 * drawn.moving_fraction:.0f} %"
    draw_image(
        figure.add_subplot(grid[0, 0]),
        drawn.rgb,
        f"image ({fraction} of it moves by itself)",
    )
    draw_image(figure.add_subplot(grid[1, 0]), colours, "optical flow (OpenCV DIS)")
    panel = figure.add_subplot(grid[:, 1])
    draw_image(
        panel,
        weights,
        "weight of each pixel in the camera motion (white: borders of what moves)",
    )
    panel.contour(drawn.moving, levels=[0.5], colors="white", linewidths=0.8)
    draw_paths(figure.add_subplot(grid[:, 2]), drawn)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def draw_image(panel: Any, image: np.ndarray, title: str) -> None:
    """An image (H, W, 3), or a map (H, W) from 0 to 1, with its title."""
    highest = 1 if image.ndim == 2 else None
    panel.imshow(image, cmap="magma", vmin=0, vmax=highest)
    panel.set_title(title, fontsize=9.5, loc="left")
    panel.set_xticks([])
    panel.set_yticks([])


def draw_paths(panel: Any, drawn: Drawn) -> None:
    """Paths from above."""
    lines = (
        Line(drawn.truth, "ground truth", GREY, "-", 4.0),
        Line(drawn.paths[POINT_SOLVER], "PnP-RANSAC, tuned", ORANGE, "--", 1.8),
        Line(drawn.paths["hybrid"], "hybridvo", BLUE, "-", 1.8),
    )
    for line in lines:
        is_truth = line.path is drawn.truth
        away = np.sum((line.path - drawn.truth) ** 2, axis=1)
        rmse = 100 * np.sqrt(np.mean(away))
        label = line.name if is_truth else f"{line.name}: RMSE {rmse:.3g} cm"
        panel.plot(
            line.path[:, 0],
            line.path[:, 2],
            line.style,
            color=line.colour,
            lw=line.width,
            label=label,
            alpha=0.3 if is_truth else 1.0,
        )
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_title("camera path from above, metres", fontsize=9.5, loc="left")
    panel.tick_params(labelsize=8)
    panel.grid(True, color="#e4e4e4", linewidth=0.8)
    low, high = panel.get_ylim()
    panel.plot(0, high + 0.4 * (high - low), alpha=0)  # room for the legend
    panel.legend(fontsize=8.5, frameon=False, loc="upper left")


if __name__ == "__main__":
    sys.exit(main())
