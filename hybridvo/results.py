"""What comes out: status, motions with covariance, predictions of networks, and tracked steps."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import expit

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
    """What is known of a motion before the pair is seen: one start among others, and a cue."""

    T_curr_prev: np.ndarray
    covariance: np.ndarray  # (6, 6) positive definite, as that of a RelativePose

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


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One strong motion found in the image."""

    T_curr_prev: np.ndarray
    source: str  # what led here: start, window, minimal, runner-up, refit
    inlier_ratio: float  # share of the valid pixels that follow this motion
    flow_noise_px: float  # standard deviation of the flow about it
    depth_noise: float  # of log depth
    inliers: np.ndarray  # (h, w) in [0, 1], robust weight of every ``stride``-th pixel
    stride: int
    score: float = 0.0  # by which the camera's motion was chosen; larger is better


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Camera motion of one pair: the result of every estimator; the identity where that failed.

    ``T_curr_prev`` (4, 4) is in metres, ``covariance`` (6, 6) that of ``Exp(delta) T_curr_prev``,
    delta = (translation, rotation) in the current camera; m^2, m rad, rad^2.
    """

    T_curr_prev: np.ndarray = field(default_factory=lambda: np.eye(4))
    covariance: np.ndarray = field(default_factory=lambda: np.eye(6))
    status: Status = field(default_factory=Status)
    inlier_ratio: float = 0.0  # share of the valid pixels that follow the motion
    iterations: int = 0  # Gauss-Newton steps
    cost: float = 0.0  # final robust cost per valid pixel, dimensionless
    residual_scale_px: float = 0.0  # standard deviation of the flow at a pixel of typical variance
    depth_noise: float = 0.0  # of the log depth, likewise
    weights: np.ndarray | None = None  # (H, W) float32 robust weight of each pixel
    probability: float = 1.0  # that this is the camera's motion and not an object's; 0 if failed
    hypotheses: tuple[Hypothesis, ...] = ()  # every strong motion found, the chosen one first
    method: str = ""
    ms: float = 0.0  # time spent, milliseconds
    terms: tuple[str, ...] = ()  # what carried it: flow, depth (of the current frame), images
    photometric: PhotometricReport | None = None  # what came of the images, where asked

    ok = property(attrgetter("status.ok"))
    usable = property(attrgetter("status.usable"))

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

    The world is the first camera unless set; the first motion is the identity with status ok.
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
    """Raw output of a network for a batch of pairs: T_curr_prev at every pixel (paper, 3.2).

    Channels: Euler angles X-Y-Z in degrees, R = Rx Ry Rz, then metres. VONet's maps have one pixel.
    """

    motion: torch.Tensor  # (B, 6, h, w)
    log_scale: torch.Tensor | None = None  # (B, 6, h, w) s = log U, U the Laplace scale of each
    image_size: tuple[int, int] | None = None  # (H, W) of the pairs that the network was given

    @property
    def rotation(self) -> torch.Tensor:
        """(B, 3, h, w) degrees."""
        return self.motion[:, :3]

    @property
    def translation(self) -> torch.Tensor:
        """(B, 3, h, w) metres."""
        return self.motion[:, 3:]


def right(evidence: Sequence[float], weights: Sequence[float]) -> float:
    """Probability that a motion is right: logistic in its evidence; the last weight is alone."""
    return float(expit(np.dot(weights, (*evidence, 1.0))))
