"""Losses of refined motions: their gradient is that of the fit, and reaches what decides it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from hybridvo.hypotheses.refit import mask_weights
from hybridvo.lab.training.options import PWVOTrainingOptions
from hybridvo.lab.training.pwvo_task import (
    HypothesisBatch,
    PWVOTask,
    TwoLooks,
    ego_flow_error,
    outcome_loss,
    read_batches,
)
from hybridvo.lab.training.refined_motions import (
    Fits,
    RefinedMotions,
    fit_all,
    refine_in_masks,
    weights_of,
)
from hybridvo.network.pwvo import PWVOOptions

SMALL = PWVOTrainingOptions(network=PWVOOptions(width=0.25))
OF_THE_POSE = ("head_motion.", "head_uncertainty.")
"""Heads of maps that say where a fit starts: what it finds does not depend on them."""
TO_REST = 40
"""Gauss-Newton steps after which a difference of two fits is exact enough."""


@pytest.fixture(scope="module")
def batch(shards: Path) -> HypothesisBatch:
    files = sorted(shards.glob("*.npz"))
    largest = max(read_batches(files, 4, np.random.default_rng(0)), key=len)
    return largest.part(range(2))


@pytest.fixture(scope="module")
def weights(batch: HypothesisBatch) -> torch.Tensor:
    """(N, h, w) of pixels that are more or less static."""
    draw = torch.Generator().manual_seed(0)
    shape = (len(batch.inputs.owner), *batch.label.shape[1:])
    return 0.1 + 0.8 * torch.rand(shape, generator=draw, dtype=torch.float64)


@pytest.fixture(scope="module")
def fits(batch: HypothesisBatch, weights: torch.Tensor) -> Fits:
    starts = batch.inputs.pose.double().numpy()
    return fit_all(batch.inputs, batch.samples, weights, starts)


def task_with_open_heads(options: PWVOTrainingOptions) -> PWVOTask:
    """A task whose last layers, which begin at zero, pass a gradient on."""
    torch.manual_seed(0)
    task = PWVOTask(options, Path())
    for layer in task.network.modules():
        if hasattr(layer, "weight") and not layer.weight.any():
            torch.nn.init.normal_(layer.weight, std=0.1)
    return task


def test_weights_are_those_of_the_product() -> None:
    logit = torch.linspace(-4, 4, 50)
    expected = mask_weights(torch.sigmoid(logit).numpy())
    np.testing.assert_allclose(weights_of(logit).numpy(), expected, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "value",
    [
        lambda refined: refined.cost,
        lambda refined: refined.pose[:, 0, 3],
        lambda refined: refined.pose[:, 1, 2],
    ],
    ids=["cost", "translation", "rotation"],
)
def test_the_gradient_is_that_of_the_fit(
    batch: HypothesisBatch,
    weights: torch.Tensor,
    fits: Fits,
    value: Callable[[RefinedMotions], torch.Tensor],
) -> None:
    """A refined motion changes with its weights as two fits with other weights differ."""
    given = weights.clone().requires_grad_()
    refined = refine_in_masks(batch.inputs, given, fits, TO_REST)
    (slope,) = torch.autograd.grad(value(refined).sum(), given)
    draw = torch.Generator().manual_seed(1)
    change = torch.rand(weights.shape, generator=draw, dtype=torch.float64) - 0.5
    more, less = (
        value(refine_in_masks(batch.inputs, weights + h * change, fits, TO_REST))
        for h in (1e-3, -1e-3)
    )
    expected = (more - less) / 2e-3
    got = (slope * change).flatten(1).sum(dim=1)
    assert expected.abs().max() > 1e-6
    torch.testing.assert_close(
        got, expected, rtol=0.01, atol=1e-3 * float(expected.abs().max())
    )


def test_what_is_known_of_the_pixels_has_a_gradient_too(
    batch: HypothesisBatch, weights: torch.Tensor, fits: Fits
) -> None:
    """The belief of an earlier frame is a factor on the weights."""
    belief = torch.full_like(weights[0], 0.9).requires_grad_()
    refined = refine_in_masks(batch.inputs, weights * belief, fits)
    refined.cost.sum().backward()
    is_used = batch.inputs.usable[batch.inputs.owner].any(dim=0)
    assert torch.isfinite(belief.grad).all()
    assert (belief.grad[is_used] != 0).all() and (belief.grad[~is_used] == 0).all()


def test_a_motion_without_pixels_costs_all_and_has_no_gradient(
    batch: HypothesisBatch, weights: torch.Tensor
) -> None:
    given = weights.clone()
    given[0] = 0
    given.requires_grad_()
    starts = batch.inputs.pose.double().numpy()
    fits = fit_all(batch.inputs, batch.samples, given, starts)
    assert not fits.exists[0] and fits.exists[1:].all()
    refined = refine_in_masks(batch.inputs, given, fits)
    assert float(refined.cost[0].detach()) == 1.0
    torch.testing.assert_close(
        refined.pose[0], batch.inputs.pose[0].double(), rtol=0, atol=1e-6
    )
    (refined.cost.sum() + refined.pose.sum()).backward()
    assert torch.isfinite(given.grad).all()
    assert (given.grad[0] == 0).all() and given.grad[1:].abs().max() > 0


def test_the_losses_reach_the_score_and_the_masks(batch: HypothesisBatch) -> None:
    """Each parameter but those of where a fit starts, by the solver's losses alone."""
    task = task_with_open_heads(SMALL)
    looks = TwoLooks(task.network, batch, torch.arange(len(batch)) % 2 == 0)
    lots = torch.rand(len(batch), 2, generator=torch.Generator().manual_seed(0))
    second = looks.second(2, lots)
    assert second is not None
    choice, error = looks.solver_losses(second[1].parent, 1.0)
    (choice + error).backward()
    for name, parameter in task.network.named_parameters():
        if name.startswith(OF_THE_POSE):
            assert parameter.grad is None or not parameter.grad.any(), name
        else:
            assert torch.isfinite(parameter.grad).all(), name
            assert parameter.grad.abs().max() > 0, name


