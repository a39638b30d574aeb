"""Pairs of real views that are blurred by a turn: a virtual camera turns while it exposes.

The camera of a recording is followed by a virtual one of the same centre, which turns beside it at
a rate that changes between the two frames. So their blur differs, as it does in the hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.geometry import make_transform
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import FlowProvider, with_flow
from hybridvo_lab.synthetic.draws import log_uniform, random_direction
from hybridvo_lab.synthetic.paper_samples import KnownPair
from hybridvo_lab.synthetic.turned_windows import looking_at, view_of_turned

TURN_DEG = (0.3, 4.0)
"""Angle by which the virtual camera turns from frame to frame, degrees."""
EXPOSURES = 9
"""Images whose mean is a blurred one."""
GREY_NOISE = 1.0
"""Standard deviation of the noise of its pixels, grey levels."""
ZOOM = (0.8, 1.0)
"""Focal length of the virtual camera, as a fraction of the recording's."""
WINDOW = 0.6
"""Height and width of its images, as a fraction of the recording's."""
MIDDLE = (0.4, 0.6)
"""Where it looks, as a fraction of the recording's height and width."""


class Recorded(NamedTuple):
    """Two frames of a recording, and how its camera moved between them."""

    prev: Frame
    curr: Frame
    T_curr_prev: np.ndarray  # (4, 4)
    # (H, W) uint8, 1 where something stands that may move; of both frames
    foreground: tuple[np.ndarray, np.ndarray]


def draw_blurred_turn(
    rng: np.random.Generator, recorded: Recorded, flow: FlowProvider
) -> KnownPair:
    """Draw how a virtual camera turns and how long it exposes.

    Args:
        rng: source of the draws.
        recorded: two frames with images and depth.
        flow: computes the flow of the pair.

    Returns:
        A pair whose foreground counts as moving.
    """
    camera = recorded.prev.camera
    window = _window_of(camera, rng.uniform(*ZOOM))
    size = np.array([camera.width, camera.height])
    R_prev = looking_at(rng.uniform(*MIDDLE, 2) * size, camera)
    angle = np.radians(log_uniform(rng, TURN_DEG))
    before = angle * random_direction(rng)
    after = before + rng.uniform(0, 1) * angle * random_direction(rng)
    R_curr = R_prev @ _turned((before + after) / 2)
    exposure = rng.uniform(0, 1)
    views = []
    frames = (recorded.prev, recorded.curr)
    turns = ((R_prev, exposure * before), (R_curr, exposure * after))
    for frame, foreground, (R, blur) in zip(
        frames, recorded.foreground, turns, strict=True
    ):
        sharp = view_of_turned(frame, foreground, R, window)
        rgb = _exposed(rng, frame, foreground, R, blur, window)
        views.append(sharp._replace(frame=Frame(rgb, sharp.frame.depth, window)))
    prev, curr = views
    to_window = make_transform(R_curr.T, np.zeros(3))
    from_window = make_transform(R_prev, np.zeros(3))
    T = to_window @ recorded.T_curr_prev @ from_window
    pair = with_flow(FramePair(prev.frame, curr.frame, None), flow)
    assert prev.frame.depth is not None
    depth = np.where(prev.foreground, 0, prev.frame.depth).astype(np.float32)
    return KnownPair(pair, T, depth, prev.foreground)


def _window_of(camera: Camera, zoom: float) -> Camera:
    """The virtual camera, with pixels a little larger than those of the recording."""
    height = round(WINDOW * camera.height)
    width = round(WINDOW * camera.width)
    fx = zoom * camera.fx
    fy = zoom * camera.fy
    return Camera(
        fx, fy, (width - 1) / 2, (height - 1) / 2, height=height, width=width
    )


def _turned(rotation: np.ndarray) -> np.ndarray:
    """(3, 3) rotation by a vector (3,), radians."""
    return np.asarray(Rotation.from_rotvec(rotation).as_matrix())


def _exposed(
    rng: np.random.Generator,
    frame: Frame,
    foreground: np.ndarray,
    R: np.ndarray,
    blur: np.ndarray,
    window: Camera,
) -> np.ndarray:
    """(h, w, 3) uint8, the mean image while the camera turns by ``blur`` (3,), radians."""
    total = np.zeros((*window.shape, 3), np.float32)
    for part in np.linspace(-0.5, 0.5, EXPOSURES):
        seen = view_of_turned(frame, foreground, R @ _turned(part * blur), window)
        assert seen.frame.rgb is not None
        total += seen.frame.rgb
    noisy = total / EXPOSURES + rng.normal(0, GREY_NOISE, total.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
