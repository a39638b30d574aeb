from __future__ import annotations

import numpy as np
import pytest

from hybridvo.data.sensor_noise import ratio_variance, stereo_variance, structured_light_variance
from hybridvo.errors import InputError
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.pipeline import refine
from hybridvo.types import Camera, Frame, FramePair

DEPTH = np.array([[2.0, 4.0]], np.float32)


def test_by_hand():
    # sigma_z = 1.425e-3 * 4 m at 2 m is 5.7 mm, 0.285 % of 2 m
    assert structured_light_variance(DEPTH)[0] == pytest.approx([0.00285**2, 0.0057**2])
    # f b = 50 px m: disparity 25 px at 2 m, 0.5 px are 2 %
    assert stereo_variance(DEPTH, 500.0, 0.1)[0] == pytest.approx([0.02**2, 0.04**2])
    assert ratio_variance(DEPTH, 0.03)[0] == pytest.approx([9e-4, 9e-4])


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_bad_parameters(value):
    for call in (
        lambda: structured_light_variance(DEPTH, value),
        lambda: stereo_variance(DEPTH, value, 0.1),
        lambda: stereo_variance(DEPTH, 500.0, value),
        lambda: ratio_variance(DEPTH, value),
    ):
        with pytest.raises(InputError, match="positive"):
            call()


def test_the_right_model_makes_the_answer_better():
    camera = Camera(300.0, 300.0, 159.5, 79.5, 160, 320)
    u, _ = np.meshgrid(np.arange(320), np.arange(160))
    told, untold = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        depth = 1.0 + u / 20 + rng.uniform(0, 1)
        T = se3_exp(np.concatenate([rng.uniform(-0.2, 0.2, 3), rng.uniform(-0.02, 0.02, 3)]))
        flow = ego_flow(depth, T, camera, camera) + rng.normal(0, 0.1, (160, 320, 2))
        variance = structured_light_variance(depth, 0.01)
        measured = (depth * np.exp(np.sqrt(variance) * rng.normal(size=depth.shape))).astype("f4")
        for model, found in ((variance, told), (None, untold)):
            prev = Frame(None, measured, camera, depth_variance=model)
            pair = FramePair(prev, Frame(None, None, camera), flow.astype(np.float32))
            found.append(np.linalg.norm(refine(pair).T_curr_prev[:3, 3] - T[:3, 3]))
    assert np.mean(told) < np.mean(untold)
