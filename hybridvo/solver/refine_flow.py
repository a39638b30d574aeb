"""Refinement on flow and depth: from a start to a metric motion with covariance and status.

It minimises the ego-flow reprojection error (paper, equations 6 and 8), weighted by the noise of
flow and depth, both estimated from the pair, under a robust kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.core.geometry import pose_matrix
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import (
    UNINFORMATIVE_COVARIANCE,
    Hypothesis,
    Motion,
    Term,
)
from hybridvo.core.types import FramePair
from hybridvo.solver import kernels, robust_fit
from hybridvo.solver.covariance import (
    MotionCovariance,
    ScoreStatistics,
    motion_covariance,
)
from hybridvo.solver.depths import DepthAgreement, compare_depths
from hybridvo.solver.kernels import (
    HESSIAN_SUMS,
    ResidualNoise,
    ScoreProducts,
)
from hybridvo.solver.newton import (
    ROUNDED_STEP_STD,
    Linearization,
    MotionState,
    NewtonResult,
    newton,
    tile_size,
)
from hybridvo.solver.noise_estimation import Noise, pair_noise
from hybridvo.solver.pixels import PixelGrid, coarse_grid
from hybridvo.solver.robust_fit import NOISE_TOLERANCE, REESTIMATE_STEPS
from hybridvo.solver.score_blocks import symmetric
from hybridvo.solver.shared_errors import (
    SharedErrors,
    coherent_fraction,
    tile_pulls,
)
from hybridvo.solver.status import FitSummary, degeneracy, status_of

# Length of the Newton step from the coarse grid's solution to that of all pixels of a pair,
# standard deviations: of 114 real pairs none was longer. Convergence is quadratic: what such a
# step leaves is a tenth of a standard deviation.
STEP_TOLERANCE_STD = 30.0
# Newton steps on all pixels of a pair, at most. Real pairs need one; a rendered pair with exact
# flow is 2 cm off after it, as against 0.6 mm.
FULL_STEPS = 5


@dataclass(frozen=True, eq=False)
class Selection:
    """The motion to be refined, and what is known about it.

    Attributes:
        T_curr_prev: (4, 4) metres.
        noise: estimated so far; None: not estimated, and the motion is only a start.
        mask: (h, w) weights on the coarse grid that it was fitted with, or None.
        coverage: fraction of the usable pixels' weight that the mask leaves.
        evidence: on whether it is the camera's; its type says what it is.
        hypotheses: all candidates, the selected one first.
        iterations: Gauss-Newton steps spent on it.
    """

    T_curr_prev: np.ndarray
    noise: Noise | None = None
    mask: np.ndarray | None = None
    coverage: float = 1.0
    evidence: tuple[float, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    iterations: int = 0


@dataclass(eq=False)
class FlowLinearization(Linearization):
    """Normal equations of the flow, and what they were summed from.

    Attributes:
        meat: (6, 6) covariance of g if errors are independent.
        tiles: (rows, columns, 27) upper triangle of H and g of each tile.
        robust_sum: sum of robust times external weights.
        external_sum: external weights of all usable pixels.
        inlier_sum: of those within the robust kernel's cutoff.
        weights: (H, W) float32 robust weights, without the external ones.
    """

    meat: np.ndarray
    tiles: np.ndarray
    robust_sum: float
    external_sum: float
    inlier_sum: float
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class FlowFactor:
    """Flow and depth of every pixel of a pair, as a cost of its motion.

    Attributes:
        grid: the pixels.
        noise: noise and robust kernel.
        tile: side of the tiles, px.
        scores: curvature and meat, from the coarse grid; those of all pixels are scaled from it.
    """

    grid: PixelGrid
    noise: ResidualNoise
    tile: int
    scores: ScoreProducts

    def linearize(self, state: MotionState) -> FlowLinearization:
        """Return the normal equations at a state."""
        sums = self.grid.full_pass(state.T_curr_prev[:3], self.noise, self.tile)
        total = sums.tiles.sum(axis=(0, 1))
        totals = sums.totals.sum(axis=0)
        external_sum = float(totals[kernels.EXTERNAL_SUM])
        return FlowLinearization(
            H=symmetric(total[:HESSIAN_SUMS]),
            g=total[HESSIAN_SUMS:],
            cost=float(totals[kernels.COST]),
            curvature=symmetric(self.scores.curvature * external_sum),
            meat=symmetric(self.scores.meat * external_sum),
            tiles=sums.tiles,
            robust_sum=float(totals[kernels.ROBUST_SUM]),
            external_sum=external_sum,
            inlier_sum=float(totals[kernels.INLIER_SUM]),
            weights=sums.robust,
        )


@dataclass(frozen=True, eq=False)
class FlowFit:
    """A motion fitted to flow and depth, and what it can be judged by.

    Attributes:
        T_curr_prev: (4, 4) metres.
        at: the normal equations there.
        noise: of flow and depth.
        stated: the covariance.
        depths: how the depths of both frames compare along the motion, or None.
        iterations: Gauss-Newton steps.
        converged: whether the step that is left is short.
    """

    T_curr_prev: np.ndarray
    at: FlowLinearization
    noise: Noise
    stated: MotionCovariance
    depths: DepthAgreement | None
    iterations: int
    converged: bool

    @property
    def inlier_ratio(self) -> float:
        """Fraction of the weight within the robust kernel's cutoff."""
        return self.at.inlier_sum / max(self.at.external_sum, 1e-12)

    @property
    def cost(self) -> float:
        """Robust cost per unit of weight."""
        return self.at.cost / max(self.at.external_sum, 1e-12)

    @property
    def summary(self) -> FitSummary:
        """What a status follows from."""
        is_finite = bool(np.isfinite(self.T_curr_prev).all())
        return FitSummary(
            is_determined=self.stated.tiles > 0 and is_finite,
            inlier_ratio=self.inlier_ratio,
            followers=float(self.at.weights.sum()),
            converged=self.converged,
            max_steps=FULL_STEPS,
        )


