"""What comes out: a motion with status and covariance, a network's prediction, a tracked step."""

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

NOTHING = np.diag([1e4] * 3 + [10.0] * 3)
"""Covariance that carries no information, m^2 and rad^2."""


class State(enum.Enum):
    """The outcome of an estimate."""

    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


class Reason(enum.Enum):
    """Why an estimate is degraded or failed."""

    NONE = ""
    LOW_INLIERS = "low_inliers"
    DEGENERATE_GEOMETRY = "degenerate_geometry"
    NO_VALID_DEPTH = "no_valid_depth"
    NO_FLOW = "no_flow"
    MISSING_FRAME = "missing_frame"
    SOLVER_DIVERGED = "solver_diverged"
    NAN_INPUT = "nan_input"
    AMBIGUOUS_MOTION = "ambiguous_motion"
    CONTRADICTED = "contradicted"  # by the images, or by the depth maps


@dataclass(frozen=True)
class Status:
    """The state of an estimate, its reason, and a sentence that explains it."""

    state: State = State.OK
    reason: Reason = Reason.NONE
    message: str = ""

    @property
    def ok(self) -> bool:
        """Whether the estimate is neither degraded nor failed."""
        return self.state is State.OK

    @property
    def usable(self) -> bool:
        """Whether the estimate did not fail. A degraded one has a wider covariance."""
        return self.state is not State.FAILED

    @classmethod
    def degraded(cls, reason: Reason, message: str) -> Status:
        """Return the status of an estimate that may be used with care."""
        return cls(State.DEGRADED, reason, message)

    @classmethod
    def failed(cls, reason: Reason, message: str) -> Status:
        """Return the status of an estimate that must not be used."""
        return cls(State.FAILED, reason, message)

    def __str__(self) -> str:
        return self.state.value + (f"({self.reason.value})" if self.reason.value else "")


class StageFailed(Exception):
    """A stage of the pipeline found no answer; the pipeline turns it into a failed status."""

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """What is known of a motion before the pair is seen: one start among others, and a cue."""

    T_curr_prev: np.ndarray  # (4, 4)
    covariance: np.ndarray  # (6, 6) positive definite, in the order of a RelativePose's

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
    """The motion that a network predicts, and where it takes the scene to be static."""

    T_curr_prev: np.ndarray  # (4, 4)
    static_probability: np.ndarray  # (h, w) from 0 to 1, over the whole image


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One strong motion in the image, which may be the camera's or an object's."""

    T_curr_prev: np.ndarray  # (4, 4)
    source: str  # how it was found: start, window, minimal, runner-up, refit
    inlier_ratio: float  # share of the valid pixels that follow this motion
    flow_noise_px: float  # standard deviation of the flow about this motion
    depth_noise: float  # standard deviation of log depth
    inliers: np.ndarray  # (h, w) from 0 to 1, robust weights on a grid over the image
    score: float = 0.0  # the larger, the more probably it is the camera's


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The camera motion of a pair, which every estimator returns; the identity where it failed.

    ``T_curr_prev`` (4, 4) is in metres. ``covariance`` (6, 6) is that of delta in
    ``Exp(delta) T_curr_prev``, delta = (translation, rotation) in the current camera; m^2, m rad,
    rad^2.
    """

    T_curr_prev: np.ndarray = field(default_factory=lambda: np.eye(4))
    covariance: np.ndarray = field(default_factory=lambda: np.eye(6))
    status: Status = field(default_factory=Status)
    inlier_ratio: float = 0.0  # share of the valid pixels that follow the motion
    iterations: int = 0  # Gauss-Newton steps
    cost: float = 0.0  # final robust cost per valid pixel, dimensionless
    residual_scale_px: float = 0.0  # standard deviation of the flow at a pixel of typical variance
    depth_noise: float = 0.0  # standard deviation of log depth, likewise
    weights: np.ndarray | None = None  # (H, W) float32 robust weight of each pixel
    probability: float = 1.0  # that this is the camera's motion and not an object's; 0 if failed
    evidence: tuple[float, ...] = ()  # of which the probability is a function, where it is one
    hypotheses: tuple[Hypothesis, ...] = ()  # every strong motion found, the chosen one first
    method: str = ""
    ms: float = 0.0  # time spent, milliseconds
    terms: tuple[str, ...] = ()  # what it is based on: flow, depth (of the current frame), images
    photometric: PhotometricReport | None = None  # what the photometric refinement did, if asked

    ok = property(attrgetter("status.ok"))
    usable = property(attrgetter("status.usable"))

    @property
    def T_prev_curr(self) -> np.ndarray:
        """The inverse of ``T_curr_prev``, which the "between" factor of a pose graph expects."""
        return invert(self.T_curr_prev)

    @classmethod
    def failed(cls, reason: Reason, message: str, method: str = "", **extra: Any) -> RelativePose:
        """Return a failed estimate: the identity, with a covariance that says nothing."""
        return cls(
            covariance=NOTHING.copy(),
            status=Status.failed(reason, message),
            method=method,
            probability=0.0,
            **extra,
        )

    def replace(self, **changes: Any) -> RelativePose:
        """Return a copy with some fields changed."""
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
    """One tracked frame. The world is the first camera unless it was set."""

    index: int
    timestamp: float  # seconds
    T_world_cam: np.ndarray  # (4, 4) camera to world
    motion: RelativePose  # of the first frame the identity, with status ok
    prev_index: int | None  # frame the motion starts from: the last that it could; None: the first

    ok = property(attrgetter("motion.ok"))
    usable = property(attrgetter("motion.usable"))
    probability = property(attrgetter("motion.probability"))
    status = property(attrgetter("motion.status"))
    covariance = property(attrgetter("motion.covariance"))
    T_curr_prev = property(attrgetter("motion.T_curr_prev"))
    T_prev_curr = property(attrgetter("motion.T_prev_curr"))


@dataclass(frozen=True, eq=False)
class PixelwisePrediction:
    """A network's raw output for a batch of pairs: T_curr_prev at every pixel (paper, 3.2).

    The six channels are Euler angles X-Y-Z in degrees, R = Rx Ry Rz, and the translation in metres.
    VONet's maps have one pixel.
    """

    motion: torch.Tensor  # (B, 6, h, w)
    log_scale: torch.Tensor | None = None  # (B, 6, h, w) s = log U, where U is the Laplace scale
    image_size: tuple[int, int] | None = None  # (H, W) of the pairs that the network was given
    lead: torch.Tensor | None = None  # (B,) by how much s rises under other motions, if any

    @property
    def rotation(self) -> torch.Tensor:
        """The Euler angles, (B, 3, h, w), degrees."""
        return self.motion[:, :3]

    @property
    def translation(self) -> torch.Tensor:
        """The translations, (B, 3, h, w), metres."""
        return self.motion[:, 3:]


def probability_right(evidence: Sequence[float], weights: Sequence[float]) -> float:
    """Return the probability that a motion is right: logistic in its evidence.

    There is a weight for each evidence, and a last one that stands alone.
    """
    return float(expit(np.dot(weights, (*evidence, 1.0))))
