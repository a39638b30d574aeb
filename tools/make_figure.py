"""The README's picture: what goes in, what the motion rests on, and the path that comes out.

    python tools/make_figure.py --out docs/teaser.png

A rendered scene in which objects cover more than half of the image; flow is OpenCV DIS, depth is
the renderer's.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from golden_inputs import SIZE, rendered
from measuring import parser_of

BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#222222"
"""Okabe and Ito: told apart by colour-blind readers."""
POINT_SOLVER = "pnp-ransac-tuned"
"""Whose path is drawn beside ours: the limit on its inliers follows the noise of the flow."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("docs/teaser.png"), metavar="FILE"
    )
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    args.out.write_bytes(draw(track("heavy_two", seed=0, shown=9)))
    print(args.out)
    return 0


def track(kind: str, seed: int, shown: int) -> dict[str, Any]:
    """Two methods over a scene, and the inputs and weights of one pair."""
    from hybridvo import Odometry
    from hybridvo.flow import dis_flow

    sequence = rendered(kind, seed, SIZE, 20)
    flow = dis_flow()
    trackers = {name: Odometry(method=name) for name in ("hybrid", POINT_SOLVER)}
    paths: dict[str, list[np.ndarray]] = {name: [] for name in trackers}
    prev = None
    result = {}
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        field = None if prev is None else flow(prev, frame)
        for name, tracker in trackers.items():
            step = tracker.track(frame, field)
            paths[name].append(step.T_world_cam[:3, 3])
            if prev is not None and prev.index == shown and name == "hybrid":
                result = {
                    "rgb": prev.rgb,
                    "flow": field.flow,
                    "weights": step.motion.weights,
                }
        prev = frame
    moving = [
        float((sequence.scene.object_id(i) > 0).mean())
        for i in range(len(sequence))
    ]
    return result | {
        "mover": sequence.scene.object_id(shown) > 0,
        "paths": {name: np.array(path) for name, path in paths.items()},
        "truth": (np.linalg.inv(sequence.poses[0]) @ sequence.poses)[:, :3, 3],
        "share": float(np.median(moving)),
    }


def draw(drawn: dict[str, Any]) -> bytes:
    """PNG of the four panels, from left to right."""
    import io

    import cv2
    from matplotlib.figure import Figure

    from hybridvo.visualization.panels import flow_colours, longest_flow

    figure = Figure(figsize=(12.8, 3.25), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1.62, 1.12))
    places = [grid[0, 0], grid[1, 0], grid[:, 1]]
    height, width = drawn["rgb"].shape[:2]
    weights = cv2.resize(
        drawn["weights"], (width, height), interpolation=cv2.INTER_NEAREST
    )
    panels = {
        f"image ({100 * drawn['share']:.0f} % of it moves by itself)": drawn["rgb"],
        "optical flow (OpenCV DIS)": flow_colours(
            drawn["flow"], longest_flow(drawn["flow"])
        ),
        "weight of each pixel in the camera motion (white: borders of what moves)": weights,
    }
    for place, (title, image) in zip(places, panels.items(), strict=True):
        panel = figure.add_subplot(place)
        panel.imshow(
            image, cmap="magma", vmin=0, vmax=1 if image.ndim == 2 else None
        )
        panel.set_title(title, fontsize=9.5, loc="left")
        panel.set_xticks([])
        panel.set_yticks([])
    panel.contour(drawn["mover"], levels=[0.5], colors="white", linewidths=0.8)
    draw_paths(figure.add_subplot(grid[:, 2]), drawn)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def draw_paths(panel: Any, drawn: dict[str, Any]) -> None:
    """Paths seen from above."""
    for path, colour, style, width, name in (
        (drawn["truth"], GREY, "-", 4.0, "ground truth"),
        (drawn["paths"][POINT_SOLVER], ORANGE, "--", 1.8, "PnP-RANSAC, tuned"),
        (drawn["paths"]["hybrid"], BLUE, "-", 1.8, "hybridvo"),
    ):
        rmse = 100 * np.sqrt(np.mean(np.sum((path - drawn["truth"]) ** 2, axis=1)))
        given = name == "ground truth"
        label = name if given else f"{name}: RMSE {rmse:.3g} cm"
        panel.plot(path[:, 0], path[:, 2], style, color=colour, lw=width, label=label,
                   alpha=0.3 if given else 1.0)  # fmt: skip
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_title("camera path from above, metres", fontsize=9.5, loc="left")
    panel.tick_params(labelsize=8)
    panel.grid(True, color="#e4e4e4", linewidth=0.8)
    low, high = panel.get_ylim()
    panel.plot(0, high + 0.4 * (high - low), alpha=0)  # room for the legend
    panel.legend(fontsize=8.5, frameon=False, loc="upper left")


if __name__ == "__main__":
    sys.exit(main())
