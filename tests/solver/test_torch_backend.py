"""The refinement of batches: accuracy, independence of the samples, bad data, oracles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridvo.api import refine
from hybridvo.batches import refine_batch
from hybridvo.core.geometry import (
    ego_flow,
    invert,
    se3_exp,
    se3_log,
)
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Reason, State
from hybridvo.core.torch_geometry import pixel_grid, reproject, se3
from hybridvo.core.types import PairBatch
from hybridvo.solver.covariance import MotionCovariance
from hybridvo.solver.torch.batched_pose import BatchedPose
from hybridvo.solver.torch.covariance import checked
from hybridvo.solver.torch.factors import KERNELS
from hybridvo_lab.synthetic.noise_scenarios import make_pair
from tests import worlds
from tests.solver.batches import F64, noisy_batch

FIELDS = ("SE3", "covariance", "converged", "failed", "cost", "weights", "noise")


def scene(batch: int = 3, seed: int = 0, **how) -> tuple[PairBatch, torch.Tensor]:
    return noisy_batch(batch, (40, 56), seed, **how)


def preferring(pair: PairBatch) -> torch.Tensor:
    """Weights that prefer half of the pixels: they say that the scene is where the motion is."""
    weights = torch.ones_like(pair.depth_prev)
    weights[:, ::2] = 0.9
    return weights


def assert_same(
    a: BatchedPose, ia: list[int], b: BatchedPose, ib: list[int]
) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(a, name)[ia], getattr(b, name)[ib]), name


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_finds_the_motion_within_its_covariance(dtype: torch.dtype) -> None:
    pair, T = scene(8, dtype=dtype)
    result = refine_batch(pair, weights=preferring(pair))
    assert result.T_curr_prev.dtype == dtype and result.SE3.shape == (8, 7)
    assert result.converged.all() and not result.failed.any()
    assert all(status.state is State.OK for status in result.status)
    nees = []
    for k in range(8):
        delta = (se3(T[k]) @ result.SE3[k].Inv()).Log().tensor()
        nees.append(
            float(delta @ torch.linalg.solve(result.covariance[k].double(), delta))
        )
    # chi-square with 48 degrees of freedom: 99.99 % below 95; the sandwich of 4 tiles is cautious
    assert sum(nees) < 95
    assert result.noise[:, 0].double().numpy() == pytest.approx(0.3, rel=0.1)
    # q is a pixel or two here, so one pair alone tells little of the depth noise
    assert float(result.noise[:, 1].median()) == pytest.approx(0.02, abs=0.0101)
    assert (result.inlier_ratio > 0.85).all()


def test_a_nan_pair_leaves_the_others_bit_unchanged() -> None:
    pair, _ = scene(3)
    expected = refine_batch(pair)
    reasons = {"flow": Reason.NO_FLOW, "depth_prev": Reason.NO_VALID_DEPTH}
    for name, reason in reasons.items():
        broken = getattr(pair, name).clone()
        broken[1] = math.nan
        result = refine_batch(replace(pair, **{name: broken}))
        assert_same(result, [0, 2], expected, [0, 2])
        assert result.failed.tolist() == [False, True, False]
        assert result.status[1].state is State.FAILED
        assert result.status[1].reason is reason
        assert torch.equal(result.T_curr_prev[1], torch.eye(4, dtype=F64))
        assert (
            torch.isfinite(result.covariance).all()
            and torch.isfinite(result.weights).all()
        )


def test_a_pair_without_preference_is_the_same_beside_one_that_has_some() -> None:
    pair, _ = scene(2)
    alike = torch.ones_like(pair.depth_prev)
    mixed = alike.clone()
    mixed[1] = preferring(pair)[1]
    expected = refine_batch(pair, weights=alike)
    result = refine_batch(pair, weights=mixed)
    assert_same(result, [0], expected, [0])
    assert not torch.equal(result.SE3[1].tensor(), expected.SE3[1].tensor())


def test_a_gradient_is_the_same_beside_a_pair_that_takes_more_steps() -> None:
    pair, _ = scene(2)
    flow = pair.flow.clone()
    flow[1] += 30 * torch.randn(
        flow[1].shape, generator=torch.Generator().manual_seed(0), dtype=F64
    )
    found = []
    for count in (1, 2):
        some = {name: x[:count] for name, x in vars(pair).items() if x is not None}
        leaf = flow[:count].clone().requires_grad_()
        result = refine_batch(PairBatch(**{**some, "flow": leaf}))
        total = result.T_curr_prev[0, :3].sum()
        (gradient,) = torch.autograd.grad(total, leaf)
        found.append((result, gradient[0]))
    (alone, expected), (both, gradient) = found
    assert int(both.iterations[1]) != int(alone.iterations[0])
    assert expected.abs().max() > 0
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-12)


def test_weights_and_mask_switch_pixels_off() -> None:
    pair, _ = scene(1, seed=2)
    valid = torch.ones(1, 40, 56, dtype=torch.bool)
    valid[:, :, :20] = False
    by_mask = refine_batch(replace(pair, valid=valid))
    weights = valid.double()
    weights[0, 0, :4] = torch.tensor([math.nan, -1.0, 1e38, math.inf])
    by_weight = refine_batch(pair, weights=weights)
    assert torch.equal(by_mask.T_curr_prev, by_weight.T_curr_prev)
    assert (by_mask.weights[~valid] == 0).all()
    poisoned = pair.flow.clone()
    poisoned[:, :, :20] = math.nan
    by_nan = refine_batch(replace(pair, flow=poisoned))
    assert torch.equal(by_mask.T_curr_prev, by_nan.T_curr_prev)


def test_a_far_sky_on_most_of_the_image_leaves_no_direction_open() -> None:
    pair, T = scene(1)
    depth = pair.depth_prev.clone()
    depth[:, :25] = 3e4
    flow = reproject(depth, T, pair.K_prev, pair.K_curr)[0] - pixel_grid(
        40, 56, pair.K_prev
    )
    sky = replace(pair, depth_prev=depth, flow=flow)
    assert refine_batch(sky, weights=preferring(sky)).status[0].ok


@pytest.mark.parametrize("count", [0, 3, 6, 23])
def test_too_few_pixels_fail(count: int) -> None:
    pair, _ = scene(2)
    depth = pair.depth_prev.clone()
    keep = torch.zeros(40 * 56, dtype=torch.bool)
    keep[torch.arange(count) * 90] = True
    depth[0, ~keep.reshape(40, 56)] = math.nan
    result = refine_batch(replace(pair, depth_prev=depth))
    assert result.failed.tolist() == [True, False]
    assert result.status[0].reason is Reason.NO_VALID_DEPTH
    assert torch.equal(result.T_curr_prev[0], torch.eye(4, dtype=F64))
    assert result.covariance[0].diagonal().tolist() == [1e4] * 3 + [10.0] * 3


@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_with_the_noise_handed_in(kernel: str) -> None:
    pair, T = scene(2, seed=5, outliers=0.0)
    result = refine_batch(pair, noise=(0.3, 0.02), kernel=kernel)
    assert result.converged.all()
    assert (result.T_curr_prev - T).abs().max() < 0.02
    assert result.noise.numpy() == pytest.approx(np.array([[0.3, 0.02]] * 2))


def test_outside_autocast_and_half_input() -> None:
    pair, _ = scene(2, dtype=torch.float32)
    expected = refine_batch(pair)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        flow = pair.flow.clone().requires_grad_()
        result = refine_batch(replace(pair, flow=flow))
        result.T_curr_prev.sum().backward()
    # tight against loose
    assert (result.T_curr_prev - expected.T_curr_prev).abs().max() < 1e-4
    assert flow.grad is not None and torch.isfinite(flow.grad).all()
    half = PairBatch(
        pair.flow.half(), pair.depth_prev.half(), pair.K_prev, pair.K_curr
    )
    assert refine_batch(half).T_curr_prev.dtype == torch.float32


@pytest.mark.parametrize(
    ("name", "seed"), [("moving30", 3), ("noisy", 3), ("low_noise", 4)]
)
def test_both_backends_give_the_same_motion(name: str, seed: int) -> None:
    """From the same start under the same weights, and under the same noise as well."""
    pair, truth = make_pair(name, seed, 218, 512)
    T = truth["T_curr_prev"]
    cameras = pair.prev.camera, pair.curr.camera
    apart = np.linalg.norm(
        pair.flow - ego_flow(pair.prev.depth, T, *cameras), axis=2
    )
    weights = np.where(apart < 5, 1.0, 1e-3).astype(np.float32)
    start = se3_exp(np.array([0.02, -0.01, 0.02, 2e-3, 3e-3, -1e-3])) @ T
    numba = refine(pair, start, weights)
    batch, given = (
        PairBatch.from_pairs([pair]),
        (numba.residual_scale_px, numba.depth_noise),
    )
    # with the noise handed in torch takes other last steps, with the curvature of other pixels;
    # without, only the start differs
    for noise, sigmas, part in ((given, 0.04, 0.25), (None, 0.01, 0.002)):
        found = refine_batch(
            batch, start[None], torch.as_tensor(weights)[None], noise=noise
        ).one(0)
        gap = se3_log(found.T_curr_prev @ invert(numba.T_curr_prev))
        assert np.sqrt(gap @ np.linalg.solve(numba.covariance, gap)) < sigmas
        np.testing.assert_allclose(
            np.diag(found.covariance), np.diag(numba.covariance), rtol=part
        )
        assert found.status.state is numba.status.state is State.OK


@pytest.mark.gpu
def test_same_on_cuda() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    pair, _ = scene(3)
    moved = PairBatch(
        *(v.cuda() for v in (pair.flow, pair.depth_prev, pair.K_prev, pair.K_curr))
    )
    flow = moved.flow.requires_grad_()
    result = refine_batch(replace(moved, flow=flow))
    expected = refine_batch(replace(pair, flow=pair.flow.clone().requires_grad_()))
    assert (result.T_curr_prev.cpu() - expected.T_curr_prev).abs().max() < 1e-8
    result.T_curr_prev.sum().backward()
    assert flow.grad is not None and torch.isfinite(flow.grad).all()


# --- what a batch may claim -----------------------------------------------------------------------


def test_without_weights_a_batch_claims_nothing() -> None:
    """It does not search: half of the image moves, and it would be sure of the wrong motion."""
    pair, T = scene(2)
    for how in ({}, {"T_init": T}, {"weights": torch.ones_like(pair.depth_prev)}):
        result = refine_batch(pair, **how)
        assert not result.failed.any() and torch.isnan(result.probability).all()
        for k, status in enumerate(result.status):
            assert (
                status.state is State.DEGRADED
                and status.reason is Reason.AMBIGUOUS_MOTION
            )
            assert (
                "does not search" in status.message
                and "hybridvo.select" in status.message
            )
            assert math.isnan(result.one(k).probability)
    assert all(
        status.ok for status in refine_batch(pair, weights=preferring(pair)).status
    )


HALL = (
    (0.0, 0, 1, 12),
    (0.3, 0, 1, 9),
    (0, 1, 0.1, 1),
    (-1, 0, 0.3, 2),
    (0, -1, 0.2, 1.5),
)
"""Walls at 2 to 12 m, metres: shuffled depth of a narrow room would still be the room's."""
WRONG_DEPTHS = {
    "millimetres": lambda depth: 1000 * depth,
    "twice": lambda depth: 2 * depth,
    "constant": lambda depth: 0 * depth + 1000,
    "shuffled": lambda depth: depth.flatten()[
        torch.randperm(depth.numel())
    ].view_as(depth),
}


