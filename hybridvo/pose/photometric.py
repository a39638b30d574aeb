"""Photometric polish: the motion that the flow found, made sharper by the pictures themselves.

The flow brings the motion close; the pictures hold far more than the flow. The residual of a
weighted static pixel, ``I_curr(pi(T X)) - gain I_prev - offset``, joins as information: the flow's
(and the second depth's) covariance becomes a prior of Student's form around the motion of the
refinement, and the 6x6 normal equations of both add up, each with its estimated noise. A guard
keeps the motion of the flow where the pictures do not lower the joint cost, do not match, or lead
outside of what the flow allows. Definition of the term: :mod:`hybridvo.pose.photometric_kernels`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import invert, se3_exp
from hybridvo.pose import photometric_kernels as kernels
from hybridvo.pose.full_fit import tile_size
from hybridvo.pose.photometric_options import PhotometricOptions, PolishReport
from hybridvo.pose.picture import typical
from hybridvo.types import FramePair, RelativePose

__all__ = ["PhotometricOptions", "PolishReport", "grey_image", "polish_photometric"]

PER_CELL = 4
MID_GREY = 128.0
"""Taken off every grey value, so that gain and offset are nearly independent."""
NOISE_FLOOR = 0.1
"""Grey levels: rounding to 8 bits leaves 0.08 after the finest blur."""
TILES = 110
"""As in the refinement: errors may be correlated within a tile."""
NOISE_PIXELS = 2000
"""Pixels that the noise estimate looks at: it is then good to 3 %."""
COARSE_SPREAD = 0.3
"""Coarser blurs are used where the flow leaves more than this many finest blurs undecided."""
TOLERANCE = 0.02
"""Of a step, in standard deviations of the joint estimate."""
SETTLING = 2
"""Steps after which noise and share are estimated again: before, they are those of a worse motion."""
COST_NOISE = 1.0
"""A rise of the joint cost below this means nothing. Noise favours places between the pixels, where
reading averages more of it: the root of the estimating equation, which has no such bias, lies
beside the minimum of the cost."""
GAINS = (0.2, 5.0)
"""Limits of the gain between two pictures."""


def polish_photometric(
    pair: FramePair,
    pose: RelativePose,
    options: PhotometricOptions | None = None,
    *,
    trust: float = 1.0,
) -> RelativePose:
    """The motion of a pair, sharpened by its two pictures.

    Args:
        pair: the two frames; both with images.
        pose: what :func:`hybridvo.pose.refinement.refine` found for them, with its weights and
            covariance.
        options: see :class:`PhotometricOptions`.
        trust: factor in [0, 1] on the information of the pictures, see
            :class:`hybridvo.pose.photometric_monitor.PhotometricMonitor`.

    Returns:
        The motion with its covariance, ``terms`` and ``polish`` (a :class:`PolishReport`). Where
        images are missing or of no use, or the guard refuses, the motion is that of ``pose`` and
        the report says why. Never a value that is not finite.

    Raises:
        InputError: weights of another shape than the picture, or trust outside [0, 1].
    """
    if not 0.0 <= trust <= 1.0:
        raise InputError(f"polish_photometric: expected trust in [0, 1], got {trust!r}.")
    started = time.perf_counter()
    motion = _polish(pair, pose, options or PhotometricOptions(), trust)
    return motion.replace(ms=pose.ms + 1e3 * (time.perf_counter() - started))


def grey_image(rgb: np.ndarray) -> np.ndarray:
    """(H, W) float32 grey values less :data:`MID_GREY`, from (H, W, 3) uint8 in RGB order.

    Not rounded: 8 bits of grey would add as much noise as the camera's own rounding.
    """
    weights = np.array([[0.299, 0.587, 0.114, -MID_GREY]])
    return cv2.transform(np.ascontiguousarray(rgb).astype(np.float32), weights)


def _unchanged(
    pose: RelativePose, reason: str, message: str, report: PolishReport | None = None
) -> RelativePose:
    report = replace(report or PolishReport(False), taken=False, reason=reason, message=message)
    return pose.replace(polish=report)


def _polish(
    pair: FramePair, pose: RelativePose, options: PhotometricOptions, trust: float
) -> RelativePose:
    prev, curr = pair.prev, pair.curr
    if prev.rgb is None or curr.rgb is None:
        return _unchanged(pose, "no_images", "an image of the pair is missing")
    if not pose.ok or pose.weights is None or pose.weights_stride != 1 or prev.depth is None:
        return _unchanged(pose, "no_estimate", "there is no weighted estimate to start from")
    if pose.weights.shape != prev.camera.shape:
        raise InputError(
            f"polish_photometric: expected weights of shape {prev.camera.shape}, "
            f"got {pose.weights.shape}."
        )
    flow_information = _inverse(pose.covariance * options.flow_inflation)
    if flow_information is None:
        return _unchanged(pose, "no_estimate", "the estimate has no usable covariance")
    images = grey_image(prev.rgb), grey_image(curr.rgb)
    first = Level(*(cv2.GaussianBlur(image, (0, 0), options.blur_px[-1]) for image in images))
    index = _select(first.prev, prev.depth, pose.weights, options)
    if len(index) < options.least_pixels:
        return _unchanged(
            pose,
            "no_texture",
            f"{len(index)} static pixels with texture and depth, {options.least_pixels} needed",
        )
    problem = Problem(pair, pose, index, flow_information, options, trust)
    state = State(pose.T_curr_prev, 1.0, 0.0)
    # where the flow is sure to a fraction of the finest blur, that one is enough
    coarse = problem.spread_px() > COARSE_SPREAD * options.blur_px[-1]
    for blur, steps in zip(options.blur_px[:-1], options.iterations[:-1], strict=True):
        if not coarse:
            break
        level = Level(*(cv2.GaussianBlur(image, (0, 0), blur) for image in images))
        state = problem.solve(level, state, steps)
    state = problem.solve(first, state, options.iterations[-1])
    return _guarded(pose, problem, first, state, options)


def _select(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray, options: PhotometricOptions
) -> np.ndarray:
    """(N, 2) int32 rows and columns of the pixels to use."""
    height, width = grey.shape
    cell = max(2, round(np.sqrt(height * width * PER_CELL / options.pixels)))
    cells = (height // cell + 1) * (width // cell + 1)
    index = np.empty((cells * PER_CELL, 2), np.int32)
    n = kernels.select_pixels(
        grey, np.ascontiguousarray(depth), np.ascontiguousarray(weights, dtype=np.float32),
        np.float32(options.least_weight), cell, PER_CELL, index,
    )  # fmt: skip
    return index[:n]


@dataclass(frozen=True, eq=False)
class Level:
    """The two grey pictures, (H, W) float32, under one blur."""

    prev: np.ndarray
    curr: np.ndarray


@dataclass(frozen=True, eq=False)
class State:
    """(4, 4) T_curr_prev, gain and offset of the current picture; noise in grey levels."""

    T: np.ndarray
    gain: float
    offset: float
    noise: float = 0.0


class Problem:
    """The pixels of a pair and the joint cost of images and flow."""

    def __init__(
        self,
        pair: FramePair,
        pose: RelativePose,
        index: np.ndarray,
        flow_information: np.ndarray,
        options: PhotometricOptions,
        trust: float,
    ) -> None:
        prev, curr = pair.prev.camera, pair.curr.camera
        n = len(index)
        self.pair, self.pose, self.index, self.n = pair, pose, index, n
        self.flow_information, self.options, self.trust = flow_information, options, trust
        self.T_flow_inverse = invert(pose.T_curr_prev)
        self.camera = np.array([1 / prev.fx, 1 / prev.fy, prev.cx, prev.cy], np.float32)
        self.K = np.array([curr.fx, curr.fy, curr.cx, curr.cy], np.float32)
        self.depth_noise = pose.depth_noise
        self.buffer = np.empty((kernels.BUFFER_ROWS, n), np.float32)
        self.J = np.empty((kernels.JACOBIAN_ROWS, n), np.float32)
        self.r, self.w = np.empty(n, np.float32), np.empty(n, np.float32)
        self.H = np.empty((kernels.ALL_COLUMNS,) * 2)
        self.g = np.empty(kernels.ALL_COLUMNS)
        self.share = 1.0 / options.image_inflation
        self.seen = 0.0

    def gather(self, level: Level) -> None:
        """Grey values and gradients of one blur; geometry is the same for all."""
        depth, variance = self.pair.prev.depth, self.pair.prev.depth_variance
        assert depth is not None and self.pose.weights is not None
        unit = 1.0
        if variance is None:
            variance = np.ones((1, 1), np.float32)
        else:
            unit = typical(variance)
        kernels.gather_pixels(
            self.index, self.n, level.prev, np.ascontiguousarray(depth),
            np.ascontiguousarray(self.pose.weights, dtype=np.float32),
            np.ascontiguousarray(variance), np.float32(unit), self.camera, self.buffer,
        )  # fmt: skip
        self.total = float(self.buffer[kernels.W].sum())

    def spread_px(self) -> float:
        """How far the flow's covariance lets the pixels move, root mean square, px."""
        step = max(1, self.n // 200)
        v, u = self.index[::step].T.astype(np.float64)
        assert self.pair.prev.depth is not None
        i = 1.0 / self.pair.prev.depth[self.index[::step, 0], self.index[::step, 1]]
        x, y = (u - self.camera[2]) * self.camera[0], (v - self.camera[3]) * self.camera[1]
        zero = np.zeros_like(x)
        rows = np.array(
            [
                self.K[0] * np.array([i, zero, -x * i, -x * y, 1 + x * x, -y]),
                self.K[1] * np.array([zero, i, -y * i, -(1 + y * y), x * y, x]),
            ]
        )
        covariance = self.pose.covariance * self.options.flow_inflation
        return float(np.sqrt(np.einsum("cpn,pq,cqn->", rows, covariance, rows) / len(x)))

    def project(self, level: Level, state: State) -> float:
        """Fill J, r, w, H and g at a state; returns the photometric cost."""
        T = state.T.astype(np.float32)
        inside = kernels.project_pixels(
            self.buffer, self.n, level.curr, T[:3, :3].copy(), T[:3, 3].copy(), self.K,
            self.camera[:2], np.array([state.gain, state.offset], np.float32), self.J, self.r,
        )  # fmt: skip
        self.seen = inside / max(self.total, 1e-12)
        return self.weigh(state.noise)

    def weigh(self, noise: float, columns: int = kernels.COLUMNS) -> float:
        """Weights, H and g of the last projection under a noise; returns the photometric cost."""
        # depth_noise belongs to the typical depth variance, the unit of the buffer's
        values = (1 / max(noise, NOISE_FLOOR) ** 2, self.depth_noise**2, self.options.cutoff**2)
        variances = np.array(values, np.float32)
        cost = kernels.weigh_pixels(self.buffer, self.n, variances, self.J, self.r, self.w)
        kernels.normal_equations(self.J, self.r, self.w, self.n, columns, self.H, self.g)
        return float(cost)

    def noise_scale(self) -> float:
        """Weighted median of the residuals' lengths, as the deviation of a Gaussian."""
        step = max(1, self.n // NOISE_PIXELS)
        lengths = np.abs(self.r[::step])
        used = lengths >= 0  # not the unseen ones, NaN
        lengths = lengths[used]
        if not lengths.size:
            return NOISE_FLOOR
        order = np.argsort(lengths)
        cumulative = np.cumsum(self.buffer[kernels.W, ::step][used][order])
        middle = np.searchsorted(cumulative, 0.5 * cumulative[-1])
        return max(float(1.4826 * lengths[order[min(middle, len(order) - 1)]]), NOISE_FLOOR)

    def set_share(self) -> None:
        """Share of the photometric information that is left under errors alike in a tile.

        Trace ratio of the sandwich covariance over tiles to that of the model, at least 1; beyond
        the tiles by ``image_inflation``.
        """
        height, width = self.pair.prev.camera.shape
        tile = tile_size((height, width), TILES)
        columns, rows = -(-width // tile), -(-height // tile)
        scores = np.zeros((rows * columns, kernels.POSE_COLUMNS))
        meat = np.zeros((kernels.POSE_COLUMNS,) * 2)
        H, light = self.marginal()
        kernels.tile_scores(
            self.index, self.n, self.J, self.r, self.w, tile, columns, light, scores, meat
        )
        inverse = _inverse(H)
        independent = _inverse(meat)
        if inverse is None or independent is None:
            self.share = 0.0
            return
        clusters = max(1.0, np.trace(independent @ scores.T @ scores) / 6)
        dispersion = np.trace(inverse @ meat) / 6
        self.share = 1.0 / (max(1.0, clusters * dispersion) * self.options.image_inflation)

    def marginal(self) -> tuple[np.ndarray, np.ndarray]:
        """(H (6, 6) with gain and offset free, what they explain of each column (6, 2))."""
        p, c = kernels.POSE_COLUMNS, kernels.COLUMNS
        light = _solve_light(self.H[p:c, p:c], self.H[p:c, :p]).T
        return self.H[:p, :p] - light @ self.H[p:c, :p], light

    def prior(self, T: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """(cost, information (6, 6), its gradient (6,)) of Student's prior around the flow."""
        xi = small_log(T @ self.T_flow_inverse)
        d2 = float(xi @ self.flow_information @ xi)
        freedom = self.options.freedom
        weight = (freedom + 6) / (freedom + d2)
        information = weight * self.flow_information
        return 0.5 * (freedom + 6) * float(np.log1p(d2 / freedom)), information, -information @ xi

    def cost(self, photometric: float, T: np.ndarray) -> float:
        """Joint cost of images and flow."""
        return self.trust * self.share * photometric + self.prior(T)[0]

    def solve(self, level: Level, state: State, steps: int) -> State:
        """Damped Gauss-Newton on one blur; a step is taken only where the joint cost falls.

        The last projection is that of the state returned.
        """
        self.gather(level)
        self.project(level, state)
        state = self.settle(state, 2 if state.noise == 0 else 1)
        photometric = self.weigh(state.noise)
        damping = 0.0
        accepted = 0
        delta, left = self._step(state, damping)
        for _ in range(steps):
            if left < TOLERANCE**2 and accepted > SETTLING:
                break
            other = replace(
                state,
                T=se3_exp(delta[:6]) @ state.T,
                gain=float(np.clip(state.gain + delta[6], *GAINS)),
                offset=float(state.offset + delta[7]),
            )
            found = self.project(level, other)
            following, still_left = self._step(other, 0.0)
            falls = self.cost(found, other.T) <= self.cost(photometric, state.T)
            if falls or still_left < 0.5 * left:
                state, photometric, damping = other, found, 0.1 * damping
                delta, left = following, still_left
                if accepted < SETTLING:  # the noise was that of a worse motion
                    state = replace(state, noise=self.noise_scale())
                    photometric = self.weigh(state.noise)
                    self.set_share()
                    delta, left = self._step(state, damping)
                accepted += 1
            else:
                damping = max(10 * damping, 1e-2)
                self.project(level, state)
                delta, left = self._step(state, damping)
        return state

    def settle(self, state: State, rounds: int, fixed: bool = False) -> State:
        """Gain, offset and, unless ``fixed``, noise of the last projection, which follows."""
        p, c = kernels.POSE_COLUMNS, kernels.COLUMNS
        for _ in range(rounds):
            if not fixed:
                state = replace(state, noise=self.noise_scale())
            self.weigh(state.noise)
            step = _solve_light(self.H[p:c, p:c], self.g[p:c])
            gain = float(np.clip(state.gain + step[0], *GAINS))
            kernels.relight(
                self.buffer, self.n, np.float32(gain - state.gain), np.float32(step[1]), self.r
            )
            state = replace(state, gain=gain, offset=state.offset + float(step[1]))
        return state

    def _step(self, state: State, damping: float) -> tuple[np.ndarray, float]:
        """Gauss-Newton step of motion, gain and offset, and its squared length in deviations.

        A step that cannot be had, or is absurd, is zero.
        """
        c = kernels.COLUMNS
        weight = self.trust * self.share
        _, information, gradient = self.prior(state.T)
        H, g = weight * self.H[:c, :c], weight * self.g[:c]
        H[:6, :6] += information
        g[:6] += gradient
        H[np.diag_indices(c)] *= 1 + damping
        H[6:, 6:] += 1e-9 * np.eye(2)
        scale = np.sqrt(np.maximum(np.diag(H), 1e-30))
        try:
            delta = np.linalg.solve(H / np.outer(scale, scale), g / scale) / scale
        except np.linalg.LinAlgError:
            return np.zeros(c), 0.0
        if not (np.isfinite(delta).all() and np.abs(delta[:6]).max() < 1.0):
            return np.zeros(c), 0.0
        return delta, float(delta @ g)


def _guarded(
    pose: RelativePose,
    problem: Problem,
    level: Level,
    state: State,
    options: PhotometricOptions,
) -> RelativePose:
    """The polished motion, or that of the flow where the pictures cannot be believed."""
    problem.set_share()
    photometric = problem.weigh(state.noise, kernels.ALL_COLUMNS)
    used = problem.w > 0
    weight = problem.buffer[kernels.W][used]
    grey = problem.buffer[kernels.GREY][used]
    correlation = _correlation(grey, problem.r[used] + state.gain * grey + state.offset, weight)
    H = problem.marginal()[0]
    images = problem.trust * problem.share * H
    shift = small_log(state.T @ problem.T_flow_inverse)
    flow = problem.flow_information
    sigma = float(np.sqrt(max(shift @ flow @ shift, 0.0)))
    depth_shift, depth_information = _depth_shift(problem)
    report = PolishReport(
        True,
        shift=shift,
        shift_sigma=sigma,
        image_information=images,
        flow_information=flow,
        gain=state.gain,
        offset=state.offset + MID_GREY * (1 - state.gain),
        noise_grey=state.noise,
        correlation=correlation,
        pixels=int(np.count_nonzero(used)),
        depth_shift_px=depth_shift,
        depth_shift_information=depth_information,
    )
    numbers: tuple[Any, ...] = (state.T, images, photometric, state.gain, state.offset)
    if not all(np.isfinite(value).all() for value in numbers):
        return _unchanged(pose, "not_finite", "the images gave no finite motion")
    if problem.seen < options.least_seen:
        return _unchanged(
            pose,
            "out_of_view",
            f"{100 * problem.seen:.0f} % of the pixels are seen by both cameras",
            report,
        )
    if not correlation >= options.least_correlation:
        return _unchanged(
            pose,
            "no_match",
            f"the two images do not match along the motion (correlation {correlation:.2f})",
            report,
        )
    gain = float(np.linalg.eigvals(np.linalg.solve(flow, images)).real.max())
    if gain < options.least_gain:
        return _unchanged(
            pose, "no_gain", "the images add little to what the flow already knows", report
        )
    if sigma > options.largest_shift:
        return _unchanged(
            pose,
            "outside_flow",
            f"the images lead {sigma:.1f} standard deviations away from the flow's motion",
            report,
        )
    joint = problem.cost(photometric, state.T)
    problem.project(level, replace(state, T=pose.T_curr_prev))
    problem.settle(state, 1, fixed=True)
    if not joint < problem.cost(problem.weigh(state.noise), pose.T_curr_prev) + COST_NOISE:
        return _unchanged(
            pose, "higher_cost", "the images do not lower the cost of the motion", report
        )
    covariance = _inverse(images + problem.prior(state.T)[1])
    if covariance is None:
        return _unchanged(pose, "not_finite", "the joint information is not definite", report)
    T = state.T.copy()
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ Vt
    spread = np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))
    return pose.replace(
        T_curr_prev=T,
        covariance=covariance,
        translation_direction_valid=bool(np.linalg.norm(T[:3, 3]) > 3 * spread),
        terms=(*pose.terms, "images"),
        polish=report,
    )


def _solve_light(block: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``block^-1 right`` for gain and offset; 0 of the one that the picture does not show."""
    a, b, c = block[0, 0], block[0, 1], block[1, 1]
    determinant = a * c - b * b
    if determinant > 1e-9 * a * c > 0:
        return np.array([c * right[0] - b * right[1], a * right[1] - b * right[0]]) / determinant
    offset = right[1] / c if c > 0 else 0.0 * right[1]
    return np.array([0.0 * offset, offset])


def small_log(T: np.ndarray) -> np.ndarray:
    """(6,) logarithm of a (4, 4) transform near the identity.

    :func:`hybridvo.geometry.se3_log` for angles below a right one, without scipy's 0.3 ms.
    """
    R = T[:3, :3]
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.sqrt(axis @ axis))
    theta = float(np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1)))
    phi = axis * (theta / sine if sine > 1e-12 else 1.0)
    c = 1 / 12 if theta < 1e-4 else 1 / theta**2 - 1 / (2 * theta * np.tan(0.5 * theta))
    W = np.array([[0.0, -phi[2], phi[1]], [phi[2], 0.0, -phi[0]], [-phi[1], phi[0], 0.0]])
    turned = W @ T[:3, 3]
    return np.concatenate([T[:3, 3] - 0.5 * turned + c * (W @ turned), phi])


def _depth_shift(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """((2,) px, (2, 2) information) of a shift of the depth map, motion and light free."""
    c = kernels.COLUMNS
    inverse = np.linalg.pinv(problem.H[:c, :c], rcond=1e-12, hermitian=True)
    cross = problem.H[c:, :c] @ inverse
    information = problem.H[c:, c:] - cross @ problem.H[:c, c:]
    gradient = problem.g[c:] - cross @ problem.g[:c]
    covariance = _inverse(information)
    if covariance is None:
        return np.zeros(2), np.zeros((2, 2))
    return covariance @ gradient, problem.share * information


def _correlation(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> float:
    """Weighted correlation; 0 where one of them is constant."""
    total = float(weight.sum())
    if total <= 0:
        return 0.0
    a = a - (weight @ a) / total
    b = b - (weight @ b) / total
    power = float(weight @ (a * a)) * float(weight @ (b * b))
    return float(weight @ (a * b)) / np.sqrt(power) if power > 0 else 0.0


def _inverse(matrix: np.ndarray) -> np.ndarray | None:
    """Inverse of a positive definite matrix, symmetric, or None."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if not (np.isfinite(matrix).all() and (scale > 0).all()):
        return None
    outer = np.outer(scale, scale)
    try:
        factor = np.linalg.cholesky(matrix / outer)
    except np.linalg.LinAlgError:
        return None
    root = np.linalg.inv(factor) / scale
    inverse = root.T @ root
    return inverse if np.isfinite(inverse).all() else None