def refine_pair(
    pair: FramePair,
    start: Selection,
    grid: PixelGrid | None = None,
    weights: np.ndarray | None = None,
    options: RefineOptions | None = None,
) -> Motion:
    """Refine the motion of a pair.

    Args:
        pair: the pair, with flow and depth.
        start: the motion to start from; its noise is estimated if it has none.
        grid: the pixels of the pair; None: they are prepared here.
        weights: (H, W) factors on the information of each pixel, for a grid that is prepared here.
        options: of the refinement.

    Returns:
        The motion with covariance, and the status of the fit; the identity where it failed.

    Raises:
        StageFailed: The pair has no flow, no depth, or too few usable pixels.
    """
    options = options or RefineOptions()
    if grid is None:
        grid = coarse_grid(pair, weights, options)
    fit = fit_flow(pair, start, grid, options)
    degenerate = degeneracy(fit.stated, grid.size, options)
    status = status_of(fit.summary, fit.depths, degenerate)
    T = fit.T_curr_prev
    covariance = fit.stated.covariance
    if not status.usable:
        T = np.eye(4)
        covariance = UNINFORMATIVE_COVARIANCE.copy()
    return Motion(
        T_curr_prev=T,
        covariance=covariance,
        status=status,
        inlier_ratio=min(1.0, fit.inlier_ratio * start.coverage),
        iterations=fit.iterations,
        cost=fit.cost,
        residual_scale_px=float(fit.noise.flow_px),
        depth_noise=float(fit.noise.log_depth),
        weights=fit.at.weights,
        evidence=start.evidence,
        hypotheses=start.hypotheses,
        terms=(Term.FLOW,),
    )


