"""What the hybrid takes from a pixel-wise network: its fitted motion and its static world."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hybridvo.errors import InputError
from hybridvo.geometry import ego_flow, rotation_angle, se3_exp
from hybridvo.network.inputs import assemble_inputs
from hybridvo.network.passes import predict
from hybridvo.network.prediction import (
    estimate_by_network,
    propose_motion,
    static_probability,
)
from hybridvo.network.pwvo import NetworkOptions, build_network
from hybridvo.network.selection import select_motion
from hybridvo.network.weighted_fit import fitted_motion
from hybridvo.results import PixelwisePrediction, Reason, StageFailed
from hybridvo.synthetic.noise_scenarios import Scenario, make_pair
from hybridvo.types import Camera, Frame, FramePair

STRIDE = 4


@pytest.fixture(scope="module")
def moving_pair():
    return make_pair(
        Scenario(moving=0.65, objects=1, flow_noise_px=0.1), 3, 128, 256
    )


def told(pair, truth, doubt: float) -> tuple[PixelwisePrediction, object]:
    """A prediction of no motion at all that knows where the world is."""
    inputs = assemble_inputs(pair)
    small = inputs.subsample(STRIDE)
    moving = torch.from_numpy(truth["moving"])[
        STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE
    ]
    s = torch.where(moving, doubt, 0.0)[None, None].repeat(1, 6, 1, 1).float()
    assert s.shape[2:] == small.flow.shape[2:]
    return PixelwisePrediction(torch.zeros_like(s), s - 3), inputs


def test_the_world_is_fitted_where_the_doubt_is_small(moving_pair) -> None:
    pair, truth = moving_pair
    R = truth["T_curr_prev"][:3, :3]
    size = np.degrees(rotation_angle(R))
    errors = {}
    for doubt in (0.0, 2.0):
        output, inputs = told(pair, truth, doubt)
        T = fitted_motion(output, inputs)[0].double().numpy()
        errors[doubt] = np.degrees(rotation_angle(T[:3, :3] @ R.T))
    # 60 % of the image move by themselves: without doubt they win
    assert errors[2.0] < 0.1 * size < errors[0.0]
    with pytest.raises(InputError, match="uncertainty"):
        fitted_motion(PixelwisePrediction(torch.zeros(1, 6, 1, 1)), inputs)


def test_static_probability_by_its_definition(moving_pair) -> None:
    output, inputs = told(*moving_pair, 4.0)
    valid = inputs.subsample(STRIDE).valid
    p = static_probability(output.log_scale, valid)
    moving = output.log_scale[:, 0] > -2
    assert p[~valid].abs().sum() == 0
    assert p[valid & ~moving].min() > 0.9 and p[valid & moving].max() < 0.1
    # adding a constant to s says nothing about where the world is
    shifted = static_probability(output.log_scale + 1.5, valid)
    torch.testing.assert_close(p, shifted, atol=1e-5, rtol=0)


def test_proposals_are_finite_or_none(moving_pair) -> None:
    pair, _ = moving_pair
    torch.manual_seed(0)
    options = NetworkOptions(
        width=0.25, scale_free=True, passes=2, head_stride=2, input_stride=2
    )
    network = build_network(options).eval()
    proposal = propose_motion(network, pair)
    assert proposal is not None and proposal.static_probability.shape == (32, 64)
    assert np.isfinite(proposal.T_curr_prev).all()
    assert (proposal.static_probability >= 0).all() and (
        proposal.static_probability <= 1
    ).all()
    empty, _ = make_pair(Scenario(), 3, 128, 256)
    empty.flow[:] = np.nan
    assert propose_motion(network, empty) is None


CAMERA = Camera(60.0, 62.0, 31.5, 15.5, 32, 64)
MOTION = se3_exp(np.array([0.05, -0.03, 0.08, 0.004, -0.006, 0.01]))
DEPTH = np.linspace(2, 6, 64, dtype=np.float32) * np.ones((32, 1), np.float32)


def pair_of(flow: np.ndarray | None, depth: np.ndarray | None) -> FramePair:
    return FramePair(Frame(None, depth, CAMERA), Frame(None, depth, CAMERA), flow)


@pytest.mark.parametrize(("method", "passes"), [("pwvo", 2), ("vonet", 1)])
def test_a_network_is_an_estimator(method, passes):
    torch.manual_seed(0)
    options = NetworkOptions(kind=method, width=0.1, scale_free=True, passes=passes)
    network = build_network(options).eval()
    pair = pair_of(
        ego_flow(DEPTH, MOTION, CAMERA, CAMERA).astype(np.float32), DEPTH
    )
    result = estimate_by_network(pair, "softmax", network)
    assert result.ok
    assert np.linalg.eigvalsh(result.covariance)[0] > 0
    R = result.T_curr_prev[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    with torch.inference_mode():
        expected = select_motion(predict(network, assemble_inputs(pair)))[0]
    np.testing.assert_allclose(result.T_curr_prev, expected.numpy(), atol=1e-5)


def test_missing_data_fail_with_a_reason():
    network = build_network(NetworkOptions(width=0.1)).eval()
    flow = np.zeros((32, 64, 2), np.float32)
    for reason, broken in (
        (Reason.NO_FLOW, pair_of(None, DEPTH)),
        (Reason.NO_VALID_DEPTH, pair_of(flow, None)),
        (Reason.NO_VALID_DEPTH, pair_of(flow, np.full_like(DEPTH, np.nan))),
    ):
        with pytest.raises(StageFailed) as failure:
            estimate_by_network(broken, "softmax", network)
        assert failure.value.reason is reason
