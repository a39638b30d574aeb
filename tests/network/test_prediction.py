"""Networks alone: a motion fitted by uncertainty, the methods of that name, missing data."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow, rotation_angle, se3_exp
from hybridvo.core.options import Options
from hybridvo.core.results import PixelwisePrediction, Reason, StageFailed, State
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.judge.verdict import believed
from hybridvo.network.prediction import estimate_by_pwvo
from hybridvo.network.pwvo import PWVO, PWVOOptions
from hybridvo.network.selection import select_motion
from hybridvo_lab.paper.inputs import assemble_inputs
from hybridvo_lab.paper.networks import NetworkOptions, build_network
from hybridvo_lab.paper.prediction import estimate_by_network
from hybridvo_lab.paper.weighted_fit import fitted_motion
from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair

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


CAMERA = Camera(60.0, 62.0, 31.5, 15.5, height=32, width=64)
MOTION = se3_exp(np.array([0.05, -0.03, 0.08, 0.004, -0.006, 0.01]))
DEPTH = np.linspace(2, 6, 64, dtype=np.float32) * np.ones((32, 1), np.float32)


def pair_of(flow: np.ndarray | None, depth: np.ndarray | None) -> FramePair:
    return FramePair(Frame(None, depth, CAMERA), Frame(None, depth, CAMERA), flow)


@pytest.mark.parametrize("kind", ["pwvo", "vonet"])
def test_a_network_is_an_estimator(kind):
    torch.manual_seed(0)
    options = NetworkOptions(kind=kind, width=0.1, scale_free=True)
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
        expected = select_motion(network(assemble_inputs(pair)))[0]
    np.testing.assert_allclose(result.T_curr_prev, expected.numpy(), atol=1e-5)


def test_pwvo_alone_is_an_estimator(moving_pair):
    pair, _ = moving_pair
    network = PWVO.from_pretrained()
    motion = estimate_by_pwvo(pair, network, None, Options(), 0)
    result = believed(motion)
    assert result.usable and 0 <= result.probability <= 1
    assert np.linalg.eigvalsh(result.covariance)[0] > 0
    with torch.inference_mode():
        expected = select_motion(network(pair))[0]
    np.testing.assert_allclose(result.T_curr_prev, expected.numpy(), atol=1e-4)
    # the covariance is stated whatever probability is wanted; the status is not
    unsure = believed(motion, min_probability=1.0)
    np.testing.assert_array_equal(unsure.covariance, result.covariance)
    assert unsure.status.state is State.DEGRADED


def test_missing_data_fail_with_a_reason():
    network = build_network(NetworkOptions(width=0.1)).eval()
    ours = PWVO(PWVOOptions(width=0.25)).eval()
    flow = np.zeros((32, 64, 2), np.float32)
    for reason, broken in (
        (Reason.NO_FLOW, pair_of(None, DEPTH)),
        (Reason.NO_VALID_DEPTH, pair_of(flow, None)),
        (Reason.NO_VALID_DEPTH, pair_of(flow, np.full_like(DEPTH, np.nan))),
    ):
        with pytest.raises(StageFailed) as failure:
            estimate_by_network(broken, "softmax", network)
        assert failure.value.reason is reason
        with pytest.raises(StageFailed) as failure:
            estimate_by_pwvo(broken, ours, None, Options(), 0)
        assert failure.value.reason is reason
