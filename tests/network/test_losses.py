from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridvo.core.geometry import ego_flow, euler_deg_to_matrix, make_transform
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import Camera
from hybridvo.network.euler import euler_transform
from hybridvo.network.selection import select_pose
from hybridvo_lab.paper.losses import LossOptions, LossTargets, total_loss

PLAIN = {
    "pose_uncertainty": False,
    "flow_uncertainty": False,
    "depth_uncertainty": False,
}
POSE = {"flow": False, "depth": False}
FLOW = {"depth": False}
DEPTH = {"flow": False}
SWITCHES = [
    LossOptions(),
    LossOptions(translation_form="laplace"),
    LossOptions(**PLAIN),
    LossOptions(flow=False),
    LossOptions(pose_uncertainty=False, depth_uncertainty=False),
    LossOptions(direction_floor=1e-2, flow_limit_px=1e3, flow_weight=2.0),
]


def camera_matrix(batch: int, dtype=torch.float64) -> torch.Tensor:
    return torch.tensor([[10.0, 0, 1], [0, 10, 1], [0, 0, 1]], dtype=dtype).repeat(
        batch, 1, 1
    )


def constant_maps(values, batch=1, size=(2, 4)) -> torch.Tensor:
    column = torch.tensor(values, dtype=torch.float64).view(1, -1, 1, 1)
    return column.expand(batch, -1, *size).clone()


def make_targets(
    rotation=(0.0, 0, 0),
    translation=(0.0, 0, 0),
    flow=(0.0, 0),
    depth=2.0,
    depth_curr=2.0,
    batch=1,
    size=(2, 4),
) -> LossTargets:
    row = torch.tensor([[*rotation, *translation]], dtype=torch.float64)
    plane = torch.ones(batch, *size, dtype=torch.float64)
    K = camera_matrix(batch)
    return LossTargets(
        row.repeat(batch, 1),
        constant_maps(flow, batch, size),
        depth * plane,
        depth_curr * plane,
        K,
        K,
    )


def shift(x=0.0, y=0.0, z=0.0) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, :3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return T


def predict(
    rotation, translation, s_rotation, s_translation, **shape
) -> PixelwisePrediction:
    rows = (*rotation, *translation), (*s_rotation, *s_translation)
    return PixelwisePrediction(*(constant_maps(row, **shape) for row in rows))


LOG2 = math.log(2.0)
STILL = predict((0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0))


def test_rotation_by_hand():
    prediction = predict((1, 2, 3), (0, 0, 0), [LOG2] * 3, [LOG2] * 3)
    targets = make_targets(rotation=(1.5, 2, 2))  # errors 0.5, 0, 1: mean 0.5
    for options, expected in (
        (LossOptions(**POSE), 0.5 * (0.25 + LOG2)),
        (LossOptions(**POSE, **PLAIN), 0.5),
    ):
        _, parts = total_loss(prediction, targets, options, shift())
        assert parts["rotation"].item() == pytest.approx(expected, abs=1e-12)


def test_translation_by_hand():
    prediction = predict((0, 0, 0), (0, 4, 0), [LOG2] * 3, [LOG2] * 3)
    targets = make_targets(translation=(3, 0, 0))
    error = 1 + math.sqrt(2)  # lengths 3 and 4; perpendicular directions
    laplace = (0.5 * (3 + 4) / 3 + LOG2) / 2  # L1 of each component
    for options, expected in (
        (LossOptions(**POSE), 0.25 * error + LOG2),
        (LossOptions(**POSE, **PLAIN), error),
        (LossOptions(**POSE, translation_form="laplace"), laplace),
    ):
        _, parts = total_loss(prediction, targets, options, shift())
        # The published 1e-12 under the roots changes the last digits.
        assert parts["translation"].item() == pytest.approx(expected, abs=1e-9)


S = (0.3, -0.5, 1.0, 2.0, -1.0, 0.7)


