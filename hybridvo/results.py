"""What comes out: status, motions with covariance, predictions of networks, and tracked steps."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import exp
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import invert, rotation_angle
from hybridvo.types import as_rigid, to_numpy

if TYPE_CHECKING:
    import torch

    from hybridvo.images.photometric import PhotometricReport


class State(enum.Enum):
    """Outcome of one estimate."""

    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


class Reason(enum.Enum):
    """Why an estimate is not simply ok."""

    NONE = ""
    LOW_INLIERS = "low_inliers"
    DEGENERATE_GEOMETRY = "degenerate_geometry"
    NO_VALID_DEPTH = "no_valid_depth"
    NO_FLOW = "no_flow"
    MISSING_FRAME = "missing_frame"
    SOLVER_DIVERGED = "solver_diverged"
    NAN_INPUT = "nan_input"
    AMBIGUOUS_MOTION = "ambiguous_motion"


@dataclass(frozen=True)
class Status:
    """State, reason and a sentence that explains it."""

    state: State = State.OK
    reason: Reason = Reason.NONE
    message: str = ""

    @property
    def ok(self) -> bool:
        """Whether the state is OK: neither degraded nor failed."""
        return self.state is State.OK

    @property
    def usable(self) -> bool:
        """Whether there is an estimate: not failed. A degraded one has a wider covariance."""
        return self.state is not State.FAILED

    @classmethod
    def degraded(cls, reason: Reason, message: str) -> Status:
        """An estimate that may be used with care."""
        return cls(State.DEGRADED, reason, message)

    @classmethod
    def failed(cls, reason: Reason, message: str) -> Status:
        """An estimate that must not be used."""
        return cls(State.FAILED, reason, message)

    def __str__(self) -> str:
        return self.state.value + (f"({self.reason.value})" if self.reason.value else "")


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """What is known of a motion before the pair is seen: one start among others, and a cue.

    The covariance (6, 6), positive definite, is that of a :class:`RelativePose`.
    """

    T_curr_prev: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_curr_prev", as_rigid(self.T_curr_prev, "MotionPrior"))
        C = to_numpy(self.covariance, "MotionPrior.covariance")
        fits = C.shape == (6, 6) and C.dtype.kind in "fiu" and bool(np.isfinite(C).all())
        if not fits or not np.allclose(C, C.T) or not np.linalg.eigvalsh(C)[0] > 0:
            expected = "a positive definite matrix of shape (6, 6), symmetric and finite"
            raise InputError(f"MotionPrior.covariance: expected {expected}, got {C.tolist()}.")
        object.__setattr__(self, "covariance", C.astype(np.float64))


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """A network's prediction; ``static_probability`` (h, w), 0 to 1, covers the whole image."""

    T_curr_prev: np.ndarray
    static_probability: np.ndarray
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One strong motion found in the image.

    Args:
        source: what led here (``start``, ``window``, ``minimal``, ``runner-up``, ``refit``).
        inlier_ratio: share of the valid pixels that follow this motion.
        flow_noise_px: standard deviation of the flow about it, px. depth_noise: of log depth.
        inliers: (h, w) float32 in [0, 1], robust weight of each pixel under this motion, on a grid
            with a step of ``stride`` px.
        score: by which the camera's motion was chosen; larger is better.
    """

    T_curr_prev: np.ndarray
    source: str
    inlier_ratio: float
    flow_noise_px: float
    depth_noise: float
    inliers: np.ndarray
    stride: int
    score: float = 0.0


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Camera motion of one pair: the result of every estimator.

    Args:
        T_curr_prev: (4, 4) float64, points of the previous camera into the current one; metres.
        covariance: (6, 6) of the left perturbation ``Exp(delta) T_curr_prev``, delta =
            (translation, rotation) in the current camera; m^2, m rad, rad^2.
        status: ok, degraded or failed with its reason. A failed motion is the identity.
        inlier_ratio: share of the valid pixels that follow the motion.
        iterations: Gauss-Newton steps spent (or RANSAC iterations).
        cost: final robust cost per valid pixel, dimensionless.
        residual_scale_px: standard deviation of the flow noise, px, at a pixel of the typical
            variance. depth_noise: of the log depth, likewise.
        weights: (H, W) float32 robust weight of each pixel.
        probability: that this is the camera's motion and not an object's, 0 to 1; 0 if failed.
        hypotheses: every strong motion found, the chosen one first.
        method: name of the estimator. ms: time spent, milliseconds.
        terms: what carried the motion: ``flow``, ``depth`` (of the current frame), ``images``.
        photometric: what came of the images, where they were asked.
    """

    T_curr_prev: np.ndarray = field(default_factory=lambda: np.eye(4))
    covariance: np.ndarray = field(default_factory=lambda: np.eye(6))
    status: Status = field(default_factory=Status)
    inlier_ratio: float = 0.0
    iterations: int = 0
    cost: float = 0.0
    residual_scale_px: float = 0.0
    depth_noise: float = 0.0
    weights: np.ndarray | None = None
    probability: float = 1.0
    hypotheses: tuple[Hypothesis, ...] = ()
    method: str = ""
    ms: float = 0.0
    terms: tuple[str, ...] = ()
    photometric: PhotometricReport | None = None

    @property
    def ok(self) -> bool:
        """Whether the status is OK: neither degraded nor failed."""
        return self.status.ok

    @property
    def usable(self) -> bool:
        """Whether this is a measurement: not failed."""
        return self.status.usable

    @property
    def T_prev_curr(self) -> np.ndarray:
        """Inverse of ``T_curr_prev``: what a pose-graph "between" factor wants."""
        return invert(self.T_curr_prev)

    @classmethod
    def failed(cls, reason: Reason, message: str, method: str = "", **extra: Any) -> RelativePose:
        """A failed estimate: identity with a covariance that carries no information."""
        return cls(
            covariance=np.diag([1e4] * 3 + [10.0] * 3),
            status=Status.failed(reason, message),
            method=method,
            probability=0.0,
            **extra,
        )

    def replace(self, **changes: Any) -> RelativePose:
        """Copy with some fields changed."""
        return replace(self, **changes)

    def __repr__(self) -> str:
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        x, y, z = self.T_curr_prev[:3, 3]
        degrees = np.rad2deg(rotation_angle(self.T_curr_prev[:3, :3]))
        return (
            f"RelativePose({self.method or 'motion'}: {self.status}, t [{x:.4f} {y:.4f} {z:.4f}] "
            f"+- {np.linalg.norm(sigma[:3]):.3g} m, {degrees:.3f} +- "
            f"{np.rad2deg(np.linalg.norm(sigma[3:])):.3g} deg, probability {self.probability:.2f})"
        )


