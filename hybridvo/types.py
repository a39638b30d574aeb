"""The types: camera, frame, pair, prior, prediction, hypothesis, relative pose, status and step.

Conventions (pinned in ``tests/test_conventions.py``): ``T_target_source`` maps homogeneous points
of ``source`` into ``target``; camera axes x right, y down, z forward; pixel (0, 0) is the centre of
the top-left pixel; depth is z in metres with NaN, inf, zero and negative values invalid; flow is in
pixels from the previous to the current frame, on the previous grid; tangent vectors are
(translation, rotation) of a left perturbation in the current camera.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridvo.checks import as_float_image, as_number, as_rigid, to_numpy
from hybridvo.errors import InputError

if TYPE_CHECKING:
    import torch

    from hybridvo.refinement.photometric import PhotometricReport

MAX_PIXELS = 2**28
"""Largest image, in pixels, that a frame or a file header may declare."""
FOCAL_RANGE = (1e-3, 1e9)
"""Focal lengths in pixels whose inverses and squares single precision can hold."""


@dataclass(frozen=True)
class Camera:
    """Pinhole camera without distortion.

    Args:
        fx, fy: focal lengths in pixels, positive.
        cx, cy: principal point in pixels; (0, 0) is the centre of the top-left pixel.
        height, width: image size in pixels.

    Raises:
        InputError: a value that is not finite, a focal length outside ``FOCAL_RANGE``, an image
            size that is not positive, or a principal point farther than one image size outside.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            number = as_number(value)
            if not np.isfinite(number):
                raise InputError(f"Camera.{name}: expected a finite number, got {value!r}.")
            object.__setattr__(self, name, number)
        for name in ("height", "width"):
            value = getattr(self, name)
            number = as_number(value)
            if isinstance(value, bool) or not 0 < number < np.inf or number % 1:
                raise InputError(f"Camera.{name}: expected a positive integer, got {value!r}.")
            object.__setattr__(self, name, int(number))
        if self.height * self.width > MAX_PIXELS:
            raise InputError(
                f"Camera: {self.width}x{self.height} pixels is above the limit of {MAX_PIXELS}."
            )
        for name in ("fx", "fy"):
            if not FOCAL_RANGE[0] <= getattr(self, name) <= FOCAL_RANGE[1]:
                raise InputError(
                    f"Camera.{name}: expected a positive focal length in pixels ({FOCAL_RANGE[0]:g}"
                    f" to {FOCAL_RANGE[1]:g}), got {getattr(self, name)}."
                )
        for name, size in (("cx", self.width), ("cy", self.height)):
            value = getattr(self, name)
            if not -size <= value <= 2 * size:
                raise InputError(
                    f"Camera.{name}: {value} lies far outside an image of {size} pixels. "
                    f"Are the intrinsics those of this image size?"
                )

    @classmethod
    def from_matrix(cls, K: np.ndarray, height: int, width: int) -> Camera:
        """Camera from a 3x3 intrinsic matrix without skew.

        Raises:
            InputError: not 3x3, not finite, skewed, or with a last row other than (0, 0, 1).
        """
        K = to_numpy(K, "Camera")
        if K.shape != (3, 3) or K.dtype.kind not in "fiu" or not np.isfinite(K).all():
            raise InputError(f"Camera: expected a finite 3x3 intrinsic matrix, got {K.tolist()}.")
        K = K.astype(np.float64)
        tolerance = 1e-6 * max(abs(K[0, 0]), abs(K[1, 1]), 1.0)
        if not np.allclose(K[2], (0, 0, 1)) or abs(K[0, 1]) > tolerance or abs(K[1, 0]) > tolerance:
            raise InputError(
                f"Camera: expected K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}."
            )
        return cls(K[0, 0], K[1, 1], K[0, 2], K[1, 2], height, width)

    @property
    def K(self) -> np.ndarray:
        """Intrinsic matrix, (3, 3) float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D frame.

    Args:
        rgb: (H, W, 3) uint8, or None where only depth and flow are used. (H, W) and (H, W, 1) gray
            images are accepted and repeated.
        depth: (H, W) float metres along the optical axis; NaN, inf, 0 and negative are invalid.
            None where the sensor delivered none: the pair then ends as ``failed(no_valid_depth)``.
        camera: pinhole intrinsics of this very image size.
        timestamp: seconds. Values above 1e14 are nanoseconds and are converted by the readers.
        index: position in its sequence; None: the tracker counts.
        depth_variance: (H, W) float, variance of log depth (relative variance), or None.
        mask: (H, W) bool, True where pixels may be used, or None.

    Raises:
        InputError: shapes that do not match the camera, wrong dtypes, a stamp that is not finite,
            an index that is no whole number.
    """

    rgb: np.ndarray | None
    depth: np.ndarray | None
    camera: Camera
    timestamp: float = 0.0
    index: int = None  # type: ignore[assignment]  # None: the tracker counts
    depth_variance: np.ndarray | None = None
    mask: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera):
            raise InputError(f"Frame.camera: expected a Camera, got {type(self.camera).__name__}.")
        if self.rgb is not None:
            rgb = to_numpy(self.rgb, "Frame.rgb")
            if rgb.dtype != np.uint8:
                raise InputError(f"Frame.rgb: expected uint8 values 0..255, got dtype {rgb.dtype}.")
            if rgb.ndim == 2 or (rgb.ndim == 3 and rgb.shape[2] == 1):
                rgb = np.repeat(rgb.reshape(*rgb.shape[:2], 1), 3, axis=2)
            if rgb.ndim != 3 or rgb.shape[2] != 3:
                raise InputError(
                    f"Frame.rgb: expected shape (H, W, 3), got {rgb.shape}. "
                    f"Images are height, width, channels, in RGB order."
                )
            self._check_size("rgb", rgb)
            object.__setattr__(self, "rgb", rgb)
        for name in ("depth", "depth_variance"):
            if getattr(self, name) is not None:
                array = as_float_image(getattr(self, name), f"Frame.{name}", None)
                self._check_size(name, array)
                object.__setattr__(self, name, array)
        if self.mask is not None:
            mask = to_numpy(self.mask, "Frame.mask")
            if mask.dtype != np.bool_ or mask.ndim != 2:
                raise InputError(
                    f"Frame.mask: expected a boolean (H, W) array, got {mask.dtype} {mask.shape}."
                )
            self._check_size("mask", mask)
            object.__setattr__(self, "mask", mask)
        stamp = as_number(self.timestamp)
        if not np.isfinite(stamp):
            raise InputError(f"Frame.timestamp: expected finite seconds, got {self.timestamp!r}.")
        object.__setattr__(self, "timestamp", stamp)
        if self.index is not None:
            if as_number(self.index) % 1:
                raise InputError(f"Frame.index: expected a whole number, got {self.index!r}.")
            object.__setattr__(self, "index", int(self.index))

    def _check_size(self, name: str, array: np.ndarray) -> None:
        if array.shape[:2] != self.camera.shape:
            raise InputError(
                f"Frame.{name}: expected shape {self.camera.shape} to match the camera, got "
                f"{array.shape[:2]}. Resize with hybridvo.data.resize.resize_frame, which also "
                f"scales the camera."
            )


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames with the optical flow between them: what every estimator takes.

    Ground-truth motion is no part of it. ``flow_source`` and ``depth_source`` name where the inputs
    come from; ``file`` flow of a synthetic data set is true flow, and every report says so.

    Args:
        prev, curr: frames t and t+1, each with its own camera.
        flow: (H, W, 2) float pixels, previous to current, on the previous grid; NaN is invalid.
            None where no flow could be had: the pair then ends as ``failed(no_flow)``.
        flow_variance: (H, W) float px^2 per component, relative or absolute, or None.
        flow_valid: (H, W) bool, False where the flow is known to be wrong (occluded), or None.
        flow_source: ``file``, ``dis``, or the name of a callable.
        flow_is_true: whether the flow is ground truth (an oracle).
        depth_source: ``sensor``, ``true`` (synthetic, an oracle), ``stereo``.

    Raises:
        InputError: shapes that do not match.
    """

    prev: Frame
    curr: Frame
    flow: np.ndarray | None
    flow_variance: np.ndarray | None = None
    flow_valid: np.ndarray | None = None
    flow_source: str = "unknown"
    flow_is_true: bool = False
    depth_source: str = "unknown"

    def __post_init__(self) -> None:
        for name in ("prev", "curr"):
            if not isinstance(getattr(self, name), Frame):
                got = type(getattr(self, name)).__name__
                raise InputError(f"FramePair.{name}: expected a Frame, got {got}.")
        shape = self.prev.camera.shape
        if self.curr.camera.shape != shape:
            raise InputError(
                f"FramePair: the previous frame is {shape}, the current one "
                f"{self.curr.camera.shape} (height, width). All frames must have one size; resize "
                f"with hybridvo.data.resize.resize_frame."
            )
        for name, channels in (("flow", 2), ("flow_variance", None)):
            if getattr(self, name) is not None:
                array = as_float_image(getattr(self, name), f"FramePair.{name}", channels)
                self._check(name, array, shape)
        if self.flow_valid is not None:
            valid = to_numpy(self.flow_valid, "FramePair.flow_valid")
            if valid.dtype != np.bool_:
                raise InputError(f"FramePair.flow_valid: expected bool, got dtype {valid.dtype}.")
            self._check("flow_valid", valid, shape)

    def _check(self, name: str, array: np.ndarray, shape: tuple[int, int]) -> None:
        if array.shape[:2] != shape:
            raise InputError(
                f"FramePair.{name}: expected {shape} (height, width) to match the frames, "
                f"got {array.shape[:2]}."
            )
        object.__setattr__(self, name, array)


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

    Args:
        T_curr_prev: (4, 4) rigid transform, metres.
        covariance: (6, 6) positive definite, of ``Exp(delta) T_curr_prev``, delta = (translation,
            rotation) in the current camera; m^2, m rad, rad^2.

    Raises:
        InputError: no rigid transform, or no positive definite covariance.
    """

    T_curr_prev: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_curr_prev", as_rigid(self.T_curr_prev, "MotionPrior"))
        covariance = to_numpy(self.covariance, "MotionPrior.covariance")
        if covariance.shape != (6, 6) or covariance.dtype.kind not in "fiu":
            raise InputError(
                f"MotionPrior.covariance: expected numbers of shape (6, 6), got "
                f"{covariance.dtype} of shape {covariance.shape}. A prior needs one: how far may "
                f"the motion be from it?"
            )
        covariance = covariance.astype(np.float64)
        if not (np.isfinite(covariance).all() and np.allclose(covariance, covariance.T)):
            raise InputError("MotionPrior.covariance: expected a finite, symmetric matrix.")
        if not np.linalg.eigvalsh(covariance)[0] > 0:
            raise InputError(
                "MotionPrior.covariance: expected a positive definite matrix, got one with the "
                f"smallest eigenvalue {np.linalg.eigvalsh(covariance)[0]:.3g}."
            )
        object.__setattr__(self, "covariance", covariance)

    def __repr__(self) -> str:
        sigma = np.sqrt(np.diag(self.covariance))
        return f"MotionPrior({_motion(self.T_curr_prev)}, sigma {_sizes(sigma[:3], sigma[3:])})"


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """A network's prediction for one pair.

    Args:
        T_curr_prev: (4, 4) metres.
        static_probability: (h, w) of every pixel of being static, 0 to 1, over the whole image at
            any resolution.
        covariance: (6, 6) of ``Exp(delta) T_curr_prev``, or None.
    """

    T_curr_prev: np.ndarray
    static_probability: np.ndarray
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One strong motion found in the image.

    Args:
        T_curr_prev: (4, 4).
        source: which start led here (``identity``, ``prior``, ``window``, ``minimal``, ``refit``).
        inlier_ratio: share of the valid pixels that follow this motion.
        flow_noise_px: standard deviation of the flow about it, px. depth_noise: of log depth.
        inliers: (h, w) float32 in [0, 1], robust weight of each pixel under this motion, on the
            grid of ``stride``.
        stride: px of the full image per step of that grid.
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

    def __repr__(self) -> str:
        return (
            f"Hypothesis({self.source}, {_motion(self.T_curr_prev)}, "
            f"inliers {100 * self.inlier_ratio:.0f} %, score {self.score:.3g})"
        )


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
        residual_scale_px: estimated standard deviation of the flow noise, px, where variances were
            handed in at a pixel of the typical one.
        depth_noise: of the log depth, likewise.
        weights: (h, w) float32 robust weight of each pixel on the grid of ``weights_stride``.
        translation_direction_valid: whether the translation is longer than three of its own
            standard deviations; its direction means nothing otherwise.
        information_eigenvalues: (6,) ascending, of the information matrix scaled to pixels.
        probability: that this is the camera's motion and not an object's, 0 to 1; 0 if failed.
        hypotheses: every strong motion found, the chosen one first.
        method: name of the estimator. ms: time spent, milliseconds.
        terms: what carried the motion: ``flow``, ``depth`` (of the current frame), ``images``,
            ``window`` (key frames).
        photometric: :class:`hybridvo.refinement.photometric.PhotometricReport` where the images
            took part or were refused, or None.
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
    weights_stride: int = 1
    translation_direction_valid: bool = False
    information_eigenvalues: np.ndarray = field(default_factory=lambda: np.zeros(6))
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
        """Whether this is a measurement: not failed. The covariance of a degraded one is wider."""
        return self.status.usable

    @property
    def T_prev_curr(self) -> np.ndarray:
        """Inverse of ``T_curr_prev``: what a pose-graph "between" factor wants."""
        R, t = self.T_curr_prev[:3, :3], self.T_curr_prev[:3, 3]
        T = np.eye(4)
        T[:3, :3] = R.T
        T[:3, 3] = -R.T @ t
        return T

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
        return (
            f"RelativePose({self.method or 'motion'}: {self.status}, {_motion(self.T_curr_prev)}, "
            f"sigma {_sizes(sigma[:3], sigma[3:])}, inliers {100 * self.inlier_ratio:.0f} %, "
            f"probability {self.probability:.2f})"
        )