@pytest.mark.parametrize("name", ["depth_prev", "depth_curr"])
@pytest.mark.parametrize("change", WRONG_DEPTHS.values(), ids=WRONG_DEPTHS)
def test_two_depths_that_differ_are_never_ok(name: str, change) -> None:
    torch.manual_seed(0)
    pair = PairBatch.from_pairs([worlds.world(walls=HALL)[0]] * 2)
    right = refine_batch(pair, weights=preferring(pair))
    assert all(status.ok for status in right.status)
    depth = getattr(pair, name).clone()
    depth[1] = change(depth[1])
    result = refine_batch(replace(pair, **{name: depth}), weights=preferring(pair))
    assert result.status[0].ok and not result.status[1].ok
    assert result.status[1].message
    off = RefineOptions(current_depth="off")
    kept = refine_batch(
        replace(pair, depth_curr=depth), weights=preferring(pair), options=off
    )
    assert kept.status[1].ok


def test_a_covariance_is_positive_definite_or_the_sample_failed() -> None:
    """An exact room, whose rotation is known 1e5 times as well as the length of the motion."""
    single, _ = worlds.world()
    changed = replace(
        single, curr=replace(single.curr, depth=1.3 * single.curr.depth)
    )
    batch = PairBatch.from_pairs([changed])
    result = refine_batch(batch, weights=preferring(batch))
    assert (
        not result.failed.any()
        and torch.linalg.eigvalsh(result.covariance)[0, 0] > 0
    )
    # single precision would leave nothing of the smallest eigenvalue but rounding
    eigenvalues = torch.linalg.eigvalsh(result.covariance)[0]
    assert eigenvalues[0] < 1e-7 * eigenvalues[-1]
    found = MotionCovariance({"all": np.eye(6)}, np.ones(6), 40)
    assert checked(found, np.eye(4)).tiles == 40
    open_one = found.of_seed(np.diag([1.0, 1, 1, 1, 1, -1e-9]))
    assert checked(open_one, np.eye(4)).tiles == 0


def test_the_length_is_as_uncertain_as_the_depths_differ() -> None:
    """As of a single pair: a quarter of the length, where they differ by a factor of 1.3."""
    single, _ = worlds.world()
    curr = replace(single.curr, depth=1.3 * single.curr.depth)
    changed = replace(single, curr=curr)
    one = refine(changed, np.eye(4))
    batch = PairBatch.from_pairs([changed])
    found = refine_batch(batch, np.eye(4)[None], preferring(batch)).one(0)
    assert found.status.reason is one.status.reason is Reason.NO_VALID_DEPTH
    t = found.T_curr_prev[:3, 3]
    along = t @ found.covariance[:3, :3] @ t / (t @ t)
    assert np.sqrt(along) == pytest.approx(
        math.log(1.3) * np.linalg.norm(t), rel=0.02
    )
    np.testing.assert_allclose(
        found.covariance, one.covariance, rtol=0.05, atol=1e-9
    )
