"""The README's moving picture: images, the weights of
their pixels, and the path.

    python tools/make_figure.py --data ../shared/data --out docs/teaser.gif

First a rendered scene in which objects cover more than half of the image, then
TartanAir (CC BY 4.0, TartanAir by CMU's AirLab) with two rendered objects in it. Flow
is OpenCV DIS; depth is the renderer's.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from known_pairs import SIZE, rendered
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from measuring import parser_of
from PIL import Image
from scipy.spatial.transform import Rotation

from hybridvo import Camera, Frame, Odometry, open_sequence
from hybridvo.core.geometry import invert
from hybridvo.flow.providers import dis_flow
from hybridvo_lab.synthetic.raycast import BOX, ELLIPSOID
from hybridvo_lab.synthetic.render import Scene, Solid

BLUE = "#0072B2"
ORANGE = "#D55E00"
GREY = "#222222"
"""Colours of Okabe and Ito, which colour-blind readers can distinguish."""
MOVES = np.array([222, 143, 5])
USED = np.array([255, 0, 0])
"""Colours of what moves by itself, without and with weight, RGB."""
POINT_SOLVER = "pnp-ransac-tuned"
"""Its path is drawn beside ours: the limit on its inliers
follows the noise of the flow."""
FRAMES = 20
"""Frames of the rendered scene."""
TARTANAIR = "tartanair_v2/P000"
SECONDS = (5.6, 4.4)
"""How long the two parts are shown."""
CANVAS = (8.0, 4.2)
"""Size of the picture, inches of 100 px."""
LEFT = (0.01, 0.555)
LOW_HIGH = (0.02, 0.52)
HEIGHT = 0.43
"""Left edge, width, lower edges and height of the images in it."""
PATH_PANEL = (0.63, 0.09, 0.36, 0.86)
"""Left, lower edge, width, height of the panel of the path."""
CENTRE_ROWS = slice(180, 452)
"""Rows of TartanAir's square images that are shown: as wide as the rendered ones."""


class Shot(NamedTuple):
    """A frame, and which of its pixels move by themselves."""

    frame: Frame
    moving: np.ndarray  # (H, W) bool


class Part(NamedTuple):
    """Frames that are tracked, and what is found."""

    title: str
    shots: list[Shot]
    weights: list[np.ndarray]  # (h, w) from 0 to 1, of each frame but the last
    paths: dict[str, np.ndarray]  # (N, 3) metres by method
    truth: np.ndarray  # (N, 3) metres
    rows: slice


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, default=Path("docs/teaser.gif"), metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    parts = [rendered_part(), tartanair_part(args.data / TARTANAIR)]
    pictures = []
    times_ms = []
    for part, seconds in zip(parts, SECONDS, strict=True):
        count = len(part.weights)
        pictures += [draw(part, index) for index in range(count)]
        times_ms += [round(1000 * seconds / count)] * count
    write_gif(pictures, times_ms, args.out)
    print(args.out, args.out.stat().st_size)
    return 0


# --- what is shown ----------------------------------------------------------------


def rendered_part() -> Part:
    """A rendered scene with two large moving objects."""
    sequence = rendered("heavy_two", 0, SIZE, FRAMES)
    ids = [sequence.scene.object_id(i) for i in range(FRAMES)]
    frames = [sequence.frame(i) for i in range(FRAMES)]
    shots = [Shot(frame, each > 0) for frame, each in zip(frames, ids, strict=True)]
    return track("rendered scene", shots, sequence.poses, slice(None))


def tartanair_part(folder: Path) -> Part:
    """TartanAir's images with two rendered objects that move through them."""
    sequence = open_sequence(folder)
    count = len(sequence)
    frames = [sequence.frame(i) for i in range(count)]
    objects = crossing_objects(frames[0].camera, sequence.poses)
    shots = [composed(frame, objects, index) for index, frame in enumerate(frames)]
    title = "TartanAir with rendered objects"
    return track(title, shots, sequence.poses, CENTRE_ROWS)


def crossing_objects(camera: Camera, T_world_cam: np.ndarray) -> Scene:
    """A ball and a block that go along with the camera and cross its view."""
    ball = []
    block = []
    for k, T in enumerate(T_world_cam):
        turn = Rotation.from_euler("zy", [4 * k, 6 * k], degrees=True).as_matrix()
        at = (-1.15 + 0.07 * k, 0.1, 2.6)
        ball.append(placed(T, turn * 0.85, at))
        beside = (1.6 - 0.07 * k, 0.0, 3.0)
        block.append(placed(T, turn * [0.9, 1.0, 0.4], beside))
    green = ((0.15, 0.4, 0.25), (0.75, 0.9, 0.5))
    red = ((0.45, 0.1, 0.15), (0.95, 0.7, 0.5))
    solids = (
        Solid(ELLIPSOID, np.stack(ball), 1, 0.5, green),
        Solid(BOX, np.stack(block), 2, 0.5, red),
    )
    return Scene(camera, T_world_cam, solids)


def placed(T: np.ndarray, axes: np.ndarray, at: tuple[float, ...]) -> np.ndarray:
    """(3, 4) half axes (3, 3) at a place of a camera, in the scene's axes."""
    body = np.column_stack([axes, at])
    turned = T[:3, :3] @ body
    turned[:, 3] += T[:3, 3]
    return turned


