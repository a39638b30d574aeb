"""The selector network: what it sees, that pairs stay apart, refits."""

from __future__ import annotations

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import torch

from hybridvo.api import refine
from hybridvo.geometry import pixel_grid, se3_exp
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.network.grid_maps import grid_maps
from hybridvo.network.selector_inputs import (
    SelectorInputs,
    candidate_channels,
    selector_inputs,
)
from hybridvo.network.selector_net import SelectorNetwork
from hybridvo.options import Options
from hybridvo.synthetic.noise_scenarios import Scenario, make_pair
from hybridvo.types import Camera, Frame, FramePair

CELL = Scenario(moving=0.6, objects=1, flow_noise_px=0.3, depth_noise=0.01)
SIZE = {"height": 96, "width": 224}


@pytest.fixture(scope="module")
def network() -> SelectorNetwork:
    torch.manual_seed(3)
    made = SelectorNetwork()
    # the last layer starts at zero; a selector that says something is wanted here
    torch.nn.init.normal_(made.score.weight, std=0.3)
    return made.eval()


def search(seed: int, **cell: object) -> tuple[HypothesisSet, object, dict]:
    pair, truth = make_pair(replace(CELL, **cell), seed, **SIZE)
    found = generate(pair, np.eye(4)[None], Options())
    assert len(found.motions) > 1
    return found, pair, truth


def inputs_of(seed: int) -> SelectorInputs:
    return asked(search(seed)[0])


def asked(found: HypothesisSet) -> SelectorInputs:
    image = selector_inputs(grid_maps(found), None, None, torch.device("cpu"))
    noise = np.array([motion.stats.noise for motion in found.motions])
    return image.with_candidates(found.poses, noise, np.arange(len(noise)))


def together(parts: list[SelectorInputs]) -> SelectorInputs:
    values = {
        f.name: torch.cat([getattr(p, f.name) for p in parts])
        for f in fields(SelectorInputs)
    }
    counts = [len(p.owner) for p in parts]
    values["owner"] = torch.repeat_interleave(
        torch.arange(len(parts)), torch.tensor(counts)
    )
    values["parent"] = torch.arange(sum(counts))
    return SelectorInputs(**values)


def test_support_is_that_of_the_solver(network: SelectorNetwork) -> None:
    # the same robust weight, from torch formulas of their own and from the solver's kernel
    found, pair, _ = search(1)
    answer = refine(pair)
    seen = network(inputs_of(1)).evidence[:, 0].detach().numpy()
    for hypothesis in answer.hypotheses:
        errors = [np.abs(s - hypothesis.inliers).max() for s in seen]
        # float32 residuals of 0.3 px noise: a hundredth of a standard deviation
        assert min(errors) < 0.02
    assert found.grid.count == seen[0].size


def test_images_do_not_see_each_other(network: SelectorNetwork) -> None:
    parts = [inputs_of(seed) for seed in (1, 2)]
    broken = replace(parts[1], depth=torch.full_like(parts[1].depth, torch.nan))
    with torch.no_grad():
        alone = network(parts[0])
        for other in (parts[1], broken):
            both = network(together([parts[0], other]))
            n = len(parts[0].owner)
            # another batch size may sum in another order
            torch.testing.assert_close(
                both.score[:n], alone.score, atol=1e-4, rtol=1e-4
            )
            torch.testing.assert_close(
                both.mask[:n], alone.mask, atol=1e-3, rtol=1e-3
            )


def test_holes_and_unknown_depths_give_finite_answers(
    network: SelectorNetwork,
) -> None:
    inputs = inputs_of(1)
    usable = inputs.usable.clone()
    usable[:, :20] = False
    nothing = torch.zeros_like(usable)
    unknown = torch.full_like(inputs.log_depth_at_target, torch.nan)
    with torch.no_grad():
        for mask in (usable, nothing):
            out = network(replace(inputs, usable=mask, log_depth_at_target=unknown))
            assert (
                torch.isfinite(out.score).all() and torch.isfinite(out.mask).all()
            )
            assert (
                out.evidence[:, 0][~mask.expand_as(out.evidence[:, 0])] == 0
            ).all()


def test_refits_share_what_the_search_has_seen(network: SelectorNetwork) -> None:
    # a refit equal to its parent is seen as the parent, but for the flag that it is a refit
    inputs = inputs_of(1)
    with torch.no_grad():
        first = network(inputs)
        again = network(inputs, (inputs, first))
        seen = [
            candidate_channels(inputs, x)[0]
            for x in (None, (inputs, first.evidence))
        ]
    torch.testing.assert_close(*seen)
    assert (first.score - again.score).abs().max() > 1e-6


