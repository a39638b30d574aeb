"""A motion fitted to pixels with weights from the uncertainty of a network.

A network predicts better where the scene is static than how the camera moves. The fit
solves the ego-flow equation (paper, equation 8) with weights from the log scales, and its
gradient trains them: they rise where a pixel makes the fit worse.
"""

from __future__ import annotations

import torch

from hybridvo.core.errors import InputError
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.torch_geometry import se3
from hybridvo.network.selection import rotation_log_scale, select_motion
from hybridvo.solver.torch.factors import Pixels, fit_pixels
from hybridvo_lab.paper.inputs import NetworkInputs, pinhole

# weights are exp(-4 s), s the log scale of the uncertainty: errors on one moving
# object are alike, and one on two thirds of the image must not outweigh the rest
SHARPNESS = 4.0
# of the kernel of a fit, over the focal length: 0.1 px at 1000 px
MIN_FIT_SCALE = 1e-4

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