def fit_flow(
    pair: FramePair, start: Selection, grid: PixelGrid, options: RefineOptions
) -> FlowFit:
    """Fit a motion to flow and depth of all pixels of a pair.

    Args:
        pair: the pair, with flow and depth.
        start: the motion to start from; its noise is estimated if it has none.
        grid: the pixels of the pair.
        options: of the refinement.
    """
    depth_curr = None if options.current_depth == "off" else pair.curr.depth
    pose, first_noise, coarse_steps = _coarse_motion(grid, start, options)
    estimate = pair_noise(
        grid.samples,
        grid.count,
        grid.K,
        pose,
        first_noise,
        options.cutoff,
        depth_curr,
    )
    fit, steps = _fit_full_grid(grid, pose, estimate.noise, options)
    T = pose_matrix(fit.state.T_curr_prev[:3])
    depths = None
    if depth_curr is not None:
        depths = compare_depths(pair, T, fit.at.weights)
    stated = _covariance(grid, fit.at, T, estimate.noise, depths, options)
    iterations = coarse_steps + steps + fit.iterations
    return FlowFit(
        T, fit.at, estimate.noise, stated, depths, iterations, _has_converged(fit)
    )


def _coarse_motion(
    grid: PixelGrid, start: Selection, options: RefineOptions
) -> tuple[np.ndarray, Noise, int]:
    """Return the pose (3, 4), the noise and the steps spent, of a start with noise or without."""
    pose = np.array(start.T_curr_prev[:3], np.float64)
    if start.noise is not None:
        return pose, start.noise, start.iterations
    fitted, noise, _, iterations = robust_fit.fit_coarse(
        grid.samples, grid.count, grid.K, pose, options.cutoff
    )
    return fitted, noise, iterations


def _fit_full_grid(
    grid: PixelGrid, pose: np.ndarray, noise: Noise, options: RefineOptions
) -> tuple[NewtonResult[FlowLinearization], int]:
    """Fit a motion with known noise to all pixels; also return the steps on the coarse grid."""
    weighting = kernels.residual_noise(*noise, options.cutoff)
    pose = pose.copy()
    steps = robust_fit.gauss_newton(
        grid.samples,
        grid.count,
        grid.K,
        weighting,
        REESTIMATE_STEPS,
        NOISE_TOLERANCE * noise.flow_px,
        pose,
    )
    scores = kernels.score_products(
        grid.samples, grid.count, pose, grid.K, weighting
    )
    tile = tile_size(grid.size, options.tiles)
    flow = FlowFactor(grid, weighting, tile, scores)
    fit = newton(
        flow, MotionState(pose_matrix(pose)), FULL_STEPS, STEP_TOLERANCE_STD
    )
    return fit, int(steps)


def _has_converged(fit: NewtonResult[FlowLinearization]) -> bool:
    """Whether the last step is short, or may be rounding after the most steps."""
    if fit.last2 < STEP_TOLERANCE_STD**2:
        return True
    # mean square motion of the image, standard deviations
    moved2 = fit.last2 / max(fit.at.robust_sum, 1e-12)
    return fit.iterations == FULL_STEPS and moved2 < ROUNDED_STEP_STD**2


def _covariance(
    grid: PixelGrid,
    at: FlowLinearization,
    T: np.ndarray,
    noise: Noise,
    depths: DepthAgreement | None,
    options: RefineOptions,
) -> MotionCovariance:
    """Return the covariance of a motion (4, 4) from the linearization at its solution."""
    shared = _shared_errors(grid, at, T[:3], noise, options)
    statistics = ScoreStatistics(
        at.tiles, at.curvature, at.meat, at.external_sum, shared
    )
    inverse_depth = robust_fit.translation_scale(grid.samples, grid.count)
    return motion_covariance(
        statistics, inverse_depth, float(grid.K[0]), T[:3, 3], noise, depths
    )


def _shared_errors(
    grid: PixelGrid,
    at: FlowLinearization,
    pose: np.ndarray,
    noise: Noise,
    options: RefineOptions,
) -> SharedErrors:
    """Return what errors that parts of the view share do at a pose (3, 4)."""
    weighting = kernels.residual_noise(*noise, options.cutoff)
    tile = tile_size(grid.size, options.tiles)
    pulls = tile_pulls(
        grid.samples,
        grid.shape,
        pose,
        grid.K,
        weighting,
        tile,
        (at.tiles.shape[0], at.tiles.shape[1]),
    )
    coherent = coherent_fraction(
        grid.samples, grid.shape.rows, grid.shape.columns, pose, grid.K, weighting
    )
    return SharedErrors(pulls * at.external_sum, coherent)