def test_what_was_expected_is_weighed_by_its_covariance() -> None:
    inputs = inputs_of(1)
    sigma = torch.tensor([0.1, 0.2, 0.4, 0.01, 0.02, 0.04])
    # one standard deviation on three axes
    delta = np.array([0.1, 0.0, 0.4, 0.0, 0.02, 0.0])
    pose = torch.as_tensor(se3_exp(delta)[None, :3], dtype=torch.float32)
    told = replace(
        inputs,
        T_prior=torch.eye(4)[None, :3],
        has_prior=torch.tensor([True]),
        prior_information=torch.diag(1 / sigma**2)[None],
        pose=pose.expand(len(inputs.owner), 3, 4),
    )
    _, scalars, _ = candidate_channels(told, None)
    # three of six: 1 / (1 + 3 / 6). First order leaves half of 0.02 rad x 0.4 m, 0.04 of 0.1 m:
    # 0.08 in the square, 0.006 here
    torch.testing.assert_close(
        scalars[0, 4], torch.tensor(2 / 3), atol=7e-3, rtol=0
    )
    assert scalars[0, 5] == 1
    far = replace(told, prior_information=1e12 * told.prior_information)
    _, scalars, _ = candidate_channels(far, None)
    # a prior that is sure of itself says a bounded amount
    assert torch.isfinite(scalars).all() and scalars.abs().max() < 5
    _, unknown, _ = candidate_channels(inputs, None)
    assert (unknown[:, 4:8] == 0).all()


def test_a_prior_of_usual_changes_where_none_is_told() -> None:
    inputs = inputs_of(1)
    # 0.01 rad, and as much of the typical depth: its reciprocal is the mean of the reciprocals
    near = (1 / inputs.depth[inputs.usable]).mean()
    root = inputs.prior_information[0].diagonal().sqrt()
    torch.testing.assert_close(root, torch.tensor([near / 0.01] * 3 + [100.0] * 3))


def textured_pair(T: np.ndarray, depth_m: float = 2.0) -> FramePair:
    """A textured wall seen from two places, without any flow to speak of."""
    rng = np.random.default_rng(0)
    camera = Camera(120.0, 120.0, 79.5, 59.5, 120, 160)
    wall = cv2.GaussianBlur(
        rng.uniform(0, 255, (360, 480)).astype(np.float32), (0, 0), 4
    )
    wall = 128 + 8 * (wall - wall.mean())
    depth = np.full(camera.shape, depth_m, np.float32)
    uv = pixel_grid(*camera.shape)
    frames = []
    for pose in (np.eye(4), T):
        # the wall moves by ``pose``: a shift of a fronto-parallel plane
        shift = 120.0 * pose[:2, 3] / depth_m
        u, v = (uv[..., 0] - shift[0] + 160), (uv[..., 1] - shift[1] + 120)
        grey = cv2.remap(
            wall, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR
        )
        rgb = np.clip(grey, 0, 255).astype(np.uint8)[..., None].repeat(3, 2)
        frames.append(Frame(rgb, depth, camera))
    flow = np.zeros((*camera.shape, 2), np.float32)
    return FramePair(*frames, flow, None, np.ones(camera.shape, np.bool_))


def test_images_and_depth_tell_motions_apart_where_there_is_no_flow() -> None:
    T = np.eye(4)
    T[0, 3] = 0.2  # 12 px
    pair = textured_pair(T)
    found = generate(pair, np.eye(4)[None], Options())
    maps = replace(
        grid_maps(found), usable=np.zeros(found.grid.shape[:2], np.bool_)
    )
    image = selector_inputs(maps, None, None, torch.device("cpu"))
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[2, 3] = -0.6, 0.6
    poses = np.stack([T, np.eye(4), near, far])[:, :3]
    inputs = image.with_candidates(poses, np.ones((4, 2)), np.arange(4))
    channels, _, evidence = candidate_channels(inputs, None)
    middle = (slice(None), slice(10, -10), slice(20, -20))
    seen = evidence[:, 1][middle].mean((1, 2))
    assert seen[0] > 0.6 and seen[1] < 0.5 * seen[0]
    assert (channels[:, :8] == 0).all()
    gap, known = channels[:, 13][middle], channels[:, 12][middle]
    assert (known[0] == 1).all() and gap[0].abs().max() < 1e-3
    # a point that comes nearer should hide the wall; one that goes away is hidden by it
    assert (gap[2] > 0.1).all() and (gap[3][known[3] > 0] < -0.1).all()
    blank = replace(image, image_prev=torch.full_like(image.image_prev, 90.0))
    nothing = candidate_channels(
        blank.with_candidates(poses, np.ones((4, 2)), np.arange(4)), None
    )[2]
    assert nothing[:, 1].abs().max() < 1e-3