@dataclass(frozen=True, eq=False)
class Step:
    """One tracked frame of :class:`hybridvo.Odometry`.

    Args:
        index, timestamp: of the current frame.
        T_world_cam: (4, 4) camera to world; world = first camera unless set.
        motion: relative pose from the previous frame; identity with status ok for the first frame.
    """

    index: int
    timestamp: float
    T_world_cam: np.ndarray
    motion: RelativePose

    @property
    def ok(self) -> bool:
        """Whether the motion is neither degraded nor failed."""
        return self.motion.ok

    @property
    def usable(self) -> bool:
        """Whether the motion did not fail."""
        return self.motion.usable

    @property
    def probability(self) -> float:
        """That the motion is the camera's, 0 to 1."""
        return self.motion.probability

    @property
    def status(self) -> Status:
        """Status of the motion."""
        return self.motion.status

    @property
    def T_curr_prev(self) -> np.ndarray:
        """(4, 4) points of the previous camera into the current one."""
        return self.motion.T_curr_prev

    @property
    def T_prev_curr(self) -> np.ndarray:
        """(4, 4) pose of the current camera in the previous one."""
        return self.motion.T_prev_curr

    @property
    def covariance(self) -> np.ndarray:
        """(6, 6) covariance of the motion."""
        return self.motion.covariance

    def __repr__(self) -> str:
        x, y, z = self.T_world_cam[:3, 3]
        return (
            f"Step({self.index}, t {self.timestamp:.3f} s, at [{x:.3f} {y:.3f} {z:.3f}] m, "
            f"{self.motion!r})"
        )


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


