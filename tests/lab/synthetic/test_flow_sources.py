"""Flow of many makers: estimated by several methods, and true flow that is disturbed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hybridvo.core.types import Camera, Frame
from hybridvo_lab.synthetic import flow_sources
from hybridvo_lab.synthetic.flow_sources import (
    DISTURBANCES,
    ESTIMATORS,
    draw_disturbed_flow,
    draw_estimated_flow,
)

CAMERA = Camera(200.0, 200.0, 95.5, 63.5, height=128, width=192)
SHIFT = np.array([2.0, -1.0])


def shifted_frames() -> tuple[Frame, Frame]:
    """A textured plane, and the same 2 px further right and 1 px up."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (160, 224, 3)).astype(np.float32)
    image = 128 + 6 * (cv2.GaussianBlur(noise, (0, 0), 2) - 128)
    image = np.clip(image, 0, 255).astype(np.uint8)
    prev = image[16:144, 16:208]
    curr = image[17:145, 14:206]
    return Frame(prev.copy(), None, CAMERA), Frame(curr.copy(), None, CAMERA)


def only(monkeypatch, name: str, chosen: str) -> None:
    """Let one of several kinds be drawn."""
    kinds = getattr(flow_sources, name)
    shares = tuple(float(kind == chosen) for kind in kinds)
    probabilities_name = name.removesuffix("S") + "_PROBABILITIES"
    monkeypatch.setattr(flow_sources, probabilities_name, shares)


def true_flow(height: int = 128, width: int = 512) -> np.ndarray:
    """A flow that grows to the right, with a moving square and a hole."""
    u = np.linspace(-4, 4, width)
    flow = np.zeros((height, width, 2), np.float32)
    flow[..., 0] = u
    flow[40:80, 200:260] += 10.0
    flow[:10, :10] = np.nan
    return flow


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_estimator_finds_a_shift(monkeypatch, estimator: str) -> None:
    only(monkeypatch, "ESTIMATORS", estimator)
    prev, curr = shifted_frames()
    field = draw_estimated_flow(np.random.default_rng(0), prev, curr)
    middle = field.flow[20:-20, 20:-20]
    error = np.linalg.norm(middle - SHIFT, axis=2)
    assert np.median(error) < 0.3
    assert field.flow.dtype == np.float32 and field.variance is not None
    assert field.valid[20:-20, 20:-20].mean() > 0.8


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_without_images_there_is_no_flow(monkeypatch, estimator: str) -> None:
    only(monkeypatch, "ESTIMATORS", estimator)
    blind = Frame(None, np.ones(CAMERA.shape, np.float32), CAMERA)
    assert draw_estimated_flow(np.random.default_rng(0), blind, blind).flow is None


@pytest.mark.parametrize("kind", DISTURBANCES)
def test_a_disturbed_flow_is_near_the_true_one(monkeypatch, kind: str) -> None:
    only(monkeypatch, "DISTURBANCES", kind)
    true = true_flow()
    before = true.copy()
    known = np.isfinite(true).all(axis=2)
    for seed in range(8):
        flow = draw_disturbed_flow(np.random.default_rng(seed), true)
        assert flow.shape == true.shape and flow.dtype == np.float32
        np.testing.assert_array_equal(true, before)
        # what is not known stays unknown
        assert np.isnan(flow[~known]).all()
        assert np.isfinite(flow[known]).all()
        error = np.linalg.norm(flow - true, axis=2)[known]
        if kind == "none":
            assert error.max() == 0
        else:
            assert 0 < np.median(error) < 3
    again = draw_disturbed_flow(np.random.default_rng(7), true)
    np.testing.assert_array_equal(flow, again)
