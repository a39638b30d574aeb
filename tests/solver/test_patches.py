"""The poses of patches by their own equations, their covariance, and what they fuse to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import hybridvo as hvo
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow_error, se3_exp, se3_log
from hybridvo.core.results import Reason
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.solver.torch.patches import PatchPoses, patch_poses
from hybridvo_lab.synthetic.noise_scenarios import make_pair
from tests import worlds

NOISE = (0.3, 0.005)
SIZE = (120, 160)
TENSORS = (
    "at",
    "xi",
    "information",
    "covariance",
    "uncertainty_px",
    "share",
    "agreement",
)


def static_world(seed: int = 0) -> tuple[FramePair, np.ndarray]:
    return worlds.world(
        SIZE, seed=seed, noise=NOISE, texture=False, second_depth=False
    )


def patches_of(pair: FramePair, T: np.ndarray, weights=None) -> PatchPoses:
    batch = PairBatch.from_pairs([pair], dtype=torch.float64)
    return patch_poses(batch, torch.from_numpy(T)[None], weights, NOISES)


NOISES = torch.tensor([NOISE], dtype=torch.float64)


def error_px(pair: FramePair, T: torch.Tensor, T_true: np.ndarray) -> float:
    cameras = (pair.prev.camera, pair.curr.camera)
    return ego_flow_error(T[0].numpy(), T_true, pair.prev.depth, *cameras)


def moving_third() -> tuple[FramePair, np.ndarray, torch.Tensor]:
    """A world of which a third moves by 3 px, and P(static)."""
    pair, T = static_world()
    flow = np.array(pair.flow)
    columns = flow.shape[1] // 3
    flow[:, :columns, 0] += 3
    weights = torch.ones(1, *SIZE, dtype=torch.float64)
    weights[..., :columns] = 0.01
    return replace(pair, flow=flow), T, weights


def test_patches_bring_a_start_that_is_off_to_the_truth() -> None:
    pair, T = static_world()
    start = se3_exp(np.array([0.01, -0.02, 0.01, 0.002, 0.001, -0.002])) @ T
    patches = patches_of(pair, start)
    assert error_px(pair, torch.from_numpy(start)[None], T) > 0.3
    assert error_px(pair, patches.fused.T_curr_prev, T) < 0.05
    rows, columns = patches.grid
    assert patches.xi.shape == (1, rows * columns, 6)
    assert float(patches.share.sum()) == pytest.approx(1)
    torch.testing.assert_close(
        patches.at, patches.fused.T_curr_prev, rtol=0, atol=1e-4
    )


def test_a_covariance_holds_the_error_of_what_it_is_stated_for() -> None:
    """Mean squared distances per direction: of patches about 1, of the fused pose not above."""
    fused = []
    own = []
    for seed in range(6):
        pair, T = static_world(seed)
        patches = patches_of(pair, T)
        error = se3_log(T @ np.linalg.inv(patches.fused.T_curr_prev[0].numpy()))
        C = patches.fused.covariance[0].numpy()
        fused.append(error @ np.linalg.solve(C, error) / 6)
        xi = patches.xi[0].numpy()
        information = patches.information[0].numpy()
        own.append(np.einsum("pi,pij,pj->p", xi, information, xi) / 6)
    assert np.mean(fused) < 1.5
    # the errors of the pixels here are independent, and the patches allow for shared ones
    assert 0.001 < np.median(own) < 1.5


def test_what_a_patch_cannot_know_it_states_as_uncertain() -> None:
    pair, T = static_world()
    depth = np.array(pair.prev.depth)
    depth[:, : SIZE[1] // 2] = np.nan
    half = replace(pair, prev=replace(pair.prev, depth=depth))
    patches = patches_of(half, T)
    rows, columns = patches.grid
    share = patches.share[0].reshape(rows, columns)
    uncertain = patches.uncertainty_px[0].reshape(rows, columns)
    assert (share[:, : columns // 2 - 1] == 0).all()
    assert (
        patches.xi[0].reshape(rows, columns, 6)[:, : columns // 2 - 1] == 0
    ).all()
    assert uncertain[:, : columns // 2 - 1].min() > 5 * uncertain[:, -2].max()
    assert error_px(pair, patches.fused.T_curr_prev, T) < 0.05


def test_uncertain_pixels_and_disagreeing_patches_hardly_count() -> None:
    pair, T, weights = moving_third()
    weighed = patches_of(pair, T, weights)
    assert error_px(pair, weighed.fused.T_curr_prev, T) < 0.05
    # without P(static), the patches of what moves agree with no other
    plain = patches_of(pair, T)
    rows, columns = plain.grid
    agreement = plain.agreement[0].reshape(rows, columns)
    assert agreement[:, 0].max() < 0.5 * agreement[:, -1].min()
    assert error_px(pair, plain.fused.T_curr_prev, T) < 0.3


def test_a_pair_of_a_batch_is_as_alone_and_one_without_data_stays() -> None:
    pair, T = static_world()
    blind = replace(pair, flow=np.full_like(pair.flow, np.nan))
    other, _ = static_world(1)
    batch = PairBatch.from_pairs([pair, blind, other], dtype=torch.float64)
    starts = torch.from_numpy(T)[None].repeat(3, 1, 1)
    together = patch_poses(batch, starts, None, NOISES.repeat(3, 1))
    alone = patches_of(pair, T)
    for name in TENSORS:
        value = getattr(together, name)
        assert torch.isfinite(value).all(), name
        torch.testing.assert_close(value[:1], getattr(alone, name))
    torch.testing.assert_close(together.fused.T_curr_prev[1], starts[1])
    assert (together.share[1] == 0).all()
    # nothing is known: several pixels of the image
    assert together.uncertainty_px[1].min() == 0 or together.covariance[1].min() < 1
    assert together.fused.covariance[1, 3, 3] > 0.04**2


def test_gradients_are_those_of_differences() -> None:
    fused, values = differentiable()
    leaves = [x.clone().requires_grad_() for x in values]
    assert torch.autograd.gradcheck(
        fused, leaves, eps=1e-6, atol=1e-3, fast_mode=True
    )


def test_pixels_that_do_not_count_have_a_finite_gradient() -> None:
    fused, (flow, depth, weights, noise) = differentiable()
    weights = weights.clone()
    weights[0, 3, 5] = 0
    depth = depth.clone()
    depth[0, 7, 8] = 0
    leaves = [x.clone().requires_grad_() for x in (flow, depth, weights, noise)]
    total = sum(x.sum() for x in fused(*leaves))
    gradients = torch.autograd.grad(total, leaves)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert gradients[0][0, 3, 5].abs().max() == 0
    assert gradients[1][0, 7, 8] == 0


def differentiable():
    """Poses and covariances of the patches of a small pair, of its flow, depth, weights, noise."""
    pair, truth = make_pair("moving30", 3, 24, 32)
    batch = PairBatch.from_pairs([pair], dtype=torch.float64)
    T = torch.from_numpy(np.asarray(truth["T_curr_prev"], float))[None]
    rng = torch.Generator().manual_seed(0)
    weights = torch.rand(1, 24, 32, generator=rng, dtype=torch.float64) + 0.1
    depth = torch.nan_to_num(batch.depth_prev, 1.0)

    def fused(flow, depth, weights, noise):
        changed = PairBatch(flow, depth, batch.K_prev, batch.K_curr)
        patches = patch_poses(changed, T, weights, noise)
        found = patches.fused
        xi = patches.xi / patches.covariance.diagonal(dim1=2, dim2=3).sqrt()
        return 1e2 * found.T_curr_prev[:, :3], 1e2 * xi, 1e4 * found.covariance

    return fused, (batch.flow, depth, weights, NOISES)


# --- what refines from it ---------------------------------------------------------


@pytest.fixture(scope="module")
def predicted():
    pairs = [make_pair("moving50", seed, *SIZE) for seed in (510, 511)]
    batch = PairBatch.from_pairs([pair for pair, _ in pairs])
    with torch.no_grad():
        return pairs, batch, hvo.PWVO.from_pretrained()(batch)


def test_a_seed_carries_the_covariance_of_its_patches_into_refine(
    predicted,
) -> None:
    _, batch, maps = predicted
    seed = hvo.select(maps)
    torch.testing.assert_close(seed.covariance, maps.patches.fused.covariance)
    carried = hvo.refine(batch, seed)
    # a copy of the pose is as good as the pose
    copied = hvo.refine(batch, seed._replace(T_curr_prev=seed.T_curr_prev.clone()))
    assert torch.equal(carried.T_curr_prev, copied.T_curr_prev)
    assert torch.equal(carried.probability, copied.probability)
    # a part of the seed is the seed of a part
    second = hvo.PairBatch.from_pairs([predicted[0][1][0]])
    alone = hvo.refine(second, seed.part(slice(1, None)))
    torch.testing.assert_close(alone.T_curr_prev, carried.T_curr_prev[1:])
    torch.testing.assert_close(alone.probability, carried.probability[1:])
    with pytest.raises(InputError, match="weights once"):
        hvo.refine(batch, seed, seed.weights)


def test_every_selection_of_patches_has_a_name(predicted) -> None:
    pairs, _, maps = predicted
    errors = {}
    for method in ("fused", "surest", "patch_mean"):
        seed = hvo.select(maps, method)
        chosen = getattr(maps.patches, method)
        torch.testing.assert_close(seed.T_curr_prev, chosen.T_curr_prev.float())
        errors[method] = sum(
            np.abs(seed.T_curr_prev[k].numpy() - truth["T_curr_prev"]).max()
            for k, (_, truth) in enumerate(pairs)
        )
    assert errors["fused"] < min(errors["surest"], errors["patch_mean"])
    with pytest.raises(InputError, match="patches"):
        hvo.select(replace(maps, patches=None), "fused")


def test_a_solution_outside_of_the_region_leaves_the_seed_and_says_so() -> None:
    pair, T = static_world()
    batch = PairBatch.from_pairs([pair])
    seed = se3_exp(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0])) @ T
    sure = torch.from_numpy(np.diag([1e-3**2] * 3 + [1e-4**2] * 3))[None]
    weights = torch.rand(1, *SIZE, generator=torch.Generator().manual_seed(0))
    start = torch.from_numpy(seed)[None]
    found = hvo.refine(batch, hvo.PoseSeed(start, weights + 0.5, covariance=sure))
    assert found.status[0].reason is Reason.SOLVER_DIVERGED
    assert "seed" in found.status[0].message
    np.testing.assert_allclose(found.T_curr_prev[0].numpy(), seed, atol=1e-6)
    # it may be wrong by as much as the solution is away
    away = se3_log(T @ np.linalg.inv(seed))
    C = found.covariance[0].numpy()
    assert away @ np.linalg.solve(C, away) / 6 < 2
    free = hvo.refine(
        batch, hvo.PoseSeed(start, weights + 0.5, covariance=1e4 * sure)
    )
    np.testing.assert_allclose(free.T_curr_prev[0].numpy(), T, atol=3e-3)
