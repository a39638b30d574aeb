"""Images without texture: depth alone can show that the camera stood still, or nothing can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_log
from hybridvo.flow.providers import has_texture
from hybridvo_lab.synthetic.scenes import make_scene
from tests import worlds

SIZE = (240, 320)
CAMERA = worlds.camera(SIZE)


def image(kind: str, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) what a camera gives that sees no scene."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] / SIZE[1] - 0.5
    noise = rng.standard_normal(SIZE)
    grey = {
        "dark": 20 + 2 * noise,
        "noisy": 60 + 10 * noise,
        # a white wall through a lens that is darker at the edge
        "wall": 160 * (1 - u**2 - v**2) + 1.5 * noise,
    }[kind]
    rounded = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return np.repeat(rounded[..., None], 3, axis=2)


def depth(kind: str, rng: np.random.Generator) -> np.ndarray:
    """(H, W) metres of what tells nothing of a motion along it."""
    flat = np.full(SIZE, 2.0)
    values = {
        "missing": 0 * flat,
        "flat": flat,
        "flat, noisy": flat + 0.005 * rng.standard_normal(SIZE),
    }[kind]
    return values.astype(np.float32)


@pytest.mark.parametrize("depths", ["missing", "flat", "flat, noisy"])
@pytest.mark.parametrize("images", ["dark", "noisy", "wall"])
def test_frames_without_information_are_never_a_sure_standstill(images, depths):
    rng = np.random.default_rng(4)
    frames = [
        hvo.Frame(image(images, rng), depth(depths, rng), CAMERA, timestamp=t)
        for t in (0.0, 0.03)
    ]
    again = replace(frames[0], timestamp=0.03)
    for method in ("hybrid", "classical"):
        assert not hvo.estimate(*frames, method=method).ok
        # handed out twice, its noise is the same
        assert not hvo.estimate(frames[0], again, method=method).ok


def test_depth_alone_shows_the_motion_where_images_are_too_dark():
    scene = make_scene("static", 7, height=SIZE[0], width=SIZE[1], frames=2)
    rng = np.random.default_rng(5)
    frames = []
    for index in range(2):
        seen = scene.render(index)
        noise = 1.5 * rng.standard_normal(seen.rgb.shape)
        dark = np.clip(np.rint(10 + 0.03 * seen.rgb + noise), 0, 255)
        measured = seen.depth * (1 + 0.003 * rng.standard_normal(SIZE))
        frames.append(
            replace(
                seen,
                rgb=dark.astype(np.uint8),
                depth=measured.astype(np.float32),
            )
        )
    assert not has_texture(frames[0])
    T_true = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    found = hvo.estimate(*frames)
    assert found.ok
    error = se3_log(found.T_curr_prev @ invert(T_true))
    # the motion is 11 cm; 99.9 % of 6 degrees of freedom lie within 22.5
    assert np.linalg.norm(error[:3]) < 0.005
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