def composed(frame: Frame, objects: Scene, index: int) -> Shot:
    """A frame with what stands nearer in a scene."""
    above = objects.render(index)
    moving = above.depth < np.where(frame.depth > 0, frame.depth, np.inf)
    rgb = np.where(moving[..., None], above.rgb, frame.rgb)
    depth = np.where(moving, above.depth, frame.depth).astype(np.float32)
    made = Frame(rgb, depth, frame.camera, frame.timestamp, index)
    return Shot(made, moving)


def track(title: str, shots: list[Shot], poses: np.ndarray, rows: slice) -> Part:
    """Track frames with two methods."""
    flow = dis_flow()
    trackers = {name: Odometry(method=name) for name in ("hybrid", POINT_SOLVER)}
    paths: dict[str, list[np.ndarray]] = {name: [] for name in trackers}
    weights = []
    prev = None
    for shot in shots:
        field = None if prev is None else flow(prev, shot.frame)
        for name, tracker in trackers.items():
            step = tracker.track(shot.frame, field)
            paths[name].append(step.T_world_cam[:3, 3])
            if prev is not None and name == "hybrid":
                weights.append(step.motion.weights)
                print(title, step.index, step.status, flush=True)
        prev = shot.frame
    truth = (invert(poses[0]) @ poses)[:, :3, 3]
    arrays = {name: np.array(path) for name, path in paths.items()}
    return Part(title, shots, weights, arrays, truth, rows)


# --- drawing ----------------------------------------------------------------------


def draw(part: Part, index: int) -> Image.Image:
    """The picture of a frame: image, weights, and the path up to the next frame."""
    figure = Figure(figsize=CANVAS, dpi=100)
    canvas = FigureCanvasAgg(figure)
    low, high = ((LEFT[0], each, LEFT[1], HEIGHT) for each in LOW_HIGH)
    shot = part.shots[index]
    fractions = [float(each.moving[part.rows].mean()) for each in part.shots]
    fraction = f"{100 * np.median(fractions):.0f} %"
    draw_image(
        figure.add_axes(high),
        shot.frame.rgb[part.rows],
        f"{part.title}: {fraction} of it moves by itself",
    )
    height, width = shot.moving.shape
    shown = cv2.resize(
        part.weights[index], (width, height), interpolation=cv2.INTER_NEAREST
    )
    draw_image(
        figure.add_axes(low),
        tinted(shown, shot.moving)[part.rows],
        "white: used for the motion; orange: moves (ground truth); red: both",
    )
    draw_paths(figure.add_axes(PATH_PANEL), part, index + 2)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def tinted(weights: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Weights (H, W) from 0 to 1 as grey values (H, W, 3), what moves in orange."""
    grey = np.repeat(255 * np.clip(weights, 0, 1)[..., None], 3, axis=2)
    weight = np.clip(weights[..., None], 0, 1)
    orange = (1 - weight) * MOVES + weight * USED
    return np.where(moving[..., None], orange, grey).astype(np.uint8)


def draw_image(panel: Any, image: np.ndarray, title: str) -> None:
    """An image (H, W, 3) with its title."""
    panel.imshow(image, interpolation="antialiased")
    panel.set_title(title, fontsize=9, loc="left")
    panel.set_xticks([])
    panel.set_yticks([])


def draw_paths(panel: Any, part: Part, count: int) -> None:
    """The first positions of the paths, from above."""
    lines = (
        (part.truth, "ground truth", GREY, "-", 5.0, 0.3),
        (part.paths[POINT_SOLVER], "PnP-RANSAC, tuned", ORANGE, "--", 1.8, 1.0),
        (part.paths["hybrid"], "hybridvo", BLUE, "-", 1.8, 1.0),
    )
    for path, name, colour, style, width, alpha in lines:
        text = name
        if path is not part.truth:
            away = path[:count] - part.truth[:count]
            off_cm = 100 * np.linalg.norm(away[-1])
            text = f"{name}: {off_cm:.3g} cm off"
        look = {"color": colour, "lw": width, "alpha": alpha, "label": text}
        panel.plot(path[:count, 0], path[:count, 2], style, **look)
        # the whole path sets the limits of the axes
        panel.plot(path[:, 0], path[:, 2], alpha=0)
    panel.plot(*part.truth[count - 1, [0, 2]], "o", color=BLUE, ms=5)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_title("camera path from above, metres", fontsize=9, loc="left")
    panel.tick_params(labelsize=7.5)
    panel.grid(True, color="#e4e4e4", linewidth=0.8)
    panel.legend(fontsize=9, frameon=False, loc="upper left")


def write_gif(pictures: list[Image.Image], times_ms: list[int], out: Path) -> None:
    """Write pictures, each with 256 colours of its own."""
    made = [reduced(picture) for picture in pictures]
    first = made[0]
    rest = made[1:]
    first.save(
        out,
        save_all=True,
        append_images=rest,
        duration=times_ms,
        loop=0,
        optimize=True,
    )


def reduced(picture: Image.Image) -> Image.Image:
    """A picture of 256 colours, among which are those of the lines."""
    width, height = picture.size
    kept = (BLUE, ORANGE, GREY, "#bdbdbd")
    sample = Image.new("RGB", (width, height + 20 * len(kept)))
    sample.paste(picture, (0, 0))
    for number, colour in enumerate(kept):
        top = height + 20 * number
        sample.paste(colour, (0, top, width, top + 20))
    palette = sample.quantize(256)
    return picture.quantize(palette=palette, dither=Image.Dither.NONE)


if __name__ == "__main__":
    sys.exit(main())
