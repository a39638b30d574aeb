"""The pixels of one pair, and Gauss-Newton on the joint cost of images and flow."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridvo.geometry import invert, se3_exp
from hybridvo.options import PhotometricOptions
from hybridvo.refinement import photometric_kernels as kernels
from hybridvo.refinement.full_fit import tile_size
from hybridvo.refinement.illumination import EXPLAINED, even_light
from hybridvo.refinement.photometric_images import Level
from hybridvo.refinement.pixels import as_contiguous, typical
from hybridvo.results import RelativePose
from hybridvo.types import FramePair

CUTOFF = 3.0
"""c of the Geman-McClure kernel, in standard deviations."""
FREEDOM = 6.0
"""Degrees of freedom of the Student prior around the flow, whose covariance is an estimate."""
NOISE_FLOOR = 0.1
"""Grey levels: rounding to 8 bits leaves 0.08 after the finest blur."""
TILES = 110
"""As in the refinement: errors may be correlated within a tile."""
PARTS = ((2, 2), (4, 1))
"""Rows and columns of parts of the image that are held against each other: a lens errs by
quadrant, a rolling shutter by row."""
EVEN = 0.7
"""Dispersion of the parts' scores, as shares of the model's, below which they agree: rendered pairs
have 0.25 in the median, 0.55 at the 90th percentile; with a rolling shutter 1.0 and 2.0."""
NOISE_PIXELS = 2000
"""Pixels that the noise estimate looks at: it is then good to 3 %."""
TOLERANCE = 0.02
"""Of a step, in standard deviations of the joint estimate."""
SETTLING = 2
"""Steps after which noise and share are estimated again: they were those of a worse motion."""
GAINS = (0.2, 5.0)
"""Limits of the gain between two images."""


@dataclass(frozen=True, eq=False)
class State:
    """(4, 4) T_curr_prev, gain and offset of the current image; noise in grey levels."""

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
    ) -> None:
        prev, curr = pair.prev.camera, pair.curr.camera
        n = len(index)
        self.pair, self.pose, self.index, self.n = pair, pose, index, n
        self.flow_information, self.options = flow_information, options
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
        self.agreement = 1.0
        self.uneven_light = False

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
            self.index, self.n, level.prev, as_contiguous(depth),
            as_contiguous(self.pose.weights, np.float32),
            as_contiguous(variance), np.float32(unit), self.camera, self.buffer,
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
        covariance = self.pose.covariance * self.options.prior_inflation
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
        values = (1 / max(noise, NOISE_FLOOR) ** 2, self.depth_noise**2, CUTOFF**2)
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
        """Share of the photometric information that is left under errors alike in a region.

        Trace ratio of the sandwich covariance over tiles to that of the model, at least 1; beyond
        the tiles by ``image_inflation``, and by ``agreement`` where that is not enough.
        """
        height, width = self.pair.prev.camera.shape
        tile = tile_size((height, width), TILES)
        columns, rows = -(-width // tile), -(-height // tile)
        c = kernels.POSE_COLUMNS
        scores, curvature = np.zeros((rows * columns, c)), np.zeros((rows * columns, c, c))
        meat = np.zeros((c, c))
        H, light = self.marginal()
        kernels.tile_scores(
            self.index, self.n, self.J, self.r, self.w, tile, columns, light, scores, curvature,
            meat,
        )  # fmt: skip
        model = inverse(H)
        independent = inverse(meat)
        if model is None or independent is None:
            self.share = 0.0
            return
        # as at the optimum of the images alone, to first order: the flow pulls away from it
        scores -= curvature @ (model @ scores.sum(axis=0))
        clusters = max(1.0, np.trace(independent @ scores.T @ scores) / 6)
        dispersion = np.trace(model @ meat) / 6
        self.share = 1.0 / (max(1.0, clusters * dispersion) * self.options.image_inflation)
        parts = self.share * _dispersion(scores.reshape(rows, columns, -1), model)
        # what the parts disagree about is seen; as much again is common to them and is not
        self.agreement = min(1.0, (EVEN / max(parts, EVEN)) ** 2)
        self.share *= self.agreement

    def marginal(self) -> tuple[np.ndarray, np.ndarray]:
        """(H (6, 6) with gain and offset free, what they explain of each column (6, 2))."""
        p, c = kernels.POSE_COLUMNS, kernels.COLUMNS
        light = _solve_light(self.H[p:c, p:c], self.H[p:c, :p]).T
        return self.H[:p, :p] - light @ self.H[p:c, :p], light

    def prior(self, T: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """(cost, information (6, 6), its gradient (6,)) of Student's prior around the flow."""
        xi = small_log(T @ self.T_flow_inverse)
        d2 = float(xi @ self.flow_information @ xi)
        freedom = FREEDOM
        weight = (freedom + 6) / (freedom + d2)
        information = weight * self.flow_information
        return 0.5 * (freedom + 6) * float(np.log1p(d2 / freedom)), information, -information @ xi

    def cost(self, photometric: float, T: np.ndarray) -> float:
        """Joint cost of images and flow."""
        return self.share * photometric + self.prior(T)[0]

    def solve(self, level: Level, state: State, steps: int) -> State:
        """Damped Gauss-Newton on one blur; a step is taken only where the joint cost falls.

        The last projection is that of the state returned.
        """
        self.gather(level)
        self.project(level, state)
        state = self.settle(state, 2 if state.noise == 0 else 1)
        uneven = even_light(self, state, EXPLAINED)
        self.uneven_light |= uneven
        if uneven:
            state = self.settle(state, 1)
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
                # noise and light were those of a worse motion
                if uneven:
                    even_light(self, state)
                if accepted < SETTLING or uneven:
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
        weight = self.share
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


def _dispersion(scores: np.ndarray, model: np.ndarray) -> float:
    """Dispersion of the scores (rows, columns, 6) of tiles, summed over each of ``PARTS``.

    1 where the parts are independent and the ``model`` covariance (6, 6) is right.
    """
    found = []
    for shape in PARTS:
        rows, columns = (
            np.arange(n) * k // n for n, k in zip(scores.shape[:2], shape, strict=True)
        )
        sums = np.zeros((*shape, scores.shape[2]))
        np.add.at(sums, np.ix_(rows, columns), scores)
        parts = sums.reshape(-1, scores.shape[2])
        k = len(parts)
        found.append(np.einsum("bp,pq,bq->", parts, model, parts) / 6 * k / (k - 1))
    return float(np.mean(found))


def _solve_light(block: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``block^-1 right`` for gain and offset; 0 of the one that the image does not show."""
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


def inverse(matrix: np.ndarray) -> np.ndarray | None:
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
    out = root.T @ root
    return out if np.isfinite(out).all() else None
