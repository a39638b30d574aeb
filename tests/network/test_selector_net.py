"""The selector network: what it sees, that pairs stay apart, refits."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from hybridvo.estimation import refine
from hybridvo.geometry import se3_exp
from hybridvo.hypotheses.generate import HypothesisSet, generate
from hybridvo.hypotheses.selector import _searched
from hybridvo.network.selector_inputs import (
    SelectorInputs,
    candidate_channels,
    prior_information_of,
    selector_inputs,
)
from hybridvo.network.selector_net import SelectorNetwork
from hybridvo.options import Options
from hybridvo.synthetic.scenarios import Scenario, make_pair

CELL = Scenario(moving=0.6, objects=1, flow_noise_px=0.3, depth_noise=0.01)
SIZE = {"height": 96, "width": 224}


@pytest.fixture(scope="module")
def network() -> SelectorNetwork:
    torch.manual_seed(3)
    made = SelectorNetwork()
    # the last layers start at zero; a selector that says something is wanted here
    for layer in (made.score, made.trust):
        torch.nn.init.normal_(layer.weight, std=0.3)
    return made.eval()


def search(seed: int, **cell: object) -> tuple[HypothesisSet, object, dict]:
    pair, truth = make_pair(replace(CELL, **cell), seed, **SIZE)
    found = generate(pair, np.eye(4)[None], Options())
    assert isinstance(found, HypothesisSet) and len(found.poses) > 1
    return found, pair, truth


def inputs_of(seed: int) -> SelectorInputs:
    found, _, _ = search(seed)
    everything = slice(None)
    return selector_inputs(
        found.maps(), _searched(found), everything, None, None, torch.device("cpu")
    )


def together(parts: list[SelectorInputs]) -> SelectorInputs:
    values = {
        f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(SelectorInputs)
    }
    counts = [len(p.owner) for p in parts]
    values["owner"] = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor(counts))
    values["parent"] = torch.arange(sum(counts))
    return SelectorInputs(**values)


def test_support_is_that_of_the_solver(network: SelectorNetwork) -> None:
    # the same robust weight, from torch formulas of their own and from the solver's kernel
    found, pair, _ = search(1)
    answer = refine(pair)
    seen = network.encode(inputs_of(1)).support.detach().numpy()
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
            torch.testing.assert_close(both.score[:n], alone.score, atol=1e-4, rtol=1e-4)
            torch.testing.assert_close(both.mask[:n], alone.mask, atol=1e-3, rtol=1e-3)


def test_holes_and_unknown_depths_give_finite_answers(network: SelectorNetwork) -> None:
    inputs = inputs_of(1)
    usable = inputs.usable.clone()
    usable[:, :20] = False
    nothing = torch.zeros_like(usable)
    unknown = torch.full_like(inputs.log_depth_curr, torch.nan)
    with torch.no_grad():
        for mask in (usable, nothing):
            out = network(replace(inputs, usable=mask, log_depth_curr=unknown))
            assert torch.isfinite(out.score).all() and torch.isfinite(out.mask).all()
            assert (out.support[~mask.expand_as(out.support)] == 0).all()


def test_refits_share_what_the_search_has_seen(network: SelectorNetwork) -> None:
    # a refit equal to its parent is seen as the parent, but for the flag that it is a refit
    inputs = inputs_of(1)
    with torch.no_grad():
        first = network.encode(inputs)
        again = network.encode(inputs, (inputs, first))
        anew = network.encode(inputs, (inputs, network(inputs)))
    torch.testing.assert_close(first.levels[0], again.levels[0])
    torch.testing.assert_close(again.score, anew.score)
    assert (first.score - again.score).abs().max() > 1e-6


def test_what_was_expected_is_weighed_by_its_covariance() -> None:
    inputs = inputs_of(1)
    sigma = torch.tensor([0.1, 0.2, 0.4, 0.01, 0.02, 0.04])
    delta = np.array([0.1, 0.0, 0.4, 0.0, 0.02, 0.0])  # one standard deviation on three axes
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
    torch.testing.assert_close(scalars[0, 4], torch.tensor(2 / 3), atol=7e-3, rtol=0)
    assert scalars[0, 5] == 1
    far = replace(told, prior_information=1e12 * told.prior_information)
    _, scalars, _ = candidate_channels(far, None)
    # a prior that is sure of itself says a bounded amount
    assert torch.isfinite(scalars).all() and scalars.abs().max() < 5
    _, unknown, _ = candidate_channels(inputs, None)
    assert (unknown[:, 4:] == 0).all()


def test_a_covariance_that_is_none_counts_as_unknown() -> None:
    inputs = inputs_of(1)
    usual = prior_information_of(inputs.depth, inputs.usable, None)
    for broken in (torch.zeros(1, 6, 6), torch.full((1, 6, 6), torch.nan)):
        told = prior_information_of(inputs.depth, inputs.usable, broken)
        torch.testing.assert_close(told, usual)
    exact = prior_information_of(
        inputs.depth, inputs.usable, torch.diag(torch.tensor([4.0] * 3 + [0.25] * 3))[None]
    )
    torch.testing.assert_close(exact[0].diagonal(), torch.tensor([0.25] * 3 + [4.0] * 3))
    # 0.01 rad, and as much of the typical depth: its reciprocal is the mean of the reciprocals
    near = (1 / inputs.depth[inputs.usable]).mean()
    torch.testing.assert_close(usual[0, 0, 0].sqrt(), near / 0.01)
    torch.testing.assert_close(usual[0, 5, 5].sqrt(), torch.tensor(100.0))