@dataclass(frozen=True, eq=False)
class Step:
    """One tracked frame: camera to world (4, 4), and its motion from the frame before.

    The world is the first camera unless set; the first motion is the identity with status ok. What
    users ask a motion most can be asked of its step.
    """

    index: int
    timestamp: float
    T_world_cam: np.ndarray
    motion: RelativePose

    ok = property(attrgetter("motion.ok"))
    usable = property(attrgetter("motion.usable"))
    probability = property(attrgetter("motion.probability"))
    status = property(attrgetter("motion.status"))
    covariance = property(attrgetter("motion.covariance"))
    T_curr_prev = property(attrgetter("motion.T_curr_prev"))
    T_prev_curr = property(attrgetter("motion.T_prev_curr"))


@dataclass(frozen=True, eq=False)
class PixelwisePrediction:
    """Raw output of a pixel-wise network for a batch of pairs (paper, section 3.2).

    Args:
        rotation: (B, 3, h, w) Euler angles X-Y-Z in degrees (R = Rx Ry Rz), of T_curr_prev.
        translation: (B, 3, h, w) metres, of T_curr_prev.
        log_scale_rotation, log_scale_translation: (B, 3, h, w), s = log of the Laplace scale U, or
            None where the network predicts no uncertainty.
        image_size: (H, W) of the pairs that the network was given, or None.
    """

    rotation: torch.Tensor
    translation: torch.Tensor
    log_scale_rotation: torch.Tensor | None = None
    log_scale_translation: torch.Tensor | None = None
    image_size: tuple[int, int] | None = None


def right(evidence: Sequence[float], weights: Sequence[float]) -> float:
    """Probability that a motion is right: logistic in its evidence; the last weight is alone."""
    value = sum(w * x for w, x in zip(weights, (*evidence, 1.0), strict=True))
    return 1 / (1 + exp(min(-value, 700.0)))  # exp(700) is finite