def test_the_losses_reach_the_weights_of_the_fit_alone(
    batch: HypothesisBatch,
) -> None:
    """A loss of accuracy says nothing of the score: the mask of the fit has to learn."""
    task = task_with_open_heads(SMALL)
    looks = TwoLooks(task.network, batch, torch.zeros(len(batch), dtype=torch.bool))
    _, error = looks.solver_losses(None, 1.0)
    error.backward()
    assert task.network.head_static.weight.grad.abs().max() > 0
    score = task.network.score.weight.grad
    assert score is None or not score.any()


@pytest.mark.slow
def test_learned_weights_make_a_fit_accurate(
    batch: HypothesisBatch,
) -> None:
    """Down the gradient of the error, the refined motions come nearer to the truth."""
    inputs = batch.inputs
    starts = inputs.pose.double().numpy()
    static = torch.full(
        (len(inputs.owner), *batch.label.shape[1:]), 0.6, requires_grad=True
    )
    optimizer = torch.optim.Adam([static], 0.05)
    limit = batch.limit[inputs.owner]
    errors = []
    for _ in range(12):
        weights = weights_of(static)
        fits = fit_all(inputs, batch.samples, weights, starts)
        refined = refine_in_masks(inputs, weights, fits)
        error = ego_flow_error(refined.pose, inputs.owner, batch)
        is_right = error.detach() <= limit
        assert is_right.any()
        errors.append(float(error[is_right].detach().mean()))
        optimizer.zero_grad()
        (error * is_right).sum().backward()
        optimizer.step()
    assert errors[-1] < 0.8 * errors[0]


def test_without_the_option_nothing_of_it_is_computed(
    batch: HypothesisBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TwoLooks, "solver_losses", None)
    task = PWVOTask(SMALL, Path())
    _, parts = task.loss(batch, 0)
    assert not any("solver" in name for name in parts)


def test_the_option_weighs_the_losses(batch: HypothesisBatch) -> None:
    parts = {}
    for weight in (1.0, 3.0):
        torch.manual_seed(0)
        options = dataclasses.replace(SMALL, solver_weight=weight)
        _, parts[weight] = PWVOTask(options, Path()).loss(batch, 0)
    for name in ("solver_choice", "solver_error"):
        assert float(parts[1.0][name]) > 0
        assert float(parts[3.0][name]) == pytest.approx(3 * float(parts[1.0][name]))
    assert torch.equal(parts[1.0]["mask"], parts[3.0]["mask"])


def test_motions_that_lead_to_the_same_one_share_the_choice() -> None:
    """Whichever of them is chosen; what leads elsewhere has to lose."""
    owner = torch.zeros(3, dtype=torch.int64)
    limit = torch.tensor([1.0])

    def loss(score: list[float], error: list[float]) -> float:
        return float(
            outcome_loss(torch.tensor(score), torch.tensor(error), owner, limit)
        )

    same = [0.0, 0.0, 30.0]
    assert loss([8.0, 0.0, -8.0], same) == pytest.approx(
        loss([0.0, 8.0, -8.0], same)
    )
    assert loss([8.0, 0.0, -8.0], same) < 0.05
    assert loss([-8.0, -8.0, 8.0], same) > 5
    # none of them leads to a right motion
    assert loss([-8.0, -8.0, -8.0], [30.0, 30.0, 30.0]) < 0.05
    assert loss([8.0, -8.0, -8.0], [30.0, 30.0, 30.0]) > 5
