"""What one pair says of its own intrinsics: principal point and focal length, motion free.

The motion that fits best hides most of a wrong intrinsic. What it cannot hide is left in the
residuals of the images, with a sign that is the same in every pair: small in one, plain in the
sum over a sequence.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.options import PhotometricOptions
from hybridvo.refinement import photometric_kernels as kernels
from hybridvo.refinement.illumination import EXPLAINED, even_light
from hybridvo.refinement.photometric import choose_pixels
from hybridvo.refinement.photometric_images import Level, blurred, grey_image, match_blur
from hybridvo.refinement.photometric_problem import NOISE_FLOOR, Problem, State
from hybridvo.types import Camera, FramePair, RelativePose

__all__ = ["PARAMETERS", "calibration_equations"]

PARAMETERS = ("cx_px", "cy_px", "log_focal")
"""What is estimated: to be added to the intrinsics of both frames."""
STEPS = (0.5, 0.5, 0.005)
"""Of the differences: projection is nearly linear in all three."""


def calibration_equations(
    pair: FramePair, pose: RelativePose, options: PhotometricOptions | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Normal equations of the intrinsics, with motion, gain and offset eliminated.

    Args:
        pair: both frames with images, the previous one with depth.
        pose: the motion found, with its weights.
        options: of the photometric refinement.

    Returns:
        H (P, P) and g (P,) for :data:`PARAMETERS`; None where the pair says nothing.
    """
    options = options or PhotometricOptions()
    prev, curr = pair.prev, pair.curr
    if prev.rgb is None or curr.rgb is None or prev.depth is None:
        return None
    if not pose.usable or pose.weights is None or pose.weights.shape != prev.camera.shape:
        return None
    images = match_blur(Level(grey_image(prev.rgb), grey_image(curr.rgb)))
    level = blurred(images, options.blur_px[-1])
    index = choose_pixels(level.prev, prev.depth, pose.weights, options)
    if len(index) < options.least_pixels:
        return None
    problem = Problem(pair, pose, index, np.eye(6), options)
    problem.gather(level)
    state = State(pose.T_curr_prev, 1.0, 0.0)
    problem.project(level, state)
    state = problem.settle(state, 3)
    if even_light(problem, state, EXPLAINED):
        state = problem.settle(state, 2)
    problem.set_share()
    columns = _columns(problem, pose.T_curr_prev)
    rows = np.concatenate([problem.J[: kernels.COLUMNS].astype(np.float64), columns])
    weight = problem.share * problem.w
    H = (rows * (weight * _slope(problem, state.noise))) @ rows.T
    g = -(rows * weight) @ np.where(problem.w > 0, problem.r, 0.0)
    c = kernels.COLUMNS
    H[np.diag_indices(c)] *= 1 + 1e-9
    try:
        hidden = np.linalg.solve(H[:c, :c], np.column_stack([H[:c, c:], g[:c]]))
    except np.linalg.LinAlgError:
        return None
    information = H[c:, c:] - H[c:, :c] @ hidden[:, :-1]
    gradient = g[c:] - H[c:, :c] @ hidden[:, -1]
    good = np.isfinite(information).all() and np.isfinite(gradient).all()
    return (information, gradient) if good else None


def _slope(problem: Problem, noise: float) -> np.ndarray:
    """(N,) derivative of weight x residual, over the weight.

    Newton's: with the weights alone, a redescending kernel shows two thirds of a systematic error.
    """
    buffer, gq = problem.buffer, problem.J[kernels.GQ]
    variance = max(noise, NOISE_FLOOR) ** 2 + problem.depth_noise**2 * buffer[kernels.PD] * gq**2
    # w = weight robust^2 / variance with robust = c^2 / (c^2 + d^2)
    square = problem.w * variance / np.maximum(buffer[kernels.W], 1e-12)
    return 4.0 * np.sqrt(np.clip(square, 0.0, 1.0)) - 3.0


def _columns(problem: Problem, T: np.ndarray) -> np.ndarray:
    """(P, N) slope of the residual in each parameter; 0 where a pixel is not seen."""
    pair = problem.pair
    prev, curr = pair.prev.camera, pair.curr.camera
    _, Z = _place(problem, T, prev, curr)
    # the Jacobian of a translation along x is G_u fx / Z: the image gradient is in it
    gradient = problem.J[:2] * (Z / np.array([[curr.fx], [curr.fy]]))
    out = np.empty((len(PARAMETERS), problem.n))
    for row, (name, step) in enumerate(zip(PARAMETERS, STEPS, strict=True)):
        more, less = (
            _place(problem, T, _changed(prev, name, h), _changed(curr, name, h))[0]
            for h in (step, -step)
        )
        out[row] = np.sum(gradient * (more - less), axis=0) / (2 * step)
    return np.where(np.isfinite(out) & (problem.w > 0), out, 0.0)


def _changed(camera: Camera, name: str, amount: float) -> Camera:
    if name == "log_focal":
        factor = float(np.exp(amount))
        return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    part = name.removesuffix("_px")
    return replace(camera, **{part: getattr(camera, part) + amount})


def _place(
    problem: Problem, T: np.ndarray, prev: Camera, curr: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """((2, N) px in the current image, (N,) depth there) of the pixels."""
    v, u = problem.index.T.astype(np.float64)
    z = problem.buffer[kernels.Z].astype(np.float64)
    points = np.stack([(u - prev.cx) / prev.fx * z, (v - prev.cy) / prev.fy * z, z])
    X, Y, Z = T[:3, :3] @ points + T[:3, 3:]
    Z = np.where(Z > kernels.MIN_DEPTH, Z, np.nan)
    return np.stack([curr.fx * X / Z + curr.cx, curr.fy * Y / Z + curr.cy]), Z
