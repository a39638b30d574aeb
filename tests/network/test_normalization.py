"""Networks without units: the scales of their inputs and outputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import Camera, PairBatch
from hybridvo.network.euler import euler_motion
from hybridvo_lab.paper.inputs import NetworkInputs, assemble_inputs
from hybridvo_lab.paper.losses import LossOptions, LossTargets, total_loss
from hybridvo_lab.paper.networks import NetworkOptions, build_network
from hybridvo_lab.paper.normalization import normalize

CAMERA = Camera(60.0, 62.0, 31.5, 15.5, height=32, width=64)
SCALE_FREE = NetworkOptions(scale_free=True)
MOTION = se3_exp(np.array([0.05, -0.03, 0.08, 0.004, -0.006, 0.01]))


def scene(scale: float = 1.0) -> np.ndarray:
    v, u = np.mgrid[:32, :64]
    return (scale * (4 + np.sin(u / 9.0) + 0.5 * np.cos(v / 5.0))).astype(
        np.float32
    )


def inputs_of(
    flow: np.ndarray, depth: np.ndarray, depth_curr: np.ndarray | None = None
) -> NetworkInputs:
    K = torch.tensor(CAMERA.K, dtype=torch.float32)[None]
    depth_curr = depth if depth_curr is None else depth_curr
    flow, prev, curr = (
        torch.tensor(x, dtype=torch.float32)[None]
        for x in (flow, depth, depth_curr)
    )
    return assemble_inputs(PairBatch(flow, prev, K, K, curr), None, is_aligned=True)


def static_inputs(T: np.ndarray = MOTION, scale: float = 1.0) -> NetworkInputs:
    depth = scene(scale)
    T = T.copy()
    T[:3, 3] *= scale
    v, u = np.mgrid[:32, :64]
    rays = np.stack(
        [
            (u - CAMERA.cx) / CAMERA.fx,
            (v - CAMERA.cy) / CAMERA.fy,
            np.ones((32, 64)),
        ]
    )
    moved = np.einsum("ij,jhw->ihw", T[:3, :3], rays * depth) + T[:3, 3, None, None]
    return inputs_of(ego_flow(depth, T, CAMERA, CAMERA), depth, moved[2])


def tiny(**options) -> torch.nn.Module:
    torch.manual_seed(0)
    return build_network(
        NetworkOptions(width=0.1, scale_free=True, **options)
    ).eval()


def test_scales_by_hand():
    # 3 px of flow everywhere at 60 px focal length: 0.05 rad; depth 2 m everywhere
    flow = np.zeros((32, 64, 2))
    flow[..., 0] = 3.0
    inputs, scale = normalize(inputs_of(flow, np.full((32, 64), 2.0)), SCALE_FREE)
    expected = [np.rad2deg(0.05)] * 3 + [0.1] * 3
    np.testing.assert_allclose(scale.factor[0], expected, rtol=1e-5)
    # flow over itself is 1, squashed at 10: 1 / 1.1
    np.testing.assert_allclose(inputs.flow[0, 0], 1 / 1.1, rtol=1e-5)
    np.testing.assert_allclose(inputs.inverse_depth[0, 0], 1 / 1.1, rtol=1e-5)
    assert float(inputs.inverse_depth[0, 1].abs().max()) == 0


@settings(max_examples=15, deadline=None)
@given(factor=st.floats(0.1, 10.0))
def test_a_scene_twice_as_large_moves_by_twice_as_many_metres(factor):
    # depths stay below the 50 m beyond which the scale of the translation is held
    network = tiny()
    with torch.inference_mode():
        one, other = network(static_inputs()), network(static_inputs(scale=factor))
    (r, t), (other_r, other_t) = (x.motion.split(3, dim=1) for x in (one, other))
    torch.testing.assert_close(r, other_r, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(factor * t, other_t, atol=1e-3, rtol=2e-3)
    s, other_s = (x.log_scale[:, 3:] for x in (one, other))
    torch.testing.assert_close(s + np.log(factor), other_s, atol=2e-3, rtol=0)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, 1e38])
def test_bad_values_give_finite_predictions(value):
    flow, depth = np.full((32, 64, 2), value), np.full((32, 64), value)
    network = tiny()
    with torch.inference_mode():
        output = network(inputs_of(flow, depth))
    assert torch.isfinite(output.motion).all()
    assert torch.isfinite(output.log_scale).all()


def test_the_truth_has_no_flow_loss_on_fewer_pixels():
    inputs = static_inputs()
    T = torch.tensor(MOTION, dtype=torch.float32)[None]
    targets = LossTargets(
        motion=euler_motion(T),
        ego_flow=inputs.flow,
        depth_prev=1 / inputs.inverse_depth[:, 0],
        depth_curr=1 / inputs.inverse_depth[:, 1],
        K_prev=inputs.K_prev,
        K_curr=inputs.K_curr,
    ).subsample(4)
    assert targets.depth_prev.shape == (1, 8, 16)
    options = LossOptions(
        pose_uncertainty=False, flow_uncertainty=False, depth_uncertainty=False
    )
    output = PixelwisePrediction(targets.motion[:, :, None, None])
    _, parts = total_loss(output, targets, options, T)
    # float32 coordinates of 64 px: 4e-6 px
    assert float(parts["flow"]) < 1e-4
    assert float(parts["depth"]) < 1e-5
    off = T.clone()
    off[0, 0, 3] += 0.1
    assert float(total_loss(output, targets, options, off)[1]["flow"]) > 0.1
