"""A focal length that is off, and a rolling shutter, by the images of some tens of motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.geometry import backproject
from hybridvo.tracking.camera_drift import (
    MIN_CAMERA_STEPS,
    Bend,
    FocalDrift,
    bends_of,
    robust_mean,
)
from hybridvo_lab.synthetic.scenes import make_scene

PERIOD_S = 1 / 30
"""Time between two frames."""


def refocused(frame: hvo.Frame, factor: float) -> hvo.Frame:
    """A frame that states another focal length than it has."""
    camera = frame.camera
    longer = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    return replace(frame, camera=longer)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 1.1, 0.9])
def test_a_turning_camera_shows_its_focal_length(factor: float) -> None:
    known = FocalDrift()
    for seed in range(6):
        scene = make_scene("static", seed, height=240, width=320, frames=2)
        pair = [refocused(scene.render(i), factor) for i in range(2)]
        shown = bends_of(*pair, hvo.estimate(*pair))
        if shown is not None:
            known = known.with_bend(shown.focal)
    assert known.factor == pytest.approx(1 / factor, abs=0.03)


def rolled(turn: np.ndarray, start: float, readout: float, seed: int) -> hvo.Frame:
    """A view from inside a painted sphere, whose rows are read one after the other.

    ``turn``: rotation vector of a period; ``start`` and ``readout``: in periods.
    """
    camera = hvo.Camera(280.0, 280.0, 159.5, 119.5, height=240, width=320)
    ones = np.ones(camera.shape)
    rays = backproject(ones, camera)
    depth = 3.0 / np.linalg.norm(rays, axis=-1)
    times = start + readout * np.arange(camera.height) / camera.height
    R_world_cam = Rotation.from_rotvec(times[:, None] * turn).as_matrix()
    directions = np.einsum("vij,vuj->vui", R_world_cam, rays * depth[..., None])
    rng = np.random.default_rng(seed)
    waves = rng.normal(scale=8.0, size=(12, 3))
    phases = rng.uniform(0, 2 * np.pi, 12)
    grey = 128 + 9 * np.sin(directions @ waves.T + phases).sum(axis=-1)
    rgb = np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None].repeat(3, -1)
    stamp = start * PERIOD_S
    return hvo.Frame(rgb, depth.astype(np.float32), camera, timestamp=stamp)


@pytest.mark.parametrize("readout_ms", [0.0, 25.0])
def test_a_turning_camera_shows_its_readout(readout_ms: float) -> None:
    """Pairs of cameras that turn evenly, whose velocity is known."""
    rng = np.random.default_rng(1)
    shown = []
    for seed in range(8):
        turn = 0.04 * rng.normal(size=3)
        fraction = readout_ms / 1000 / PERIOD_S
        pair = [rolled(turn, start, fraction, seed) for start in (0.0, 1.0)]
        velocity = np.concatenate([np.zeros(3), -turn / PERIOD_S])
        bends = bends_of(*pair, hvo.estimate(*pair), (velocity, velocity))
        if bends is not None and bends.readout is not None:
            shown.append(bends.readout)
    assert robust_mean(shown).error == pytest.approx(readout_ms, abs=4.0)


def test_it_takes_many_motions_that_agree() -> None:
    known = FocalDrift()
    rng = np.random.default_rng(0)
    for _ in range(MIN_CAMERA_STEPS):
        assert not known.is_off
        known = known.with_bend(Bend(-0.1 + 0.05 * rng.standard_normal(), 1e4))
    assert known.is_off
    assert "0.9" in known.message
    scattered = FocalDrift()
    for _ in range(MIN_CAMERA_STEPS):
        scattered = scattered.with_bend(Bend(-0.1 + rng.standard_normal(), 1e4))
    assert not scattered.is_off
