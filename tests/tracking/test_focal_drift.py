"""A focal length that is off, by the images of some tens of motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp
from hybridvo.core.results import RelativePose, Status
from hybridvo.lab.synthetic.scenes import make_scene
from hybridvo.tracking.calibration import MIN_FOCAL_STEPS
from hybridvo.tracking.focal_drift import Bend, FocalDrift, bend_of


def refocused(frame: hvo.Frame, factor: float) -> hvo.Frame:
    """A frame that states another focal length than it has."""
    camera = frame.camera
    longer = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    return replace(frame, camera=longer)


@pytest.mark.parametrize("factor", [1.0, 1.1, 0.9])
def test_a_turning_camera_shows_its_focal_length(factor: float) -> None:
    known = FocalDrift()
    for seed in range(6):
        scene = make_scene("static", seed, height=240, width=320, frames=2)
        pair = [refocused(scene.render(i), factor) for i in range(2)]
        known = known.observed(*pair, hvo.estimate(*pair))
    assert known.factor == pytest.approx(1 / factor, abs=0.03)


def test_it_takes_many_motions_that_agree() -> None:
    known = FocalDrift()
    rng = np.random.default_rng(0)
    for _ in range(MIN_FOCAL_STEPS):
        assert not known.is_off
        known = known.with_bend(Bend(-0.1 + 0.05 * rng.standard_normal(), 1e4))
    assert known.is_off
    assert "0.9" in known.message
    scattered = FocalDrift()
    for _ in range(MIN_FOCAL_STEPS):
        scattered = scattered.with_bend(Bend(-0.1 + rng.standard_normal(), 1e4))
    assert not scattered.is_off


def test_a_motion_that_is_not_ok_tells_nothing() -> None:
    frame = make_scene("static", 1, height=96, width=128, frames=2).render(0)
    doubted = RelativePose(status=Status.degraded(hvo.Reason.LOW_INLIERS, "few"))
    assert FocalDrift().observed(frame, frame, doubted) == FocalDrift()
    assert bend_of(replace(frame, rgb=None), frame, RelativePose()) is None
    away = RelativePose(invert(se3_exp(np.array([9.0, 0, 0, 0, 0, 0]))))
    assert bend_of(frame, frame, away) is None
