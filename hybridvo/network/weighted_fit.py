"""A motion fitted to pixels with weights from the uncertainty of a network.

A network predicts better where the scene is static than how the camera moves. The fit
solves the ego-flow equation (paper, equation 8) with weights from the log scales, and its
gradient trains them: they rise where a pixel makes the fit worse.
"""

from __future__ import annotations

import torch

from hybridvo.calibration import (
    EXPLAINED_SCALE,
    MIN_FIT_SCALE,
    MIN_PATCH_FIT_SCALE,
    SHARPNESS,
    STARTING_MOTIONS,
)
from hybridvo.errors import InputError
from hybridvo.network.inputs import NetworkInputs, pinhole
from hybridvo.network.selection import (
    PATCH_ROWS,
    rotation_log_scale,
    select_motion,
)
from hybridvo.refinement.torch_factors import (
    Pixels,
    fit_pixels,
    residuals,
    to_tiles,
)
from hybridvo.results import PixelwisePrediction
from hybridvo.torch_geometry import se3

# logit of a pixel that must not take part: its weight is 0 in any precision
EXCLUDED_LOGIT = -1e4


def fitted_motion(
    maps: PixelwisePrediction, inputs: NetworkInputs, selection: str = "softmax"
) -> torch.Tensor:
    """Fit a motion to pixels, weighted by the uncertainty of a prediction.

    Args:
        maps: a prediction with uncertainty.
        inputs: what the network was given.
        selection: method of :func:`hybridvo.network.selection.select_motion` that gives
            the start of the fit.

    Returns:
        (B, 4, 4) ``T_curr_prev`` with the gradient of the log scales.

    Raises:
        InputError: for a prediction without uncertainty.
    """
    if maps.log_scale is None:
        raise InputError("fitted_motion: expected a prediction with uncertainty.")
    inputs = inputs.on_grid_of(maps.log_scale)
    weights = pixel_weights(maps.log_scale, inputs.valid)
    with torch.autocast(weights.device.type, enabled=False):
        pixels = _pixels(inputs, weights).map(lambda x: x.flatten(-2))
        start = se3(select_motion(maps, selection).detach().double())
        T = fit_pixels(pixels, start, MIN_FIT_SCALE)
    return T.matrix().to(pixels.weight)


@torch.no_grad()
def starting_motions(
    maps: PixelwisePrediction, inputs: NetworkInputs, selection: str = "softmax"
) -> torch.Tensor:
    """Find motions that the static scene may have.

    The first one is fitted to all pixels, weighted by uncertainty. Then each patch of the
    image has a motion of its own. One after the other, that one is taken which adds most
    to the pixels explained so far.

    Returns:
        (B, S, 4, 4) ``T_curr_prev``.
    """
    first = fitted_motion(maps, inputs, selection)
    inputs = inputs.on_grid_of(maps.motion)
    side = -(-maps.motion.shape[2] // PATCH_ROWS)
    with torch.autocast(first.device.type, enabled=False):
        pixels = _pixels(inputs, inputs.valid)
        of_patches = _fit_patches(pixels, first, side)
        tried = torch.cat([first[:, None], of_patches], dim=1)
        explained = _explained(pixels, tried)
    return _greedy_choice(tried, explained)


def _fit_patches(pixels: Pixels, start: torch.Tensor, side: int) -> torch.Tensor:
    """Fit a motion to each patch of maps (B, h, w), from one start (B, 4, 4) a pair.

    Returns:
        (B, P, 4, 4) motions of the P patches.
    """
    batch = len(start)
    tiles = pixels.map(lambda x: to_tiles(x, side).movedim(-2, 1).flatten(0, 1))
    count = len(tiles.weight) // batch
    tiles = tiles._replace(K=pixels.K.repeat_interleave(count, dim=0))
    starts = se3(start.double().repeat_interleave(count, dim=0))
    fitted = fit_pixels(tiles, starts, MIN_PATCH_FIT_SCALE)
    return fitted.matrix().to(start).unflatten(0, (batch, -1))


def _explained(pixels: Pixels, motions: torch.Tensor) -> torch.Tensor:
    """How far motions (B, M, 4, 4) explain each pixel, (B, M, n), from 0 to 1."""
    batch, count = motions.shape[:2]
    repeated = pixels.map(lambda x: x.flatten(-2).repeat_interleave(count, dim=0))
    repeated = repeated._replace(K=pixels.K.repeat_interleave(count, dim=0))
    residual = residuals(repeated, motions.flatten(0, 1))[0]
    squared = residual.square().sum(dim=1)
    explained = repeated.weight / (1 + squared / EXPLAINED_SCALE**2)
    return explained.unflatten(0, (batch, -1))


def _greedy_choice(motions: torch.Tensor, explained: torch.Tensor) -> torch.Tensor:
    """Take the first motion, then those that add most to what is explained.

    Args:
        motions: (B, M, 4, 4).
        explained: (B, M, n) how far each motion explains each pixel.

    Returns:
        (B, S, 4, 4) the motions taken.
    """
    pair = torch.arange(len(motions), device=explained.device)
    chosen = [motions[:, 0]]
    best = explained[:, 0]
    for _ in range(STARTING_MOTIONS - 1):
        gain = (explained - best[:, None]).clamp(min=0).sum(dim=2)
        taken = gain.argmax(dim=1)
        chosen.append(motions[pair, taken])
        best = torch.maximum(best, explained[pair, taken])
    return torch.stack(chosen, dim=1)


def _pixels(inputs: NetworkInputs, weights: torch.Tensor) -> Pixels:
    """Maps of what a fit needs of its pixels, in units of the focal length."""
    # so that flow of an image that was squeezed counts alike in both directions
    focal, centre = pinhole(inputs.K_curr)
    target = (inputs.pixels + inputs.flow - centre) / focal
    depth = 1 / torch.where(inputs.valid, inputs.inverse_depth[:, 0], 1.0)[:, None]
    points = torch.cat([inputs.rays * depth, depth], dim=1)
    one = torch.ones_like(depth[:, 0])
    unit_camera = torch.eye(3).to(points).expand(len(one), 3, 3)
    return Pixels(points, target, one, one, weights.to(one), unit_camera)


def pixel_weights(log_scale: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Weights of a fit from log scales.

    Args:
        log_scale: (B, 6, h, w) s = log U.
        valid: (B, h, w) bool.

    Returns:
        (B, h, w) weights in proportion to exp(-SHARPNESS s), with the sum one; 0 where
        invalid.
    """
    logit = -SHARPNESS * rotation_log_scale(log_scale)
    logit = torch.where(valid, logit, EXCLUDED_LOGIT)
    weights = torch.softmax(logit.flatten(1), dim=1).view_as(logit)
    return weights * valid
