"""The motions that may be the camera's: their costs, and the gradient of the choice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import hybridvo as hvo
from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.core.types import Camera
from tests.doors import refuses

SIZE = (20, 28)
CAMERA = Camera(30.0, 30.0, 13.5, 9.5, *SIZE)
NOISE = (0.3, 0.02)
F64 = torch.float64


def two_motions(
    seed: int = 0, fraction: float = 0.4
) -> tuple[hvo.PairBatch, torch.Tensor, torch.Tensor]:
    """Two pairs with a camera and a thing that moves; both motions (2, 2, 4, 4), and its mask."""
    rng = np.random.default_rng(seed)
    pairs = []
    motions = []
    height, width = SIZE
    mask = np.zeros(SIZE, bool)
    mask[:, : int(fraction * width)] = True
    for _ in range(2):
        u = np.arange(width) / 6.0
        v = np.arange(height)[:, None] / 5.0
        depth = 4 + np.sin(u + rng.uniform(0, 6)) + np.cos(v - rng.uniform(0, 6))
        both = [se3_exp(rng.normal(0, [0.15] * 3 + [0.04] * 3)) for _ in range(2)]
        camera_flow, own_flow = (ego_flow(depth, T, CAMERA, CAMERA) for T in both)
        flow = np.where(mask[..., None], own_flow, camera_flow)
        flow = flow + NOISE[0] * rng.normal(size=flow.shape)
        frame = hvo.Frame(None, depth, CAMERA)
        pairs.append(hvo.FramePair(frame, hvo.Frame(None, None, CAMERA), flow))
        motions.append(both)
    batch = hvo.PairBatch.from_pairs(pairs, dtype=F64)
    return batch, torch.tensor(np.array(motions)), torch.tensor(mask)


def static(mask: torch.Tensor) -> torch.Tensor:
    """Weights (2, 2, H, W): what is static if the first, and if the second motion is right."""
    of_camera = torch.where(mask, 0.1, 0.9).double()
    return torch.stack([of_camera, 1 - of_camera]).expand(2, -1, -1, -1)


def test_a_motion_costs_what_it_leaves_unexplained() -> None:
    batch, T, mask = two_motions()
    rivals = hvo.refine_rivals(batch, T, static(mask), noise=NOISE)
    assert not rivals.failed.any()
    # each pixel of its own has weight 0.9 and the mean robust weight of normal errors, 0.84 at c=3
    share = 1 - mask.double().mean()
    expected = torch.stack([1 - 0.9 * 0.84 * share, 1 - 0.9 * 0.84 * (1 - share)])
    assert (rivals.cost - expected).abs().max() < 0.05
    assert (rivals.T_curr_prev - T).abs().max() < 0.05
    # nothing is won by leaving pixels out
    fewer = static(mask) * 0.1
    assert (
        hvo.refine_rivals(batch, T, fewer, noise=NOISE).cost > rivals.cost
    ).all()


def test_rivals_are_measured_by_one_noise() -> None:
    """By that of the motion that most pixels follow, whatever a worse one would call noise."""
    batch, T, mask = two_motions(fraction=0.25)
    rivals = hvo.refine_rivals(batch, T, static(mask))
    own = rivals.motions.noise.unflatten(0, (2, 2))
    assert torch.equal(rivals.noise, own[:, 0])
    assert (rivals.cost[:, 0] < rivals.cost[:, 1]).all()


def test_a_rival_that_is_not_there_has_no_probability_and_no_gradient() -> None:
    batch, T, mask = two_motions()
    alone = hvo.refine_rivals(batch, T[:, :1], static(mask)[:, :1], noise=NOISE)
    padded = T.clone()
    padded[1, 1] = torch.nan
    weights = static(mask).clone().requires_grad_()
    rivals = hvo.refine_rivals(batch, padded, weights, noise=NOISE)
    assert rivals.exists.tolist() == [[True, True], [True, False]]
    assert rivals.failed.tolist() == [[False, False], [False, True]]
    assert torch.allclose(rivals.cost[:, 0], alone.cost[:, 0])
    score = torch.zeros(2, 2, dtype=F64, requires_grad=True)
    log_probability = rivals.log_probability(score)
    assert float(log_probability[1, 0].detach()) == 0.0
    (-log_probability[:, 0].sum()).backward()
    assert score.grad[0].abs().min() > 0 and (score.grad[1] == 0).all()
    assert torch.isfinite(weights.grad).all()
    assert (weights.grad[1] == 0).all() and weights.grad[0].abs().max() > 0


@pytest.mark.parametrize("are_alike", [False, True])
def test_a_pair_with_fewer_motions_costs_what_it_costs_alone(are_alike) -> None:
    batch, T, mask = two_motions()
    padded = T.clone()
    padded[1, 1] = torch.nan
    weights = static(mask).clone()
    if are_alike:
        weights[1] = 1.0
    both = hvo.refine_rivals(batch, padded, weights)
    last = {name: x[1:] for name, x in vars(batch).items() if x is not None}
    alone = hvo.refine_rivals(hvo.PairBatch(**last), T[1:, :1], weights[1:, :1])
    for name in ("cost", "T_curr_prev"):
        expected = getattr(alone, name)[0, 0]
        torch.testing.assert_close(
            getattr(both, name)[1, 0], expected, rtol=1e-9, atol=1e-12
        )
    torch.testing.assert_close(both.noise[1:], alone.noise, rtol=1e-9, atol=1e-12)


def test_a_pair_without_flow_costs_everything() -> None:
    batch, T, mask = two_motions()
    flow = batch.flow.clone()
    flow[0] = torch.nan
    rivals = hvo.refine_rivals(
        replace(batch, flow=flow), T, static(mask), noise=NOISE
    )
    assert rivals.failed.tolist() == [[True, True], [False, False]]
    assert rivals.cost[0].tolist() == [1.0, 1.0]
    assert torch.isfinite(rivals.log_probability(torch.zeros(2, 2))).all()


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["geman-mcclure", "huber"])
def test_the_gradient_of_the_choice_against_differences(kernel: str) -> None:
    """-log softmax by score, weights, flow, depth, focal length and noise."""
    batch, T, mask = two_motions(3)

    def loss(score, logits, errors, noise):
        push, scale, focal = errors.split([2, 1, 1])
        weights = torch.sigmoid(logits[:, None, None] + static(mask).logit())
        column = torch.cat([focal.exp(), focal.exp(), torch.ones_like(focal)])
        moved = replace(
            batch,
            flow=batch.flow + push,
            depth_prev=batch.depth_prev * scale.exp(),
            K_prev=batch.K_prev * column,
            K_curr=batch.K_curr * column,
        )
        rivals = hvo.refine_rivals(moved, T, weights, noise=noise, kernel=kernel)
        assert rivals.motions.converged.all()
        log_probability = rivals.log_probability(score, cost_weight=20.0)
        # a loss on the motions beside that on the choice
        return -log_probability[:, 0].sum() + rivals.T_curr_prev[..., :3, 3].sum()

    inputs = (
        torch.tensor([[0.3, -0.2], [0.1, 0.4]], dtype=F64),
        torch.tensor([0.1, -0.1], dtype=F64),
        torch.zeros(4, dtype=F64),
        torch.tensor(NOISE, dtype=F64),
    )
    leaves = [x.clone().requires_grad_() for x in inputs]
    # motions exact to 1e-8 over steps of 1e-5
    assert torch.autograd.gradcheck(
        loss, leaves, eps=1e-5, atol=1e-3, rtol=1e-3, fast_mode=True
    )
    for gradient in torch.autograd.grad(loss(*leaves), leaves):
        assert gradient.abs().max() > 1e-3


BATCH, T, MASK = two_motions()
WEIGHTS = static(MASK)
test_doors = refuses(
    [
        ("a pair", lambda: hvo.refine_rivals(None, T), hvo.InputError,
         ("refine_rivals.batch", "PairBatch")),
        ("one motion", lambda: hvo.refine_rivals(BATCH, T[:, 0]), hvo.InputError,
         ("refine_rivals", "T_init", "(2, M, 4, 4)", "got (2, 4, 4)")),
        ("weights of a pair", lambda: hvo.refine_rivals(BATCH, T, WEIGHTS[:, 0]), hvo.InputError,
         ("refine_rivals", "weights", "(2, 2, 20, 28)", "got (2, 20, 28)")),
        ("weights above 1", lambda: hvo.refine_rivals(BATCH, T, 4 * WEIGHTS), hvo.InputError,
         ("refine_rivals", "weights", "0 to 1", "3.6")),
        ("score of a pair", lambda: hvo.refine_rivals(BATCH, T).log_probability(torch.zeros(2)),
         hvo.InputError, ("log_probability", "(2, 2)", "got (2,)")),
        ("options", lambda: hvo.refine_rivals(BATCH, T, options=3), hvo.InputError,
         ("refine_rivals.options", "Options")),
    ]
)  # fmt: skip