def test_flow_by_hand():
    # tx = 0.2 m at 2 m with f = 10 px moves every pixel by 1 px; errors 0.5 and (cut off) 25.
    prediction = predict((0, 0, 0), (0, 0, 0), S[:3], S[3:])
    targets = make_targets(flow=(0.5, -25))
    _, parts = total_loss(
        prediction, targets, LossOptions(**FLOW, **PLAIN), shift(x=0.2)
    )
    assert parts["flow"].item() == pytest.approx(0.25)
    _, parts = total_loss(prediction, targets, LossOptions(**FLOW), shift(x=0.2))
    data = (
        sum(math.exp(-0.1 * S[c]) * 0.5 for c in (0, 1, 2, 5))
        + math.exp(-0.1 * S[3]) * 0.5
    )
    scale = 0.1 * (S[0] + S[1] + S[2] + S[5]) + 0.05 * (S[3] + S[4])
    assert parts["flow"].item() == pytest.approx(0.5 * data + scale, abs=1e-12)
    # A vertical error weighs with ty instead of tx.
    _, parts = total_loss(
        prediction, make_targets(flow=(1, 0.5)), LossOptions(**FLOW), shift(x=0.2)
    )
    data += 0.5 * (math.exp(-0.1 * S[4]) - math.exp(-0.1 * S[3]))
    assert parts["flow"].item() == pytest.approx(0.5 * data + scale, abs=1e-12)


def test_depth_by_hand():
    prediction = predict((0, 0, 0), (0, 0, 0), S[:3], S[3:])
    targets = make_targets(depth_curr=4.0)  # z' = 2.5: |1/4 - 1/2.5| = 0.15
    _, parts = total_loss(
        prediction, targets, LossOptions(**DEPTH, **PLAIN), shift(z=0.5)
    )
    assert parts["depth"].item() == pytest.approx(0.15)
    _, parts = total_loss(prediction, targets, LossOptions(**DEPTH), shift(z=0.5))
    expected = 0.5 * sum(
        math.exp(-0.25 * S[c]) * 0.15 + 0.25 * S[c] for c in (0, 1, 5)
    )
    assert parts["depth"].item() == pytest.approx(expected, abs=1e-12)


def test_pixels_without_depth_do_not_count():
    prediction = predict((0, 0, 0), (0, 0, 0), S[:3], S[3:])
    targets = make_targets(flow=(0.5, 0), depth_curr=4.0)
    T, options = shift(x=0.2), LossOptions()
    _, expected = total_loss(prediction, targets, options, T)
    for damage in (torch.nan, 0.0, -1.0, torch.inf):
        depth = targets.depth_prev.clone()
        depth[0, 0, :2] = damage
        flow = targets.ego_flow.clone()
        flow[0, :, 0, :2] = 7.0
        broken = replace(targets, depth_prev=depth, ego_flow=flow)
        _, parts = total_loss(prediction, broken, options, T)
        for name in parts:
            torch.testing.assert_close(parts[name], expected[name])
    flow = targets.ego_flow.clone()
    flow[0, :, 0, :2] = torch.nan
    _, parts = total_loss(prediction, replace(targets, ego_flow=flow), options, T)
    torch.testing.assert_close(parts["flow"], expected["flow"])


def test_a_coarse_scale_answers_for_its_pixels():
    generator = torch.Generator().manual_seed(4)
    size, batch = (6, 10), 2
    s = torch.randn(batch, 6, 3, 5, generator=generator, dtype=torch.float64)
    fine = s.repeat_interleave(2, 2).repeat_interleave(2, 3)
    targets = make_targets(depth_curr=3.0, batch=batch, size=size)
    noise = torch.randn(
        targets.ego_flow.shape, generator=generator, dtype=torch.float64
    )
    depth = targets.depth_prev.clone()
    depth[:, 2, 3:6] = torch.nan
    targets = replace(targets, ego_flow=noise, depth_prev=depth)
    T = shift(0.1, 0.2, 0.3).repeat(batch, 1, 1)
    options = LossOptions()
    losses = [
        total_loss(PixelwisePrediction(x, x), targets, options, T)[0]
        for x in (s, fine)
    ]
    torch.testing.assert_close(*losses)


