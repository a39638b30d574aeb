"""A rendered scene slowed down to video rate, with the noise of a depth sensor."""

from __future__ import annotations

import numpy as np

import hybridvo as hvo
from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.slow_scenes import (
    noisy_image,
    slow_scene,
    structured_light,
)

SIZE = (120, 160)


def frames(
    kind: str, seed: int, count: int, stride: int = 1
) -> tuple[list[hvo.Frame], np.ndarray]:
    """Frames and their poses T_world_cam; every ``stride``-th of the slow ones."""
    length = count * stride
    scene = slow_scene(kind, seed, length + 1, SIZE)
    rng = np.random.default_rng(seed)
    taken = range(0, length, stride)
    sensed = [sense(scene, index, k, rng) for k, index in enumerate(taken)]
    return sensed, scene.T_world_cam[taken]


def sense(scene: Scene, index: int, k: int, rng: np.random.Generator) -> hvo.Frame:
    """Frame ``index`` of a scene as a sensor gives it, the ``k``-th at 30 a second."""
    rendered = scene.render(index)
    rgb = noisy_image(rendered.rgb, rng)
    depth = structured_light(rendered.depth, rng, edges_by_measured=True)
    return hvo.Frame(rgb, depth, scene.camera, timestamp=k / 30)
