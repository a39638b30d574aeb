"""A page in the browser: two images and their depth in; the motion and what moves out.

    python examples/web_page.py    # after: pip install gradio

Open the address that it prints. The row of examples is a rendered scene.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np

import hybridvo as hvo
from hybridvo.io.data.image_io import read_depth
from hybridvo.io.masks import mask_of
from hybridvo_lab.synthetic.scenes import make_scene

ORANGE = np.array([230.0, 159.0, 0.0])


def motion_of(prev, curr, prev_depth, curr_depth, focal_px, unit_m):
    """Images (H, W, 3), depth files, focal length, metres a unit -> image, text."""
    if any(given is None for given in (prev, curr, prev_depth, curr_depth)):
        raise hvo.InputError("two images and a depth file for each are needed.")
    height, width = prev.shape[:2]
    middle = (width - 1) / 2, (height - 1) / 2
    camera = hvo.Camera(focal_px, focal_px, *middle, height=height, width=width)
    before = hvo.Frame(prev, read_depth(prev_depth) * np.float32(unit_m), camera)
    after = hvo.Frame(curr, read_depth(curr_depth) * np.float32(unit_m), camera)
    motion = hvo.estimate(before, after)
    moving = ~mask_of(before, motion.weights)
    image = np.where(moving[..., None], 0.4 * prev + 0.6 * ORANGE, prev)
    sigma_mm = 1e3 * np.sqrt(np.diag(motion.covariance)[:3])
    text = f"""{motion.status}, probability {motion.probability:.2f}
moves: {100 * moving.mean():.0f} % of the image
sigma of the translation, mm: {sigma_mm.round(2)}
T_curr_prev, metres:\n{motion.T_curr_prev.round(4)}"""
    return image.astype(np.uint8), text


def rendered(folder: Path) -> list:
    """Two rendered frames, in the order of the page's inputs."""
    scene = make_scene("light", 0, height=218, width=512, frames=2)
    for index in range(2):
        frame = scene.render(index)
        cv2.imwrite(str(folder / f"{index}.png"), frame.rgb[..., ::-1])
        np.save(folder / f"{index}.npy", frame.depth)
    files = [str(folder / name) for name in ("0.png", "1.png", "0.npy", "1.npy")]
    return [*files, round(frame.camera.fx, 2), 1.0]


if __name__ == "__main__":
    import gradio as gr

    inputs = [
        gr.Image(label="first image"),
        gr.Image(label="second image"),
        gr.File(label="depth of the first image, 16-bit PNG or .npy"),
        gr.File(label="depth of the second image"),
        gr.Number(525, label="focal length, px"),
        gr.Number(0.001, label="metres of a unit of depth"),
    ]
    outputs = [gr.Image(label="orange: moves"), gr.Textbox(label="motion", lines=9)]
    page = gr.Interface(
        motion_of,
        inputs,
        outputs,
        examples=[rendered(Path(tempfile.mkdtemp()))],
        title="hybridvo",
        flagging_mode="never",
        analytics_enabled=False,
    )
    page.launch(show_error=True)