@dataclass(frozen=True, eq=False)
class PairBatch:
    """A batch of pairs as torch tensors: the differentiable, batched input.

    Args:
        flow: (B, H, W, 2) px. depth_prev: (B, H, W) metres; values that are not finite and positive
            are invalid. K_prev, K_curr: (B, 3, 3).
        depth_curr: (B, H, W) metres on the current grid, or None.
        flow_variance: (B, H, W) px^2 or None. depth_variance: (B, H, W) of log depth, or None.
        valid: (B, H, W) bool or None.
    """

    flow: torch.Tensor
    depth_prev: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor
    depth_curr: torch.Tensor | None = None
    flow_variance: torch.Tensor | None = None
    depth_variance: torch.Tensor | None = None
    valid: torch.Tensor | None = None

    @classmethod
    def from_pairs(
        cls,
        pairs: Sequence[FramePair],
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> PairBatch:
        """A batch of numpy pairs of one size; what a pair lacks is NaN, that is, invalid.

        Args:
            pairs: at least one.
            device: of the tensors; the CPU by default.
            dtype: their type; float32 by default.

        Raises:
            InputError: no pair, or pairs of several sizes.
        """
        import torch

        sizes = {pair.prev.camera.shape for pair in pairs}
        if len(sizes) != 1:
            raise InputError(
                f"PairBatch.from_pairs: expected pairs of one size, got {sorted(sizes)}."
            )
        size = sizes.pop()

        def stack(values: list[Any], lacking: float = np.nan) -> Any:
            given = [value for value in values if value is not None]
            if not given:
                return None
            absent = np.full(given[0].shape, lacking, np.float32)
            array = np.stack([absent if value is None else value for value in values])
            return torch.as_tensor(array, device=device).to(dtype or torch.float32)

        def masked(array: np.ndarray | None, mask: np.ndarray | None) -> np.ndarray | None:
            if array is None or mask is None:
                return array
            return np.where(mask, array, np.float32(np.nan))

        valid = np.ones((len(pairs), *size), np.bool_)
        for k, pair in enumerate(pairs):
            for mask in (pair.prev.mask, pair.flow_valid):
                valid[k] &= True if mask is None else mask
        no_flow, no_depth = np.full((*size, 2), np.nan), np.full(size, np.nan)
        return cls(
            flow=stack([no_flow if p.flow is None else p.flow for p in pairs]),
            depth_prev=stack([no_depth if p.prev.depth is None else p.prev.depth for p in pairs]),
            K_prev=stack([p.prev.camera.K for p in pairs]),
            K_curr=stack([p.curr.camera.K for p in pairs]),
            depth_curr=stack([masked(p.curr.depth, p.curr.mask) for p in pairs]),
            # a pair without variances beside one with them has those of a typical pixel
            flow_variance=stack([p.flow_variance for p in pairs], 1.0),
            depth_variance=stack([p.prev.depth_variance for p in pairs], 1.0),
            valid=torch.as_tensor(valid, device=device),
        )


def _sizes(metres: np.ndarray, radians: np.ndarray) -> str:
    return f"{np.linalg.norm(metres):.3g} m {np.rad2deg(np.linalg.norm(radians)):.3g} deg"


def _motion(T: np.ndarray) -> str:
    """Translation and angle of a (4, 4) transform, for a line of print."""
    x, y, z = T[:3, 3]
    sine = np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
    angle = np.arctan2(np.linalg.norm(sine), np.trace(T[:3, :3]) - 1)
    return f"t [{x:.4f} {y:.4f} {z:.4f}] m, {np.rad2deg(angle):.3f} deg"
