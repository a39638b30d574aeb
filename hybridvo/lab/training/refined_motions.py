"""Each motion of a batch, refined inside its own static mask, with the gradient of the refinement.

The compiled fit finds the motion, as it does in the product. It then moves with the weights of the
pixels by the implicit function theorem: a loss on the refined motion, or on what it leaves
unexplained, so has a gradient to the masks that the network drew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from hybridvo.core.options import RefineOptions
from hybridvo.core.torch_geometry import pp, se3, to_matrix
from hybridvo.hypotheses.calibration import MASK_RAMP_END, MASK_RAMP_START
from hybridvo.hypotheses.refit import fit_in_mask
from hybridvo.network.hypothesis_inputs import HypothesisInputs
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.factors import Pixels, ResidualModel
from hybridvo.solver.torch.rivals import unexplained

STEPS = 2
"""Gauss-Newton steps that bring a fitted motion to rest: there its gradient is exact."""


class Fits(NamedTuple):
    """The fits of N motions inside their masks.

    Attributes:
        T: (N, 4, 4) ``T_curr_prev``, metres; the start where there is no fit.
        noise: (N, 2) standard deviations of flow, px, and of log depth.
        followers: (N,) sum of the weights that follow the motion.
        exists: (N,) bool.
    """

    T: torch.Tensor
    noise: torch.Tensor
    followers: torch.Tensor
    exists: torch.Tensor


class RefinedMotions(NamedTuple):
    """N refined motions; both fields carry the gradient to the weights.

    Attributes:
        pose: (N, 3, 4) ``T_curr_prev``, metres.
        cost: (N,) fraction of the usable pixels of the pair that the motion leaves unexplained,
            see :mod:`hybridvo.solver.torch.rivals`; 1 where there is no fit.
    """

    pose: torch.Tensor
    cost: torch.Tensor


def weights_of(static: torch.Tensor) -> torch.Tensor:
    """Convert logits of being static into weights of a fit, as ``refit.mask_weights`` does.

    >>> weights_of(torch.tensor([-1.0, 0.62, 3.0])).numpy().round(2).tolist()
    [0.0, 0.5, 1.0]
    """
    width = MASK_RAMP_END - MASK_RAMP_START
    return ((torch.sigmoid(static) - MASK_RAMP_START) / width).clamp(0, 1)


def fit_all(
    inputs: HypothesisInputs,
    samples: np.ndarray,
    weights: torch.Tensor,
    starts: np.ndarray,
) -> Fits:
    """Fit all motions, each to the pixels that its weights leave, with the compiled fit.

    Args:
        inputs: B pairs and N motions of them.
        samples: (B, 8, n) pixel buffers of the solver.
        weights: (N, h, w) of the pixels, 0 to 1.
        starts: (N, 3, 4) ``T_curr_prev`` from which the fits start, metres.
    """
    cutoff = RefineOptions().cutoff
    count = len(inputs.owner)
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, :3] = torch.as_tensor(starts)
    noise = torch.ones(count, 2, dtype=torch.float64)
    followers = torch.zeros(count, dtype=torch.float64)
    exists = torch.zeros(count, dtype=torch.bool)
    for k, b in enumerate(inputs.owner.tolist()):
        mask = weights[k].detach().float().numpy()
        if mask.max() <= 0:
            continue
        K = inputs.K[b].numpy()
        pose, stats = fit_in_mask(samples[b], mask, K, starts[k], cutoff)
        if not np.isfinite(pose).all():
            continue
        T[k, :3] = torch.as_tensor(pose)
        noise[k] = torch.tensor(stats.noise)
        followers[k] = stats.inlier_ratio * float(mask[inputs.usable[b]].sum())
        exists[k] = True
    return Fits(T, noise, followers, exists)


def refine_in_masks(
    inputs: HypothesisInputs,
    weights: torch.Tensor,
    fits: Fits,
    steps: int = STEPS,
) -> RefinedMotions:
    """Refine all motions, each with its own weights.

    Args:
        inputs: B pairs and N motions of them.
        weights: (N, h, w) of the pixels, 0 to 1, with a gradient. What else is known of the pixels,
            as by an earlier frame, is a factor on them.
        fits: of the same motions in the same weights; their noise is held constant.
        steps: Gauss-Newton steps from the fits on.
    """
    cutoff = RefineOptions().cutoff
    pixels = pixels_of(inputs, weights)
    model = ResidualModel(fits.noise.to(weights), cutoff)
    start = se3(fits.T)
    with torch.no_grad():
        fixed = pixels.map(torch.Tensor.detach)
        T = factors.gauss_newton(fixed, start, lambda *_: model, steps)
        at_rest = torch.isfinite(T.tensor()).all(dim=1) & fits.exists
        T = pp.SE3(torch.where(at_rest[:, None], T.tensor(), start.tensor()))
    A = factors.newton_matrix(pixels, T, model)
    g = factors.total_score(pixels, to_matrix(T), model)
    T = factors.attach_implicit_gradient(T, A, g, at_rest[:, None])
    noise = _noise_of_most(fits, inputs.owner).to(weights)
    usable = inputs.usable.flatten(1).sum(dim=1)[inputs.owner]
    cost = unexplained(pixels, usable, T, noise, cutoff)
    cost = torch.where(at_rest, cost, torch.ones_like(cost))
    return RefinedMotions(to_matrix(T)[:, :3].to(weights), cost)


def pixels_of(inputs: HypothesisInputs, weights: torch.Tensor) -> Pixels:
    """Return the pixels of every motion in the form of the solver, of the type of the weights."""
    own = inputs.owner
    usable = inputs.usable[own]
    depth = torch.where(usable, inputs.depth[own], 1.0).to(weights)
    ray = inputs.ray[own].to(weights)
    points = torch.cat([ray, torch.ones_like(ray[:, :1])], dim=1) * depth[:, None]
    target = torch.where(usable[:, None], inputs.target[own], 0.0).to(weights)
    K = torch.zeros(len(own), 3, 3).to(weights)
    K[:, [0, 1, 0, 1], [0, 1, 2, 2]] = inputs.K[own].to(weights)
    K[:, 2, 2] = 1
    maps = (
        points,
        target,
        inputs.flow_variance[own].to(weights),
        inputs.depth_variance[own].to(weights),
        torch.where(usable, weights, 0.0),
    )
    return Pixels._make([*(x.flatten(-2) for x in maps), K])


def _noise_of_most(fits: Fits, owner: torch.Tensor) -> torch.Tensor:
    """The noise (N, 2) by which a motion is measured: of the rival that most pixels follow."""
    is_rival = owner == owner[:, None]
    best = torch.where(is_rival, fits.followers, -1.0).argmax(dim=1)
    return fits.noise[best]