@pytest.mark.parametrize("seed", range(3))
def test_reconstruction_matches_the_numpy_geometry(seed):
    rng = np.random.default_rng(seed)
    prev, curr = (
        Camera(50, 55, 10, 7, height=16, width=24),
        Camera(52, 57, 11, 8, height=16, width=24),
    )
    depth = rng.uniform(0.5, 10, (16, 24))
    depth[rng.random((16, 24)) < 0.1] = np.nan
    motion = make_transform(
        euler_deg_to_matrix(rng.normal(0, 5, 3)), rng.normal(0, 0.3, 3)
    )
    z, T, *cameras = (
        torch.tensor(x)[None] for x in (depth, motion, prev.K, curr.K)
    )
    flow, z, valid = LossTargets(T, T, z, z, *cameras).reconstruct(T)
    expected = ego_flow(depth, motion, prev, curr)
    mask = valid[0].numpy()
    np.testing.assert_array_equal(mask, np.isfinite(expected[..., 0]))
    np.testing.assert_allclose(
        flow[0].numpy().transpose(1, 2, 0)[mask], expected[mask], atol=1e-10
    )
    assert torch.isfinite(flow).all() and torch.isfinite(z).all()


def test_points_behind_the_camera_are_charged_and_brought_back():
    T = shift(z=-2.5)
    T.requires_grad_()
    targets = make_targets()
    depth = targets.depth_prev.clone()
    depth[0, 0] = 5.0
    _, z, valid = replace(targets, depth_prev=depth).reconstruct(T)
    assert valid[0].tolist() == [[True] * 4, [False] * 4]
    assert z[0, 1, 0].item() == pytest.approx(-0.5)
    loss, parts = total_loss(STILL, targets, LossOptions(**PLAIN), T)
    loss.backward()
    # every point is behind: the limit of each component, and the tangent of 1 / z at the target
    assert parts["flow"].item() == pytest.approx(20.0)
    assert parts["depth"].item() == pytest.approx(2.5 / 4)
    assert torch.isfinite(T.grad).all() and T.grad[0, 2, 3] < 0
    worse = total_loss(STILL, targets, LossOptions(**PLAIN), shift(z=-3.0))[0]
    assert worse > loss.detach()


@pytest.mark.slow
@pytest.mark.parametrize("options", SWITCHES)
def test_gradcheck_through_selection(options):
    generator = torch.Generator().manual_seed(11)
    maps = [
        (
            scale
            * torch.randn(1, 6, 3, 4, generator=generator, dtype=torch.float64)
        ).requires_grad_()
        for scale in (torch.tensor([1.0] * 3 + [0.1] * 3)[:, None, None], 0.5)
    ]
    targets = make_targets((0.3, -0.2, 0.1), (0.05, -0.02, 0.1), size=(3, 4))
    noise = torch.randn(
        targets.ego_flow.shape, generator=generator, dtype=torch.float64
    )
    depth = 2 + torch.rand(1, 3, 4, generator=generator, dtype=torch.float64)
    depth[0, 1, 1] = torch.nan
    targets = replace(targets, ego_flow=noise, depth_prev=depth)

    def loss(*values):
        prediction = PixelwisePrediction(*values)
        T = euler_transform(select_pose(prediction, patch=2))
        return total_loss(prediction, targets, options, T)[0]

    torch.autograd.gradcheck(loss, maps)


@pytest.mark.parametrize("options", SWITCHES)
@pytest.mark.parametrize("translation", [(0.0, 0, 0), (0.1, 0, 0)])
def test_gradients_are_finite_at_identity_and_zero_error(options, translation):
    targets = make_targets(translation=translation).to(torch.float32)
    T = shift(*translation).float()
    flow, z, _ = targets.reconstruct(T)
    targets = replace(targets, ego_flow=flow, depth_curr=z)
    exact = predict((0, 0, 0), translation, (0, 0, 0), (0, 0, 0))
    maps = [v.float().requires_grad_() for v in (exact.motion, exact.log_scale)]
    prediction = PixelwisePrediction(*maps)
    T = euler_transform(select_pose(prediction))
    loss, _ = total_loss(prediction, targets, options, T)
    loss.backward()
    assert torch.isfinite(loss)
    for value in maps:
        if value.grad is not None:
            assert torch.isfinite(value.grad).all()
    if options.needs_uncertainty:  # s still falls where the error is zero
        assert maps[1].grad.abs().sum() > 0
