"""The README's picture: what goes in, what the refinement trusts, and the path that comes out.

    python tools/make_readme_figure.py --out docs/teaser.png --overwrite

A rendered scene in which objects cover more than half of the picture; flow is OpenCV DIS on the
rendered images, depth is the renderer's.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#222222"
"""Okabe and Ito: told apart by colour-blind readers."""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make_readme_figure.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=Path("docs/teaser.png"))
    parser.add_argument("--kind", default="heavy_two", help="family of the scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pair", type=int, default=9, help="pair that is shown")
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.errors import HybridVOError

    if args.out.exists() and not args.overwrite:
        print(f"make_readme_figure.py: {args.out} exists; pass --overwrite.", file=sys.stderr)
        return 2
    try:
        drawn = track(args.kind, args.seed, args.pair)
    except HybridVOError as error:
        print(f"make_readme_figure.py: {error}", file=sys.stderr)
        return 2
    try:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_bytes(draw(drawn))
    except OSError as error:
        print(f"make_readme_figure.py: {args.out}: {error}", file=sys.stderr)
        return 5
    print(args.out)
    return 0


def track(kind: str, seed: int, shown: int) -> dict[str, Any]:
    """Both methods over the scene, and the inputs and weights of one pair."""
    from hybridvo.errors import InputError
    from hybridvo.flow import dis_flow
    from hybridvo.geometry import invert
    from hybridvo.odometry import Odometry
    from hybridvo.synthetic.render import SyntheticSequence, make_scene

    scene = make_scene(kind, seed, height=218, width=512)
    sequence = SyntheticSequence(scene)
    if not 0 <= shown < len(sequence) - 1:
        raise InputError(f"--pair: expected 0 to {len(sequence) - 2}, got {shown}.")
    flow = dis_flow()
    trackers = {name: Odometry(method=name) for name in ("refine", "pnp-ransac")}
    paths: dict[str, list[np.ndarray]] = {name: [] for name in trackers}
    prev, result = None, {}
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        field = None if prev is None else flow(prev, frame)
        for name, tracker in trackers.items():
            step = tracker.track(frame, field)
            paths[name].append(step.T_world_cam[:3, 3])
            if prev is not None and prev.index == shown and name == "refine":
                result = {"rgb": prev.rgb, "flow": field.flow, "motion": step.motion}
        prev = frame
    truth = (invert(sequence.poses[0]) @ sequence.poses)[:, :3, 3]
    moving = [float((scene.object_id(i) > 0).mean()) for i in range(len(sequence))]
    return result | {
        "mover": scene.object_id(shown) > 0,
        "paths": {name: np.array(path) for name, path in paths.items()},
        "truth": truth,
        "share": float(np.median(moving)),
    }


def flow_colours(flow: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: hue is the direction, saturation the length up to its 99th percentile."""
    import cv2

    length = np.linalg.norm(flow, axis=2)
    hue = (np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360).astype(np.float32)
    saturation = np.clip(length / max(np.percentile(length, 99), 1e-6), 0, 1).astype(np.float32)
    hsv = np.dstack([hue, saturation, np.ones_like(saturation)])
    return (255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)).astype(np.uint8)


def draw(drawn: dict[str, Any]) -> bytes:
    """PNG of the four panels, from left to right."""
    import io

    import cv2
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.8, 3.25), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1.62, 1.12))
    places = [grid[0, 0], grid[1, 0], grid[:, 1], grid[:, 2]]
    axes = [figure.add_subplot(place) for place in places]
    height, width = drawn["rgb"].shape[:2]
    motion = drawn["motion"]
    weights = cv2.resize(motion.weights, (width, height), interpolation=cv2.INTER_NEAREST)
    titles = (
        f"image ({100 * drawn['share']:.0f} % of it moves by itself)",
        "optical flow (OpenCV DIS)",
        "weight of each pixel in the camera motion (white outline: what truly moves)",
    )
    pictures = (drawn["rgb"], flow_colours(drawn["flow"]), None)
    for panel, picture, title in zip(axes, pictures, titles, strict=False):
        if picture is None:
            panel.imshow(weights, cmap="magma", vmin=0, vmax=1)
            panel.contour(drawn["mover"], levels=[0.5], colors="white", linewidths=0.8)
        else:
            panel.imshow(picture)
        panel.set_title(title, fontsize=9.5, loc="left")
        panel.set_xticks([])
        panel.set_yticks([])
    _paths(axes[3], drawn)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _paths(panel: Any, drawn: dict[str, Any]) -> None:
    """Path seen from above."""
    lines = (
        (drawn["truth"], GREY, "-", 4.0, "truth"),
        (drawn["paths"]["pnp-ransac"], ORANGE, "--", 1.8, "OpenCV PnP-RANSAC"),
        (drawn["paths"]["refine"], BLUE, "-", 1.8, "hybridvo"),
    )
    for path, colour, style, thick, name in lines:
        error = 100 * np.sqrt(np.mean(np.sum((path - drawn["truth"]) ** 2, axis=1)))
        shown = f"{error:.0f}" if error >= 10 else f"{error:.1f}"
        label = name if name == "truth" else f"{name}: RMSE {shown} cm"
        alpha = 0.3 if name == "truth" else 1.0
        panel.plot(path[:, 0], path[:, 2], style, color=colour, lw=thick, alpha=alpha, label=label)
    panel.plot(0, 0, "o", color=GREY, ms=5)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_title("camera path from above, metres", fontsize=9.5, loc="left")
    panel.tick_params(labelsize=8)
    panel.grid(True, color="#e4e4e4", linewidth=0.8)
    low, high = panel.get_ylim()
    panel.plot(0, high + 0.4 * (high - low), alpha=0)  # room for the legend
    panel.legend(fontsize=8.5, frameon=False, loc="upper left")
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)


if __name__ == "__main__":
    sys.exit(main())
