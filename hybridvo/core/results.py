"""Result types: motions with status and covariance, network predictions, tracked steps."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hybridvo.core.checks import as_rigid, to_numpy
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import invert, rotation_angle
from hybridvo.core.gravity import Gravity

if TYPE_CHECKING:
    import torch

# m and rad, of a step of a hand-held camera of which nothing is known: at most so
# large
IDENTITY_STD = (1.0, 0.3)

UNINFORMATIVE_COVARIANCE = np.diag([1e4, 1e4, 1e4, 10.0, 10.0, 10.0])
"""Covariance that carries no information, m^2 and rad^2."""

WEIGHT_STEPS = 255
"""Steps from 0 to 1 of the weights that a step keeps: a byte."""


class State(enum.Enum):
    """The outcome of an estimate.

    >>> State("degraded") is State.DEGRADED
    True
    """

    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


class Reason(enum.Enum):
    """Why an estimate is degraded or has failed.

    >>> Status.failed(Reason.NO_FLOW, "no optical flow").reason.value
    'no_flow'
    """

    NONE = ""
    LOW_INLIERS = "low_inliers"
    DEGENERATE_GEOMETRY = "degenerate_geometry"
    NO_VALID_DEPTH = "no_valid_depth"
    # the depth values cannot be metres
    DEPTH_UNIT = "depth_unit"
    NO_FLOW = "no_flow"
    MISSING_FRAME = "missing_frame"
    SOLVER_DIVERGED = "solver_diverged"
    AMBIGUOUS_MOTION = "ambiguous_motion"
    # the images or the depth maps contradict the motion
    CONTRADICTED = "contradicted"
    # the camera delivered an image or a depth map twice
    REPEATED_FRAME = "repeated_frame"
    # the depth map is a plane that the images do not show
    FALSE_DEPTH = "false_depth"
    # something nearer hides the static scene
    HIDDEN_WORLD = "hidden_world"
    # an object's pixels do not follow one rigid motion
    NOT_RIGID = "not_rigid"


@dataclass(frozen=True)
class Status:
    """The state of an estimate, the reason for it, and a message that explains it.

    Attributes:
        state: ok, degraded or failed.
        reason: why the estimate is not ok.
        message: an explanation for people; an ``ok`` estimate may have one as well.

    >>> print(Status.degraded(Reason.LOW_INLIERS, "30 of 1000 pixels"))
    degraded(low_inliers)
    """

    state: State = State.OK
    reason: Reason = Reason.NONE
    message: str = ""

    @property
    def ok(self) -> bool:
        """Whether the estimate is neither degraded nor failed."""
        return self.state is State.OK

    @property
    def usable(self) -> bool:
        """Whether the estimate may be used. A degraded one has a wider covariance."""
        return self.state is not State.FAILED

    @classmethod
    def degraded(cls, reason: Reason, message: str) -> Status:
        """Return the status of an estimate that may be used with care.

        Args:
            reason: why it is less certain.
            message: an explanation for people.

        Returns:
            The status.
        """
        return cls(State.DEGRADED, reason, message)

    @classmethod
    def failed(cls, reason: Reason, message: str) -> Status:
        """Return the status of an estimate that must not be used.

        Args:
            reason: why it failed.
            message: an explanation for people.

        Returns:
            The status.
        """
        return cls(State.FAILED, reason, message)

    def __str__(self) -> str:
        if not self.reason.value:
            return self.state.value
        return f"{self.state.value}({self.reason.value})"


class StageFailed(Exception):
    """A stage found no answer; the pipeline turns this into a failed status.

    Attributes:
        reason: why it found none.
        inlier_ratio: fraction of the pixels that follow the motion that was rejected.
    """

    def __init__(
        self, reason: Reason, message: str, inlier_ratio: float = 0.0
    ) -> None:
        super().__init__(message)
        self.reason = reason
        self.inlier_ratio = inlier_ratio


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """What is known about a motion independently of the pair, such as a prediction.

    The search uses it as one of several starting points, and the selection as a cue.

    Attributes:
        T_curr_prev: (4, 4) maps points from the previous camera to the current one,
            metres.
        covariance: (6, 6) positive definite, of delta in ``Exp(delta)
            T_curr_prev``, delta = (translation, rotation) in the current camera;
            m^2, m rad, rad^2.

    Raises:
        InputError: the pose is not rigid, or the covariance is not positive definite.

    >>> forward = np.eye(4)
    >>> forward[2, 3] = -0.1  # points come 10 cm closer, +- 2 cm and 0.01 rad
    >>> prior = MotionPrior(forward, np.diag([0.02**2] * 3 + [0.01**2] * 3))
    >>> prior.covariance.shape
    (6, 6)
    """

    T_curr_prev: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        T = as_rigid(self.T_curr_prev, "MotionPrior")
        object.__setattr__(self, "T_curr_prev", T)
        C = to_numpy(self.covariance, "MotionPrior.covariance")
        if not _is_covariance(C):
            expected = (
                "a positive definite matrix of shape (6, 6), symmetric and finite"
            )
            raise InputError(
                f"MotionPrior.covariance: expected {expected}, got {C.tolist()}."
            )
        object.__setattr__(self, "covariance", C.astype(np.float64))


def _is_covariance(C: np.ndarray) -> bool:
    """Whether an array is a (6, 6) matrix, finite, symmetric and positive definite."""
    if C.shape != (6, 6) or C.dtype.kind not in "fiu":
        return False
    if not np.isfinite(C).all() or not np.allclose(C, C.T):
        return False
    return bool(np.linalg.eigvalsh(C)[0] > 0)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A motion that many pixels follow: the camera's or an object's.

    Attributes:
        T_curr_prev: (4, 4) metres.
        source: how it was found: start, window, minimal, runner-up or refit.
        inlier_ratio: fraction of the valid pixels that follow this motion.
        flow_noise_px: standard deviation of the flow residuals under this motion, px.
        depth_noise: standard deviation of the log depth residuals under it.
        inliers: (h, w) robust weights from 0 to 1, on a grid over the image.
        score: the larger, the more likely the motion is the camera's.
        remembered: what earlier frames add to the score, at most 0.
    """

    T_curr_prev: np.ndarray
    source: str
    inlier_ratio: float
    flow_noise_px: float
    depth_noise: float
    inliers: np.ndarray
    score: float = 0.0
    remembered: float = 0.0


@dataclass(frozen=True, eq=False)
class PhotometricReport:
    """What the photometric refinement did with the images of a pair.

    Attributes:
        taken: whether the motion was changed.
        refusal: why the images were rejected, in words; empty if they were used,
            not tried, or added nothing.
        gain: brightness gain of the current image relative to the previous one.
        agreement: factor in (0, 1] by which disagreement between parts of the image
            reduced the information.
    """

    taken: bool = False
    refusal: str = ""
    gain: float = 1.0
    agreement: float = 1.0


@dataclass(frozen=True, eq=False)
class Rival:
    """One of several motions of a pair that may be the camera's: a mode of its distribution.

    Attributes:
        T_curr_prev: (4, 4) metres.
        covariance: (6, 6) of delta in ``Exp(delta) T_curr_prev``, if it is the camera's.
        evidence: what speaks for it, see :attr:`Motion.evidence`.
        probability: that it is the camera's; those of all rivals sum to at most one.

    >>> Rival(np.eye(4), 1e-6 * np.eye(6), probability=0.6).T_prev_curr.shape
    (4, 4)
    """

    T_curr_prev: np.ndarray
    covariance: np.ndarray
    evidence: tuple[float, ...] = ()
    probability: float = 0.0

    @property
    def T_prev_curr(self) -> np.ndarray:
        """The inverse (4, 4), as expected by the "between" factors of pose graphs."""
        return invert(self.T_curr_prev)


class Term(enum.StrEnum):
    """What a motion is based on."""

    FLOW = "flow"
    """A field of flow: a method ``on_images`` then refines it on the two images."""
    IMAGES = "images"
    """The two images, densely or by matches: without flow they are not asked whether they agree."""
    DEPTH = "depth"
    """Depth of the current frame; alone, no image has confirmed the motion."""
    GYROSCOPE = "gyroscope"
    MEMORY = "memory"
    """Only what is believed to be static confirms it."""
    EXPECTED = "expected"
    """What was expected decides a direction that depth leaves open."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A camera motion that a source found in a pair, and what speaks for it.

    The judge makes a :class:`RelativePose` of it, which has the same attributes, and states how
    probable it is; the status is here that of the source alone. Whoever makes one fills motion,
    covariance, ``terms``, ``weights`` (without them it is not held against images and depth maps)
    and ``evidence`` (without any its probability is 1).
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
    evidence: tuple[float, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    rivals: tuple[Rival, ...] = ()
    terms: tuple[Term, ...] = ()
    photometric: PhotometricReport | None = None

    @property
    def ok(self) -> bool:
        """Whether the motion is neither degraded nor failed."""
        return self.status.ok

    @property
    def usable(self) -> bool:
        """Whether the motion may be used. A degraded one has a wider covariance."""
        return self.status.usable

    @property
    def is_by_depth_alone(self) -> bool:
        """Whether neither images nor flow took part in a motion that was found."""
        found_by = {Term.IMAGES, Term.FLOW} & set(self.terms)
        return self.usable and Term.DEPTH in self.terms and not found_by

    @property
    def T_prev_curr(self) -> np.ndarray:
        """The inverse (4, 4), as expected by the "between" factors of pose graphs."""
        return invert(self.T_curr_prev)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed.

        Args:
            changes: new values by field name.

        Returns:
            The copy.
        """
        return replace(self, **changes)


@dataclass(frozen=True, eq=False)
class RelativePose(Motion):
    """The camera motion of a pair; the identity if the estimate failed.

    Attributes:
        T_curr_prev: (4, 4) maps points from the previous camera to the current one,
            metres.
        covariance: (6, 6) of delta in ``Exp(delta) T_curr_prev``, delta =
            (translation, rotation) in the current camera; m^2, m rad, rad^2.
        status: whether it may be used, and why not.
        inlier_ratio: fraction of the usable pixels, by weight, whose residual is within
            ``refine.cutoff`` standard deviations. The weights combine those passed in
            with the static mask; pixels that the mask removes count as outliers.
        iterations: number of Gauss-Newton steps.
        cost: final robust cost per valid pixel, dimensionless.
        residual_scale_px: standard deviation of the flow at a pixel of typical
            variance, px.
        depth_noise: standard deviation of log depth at such a pixel.
        weights: (H, W) float32 robust weight of each pixel, or None. Those of a step are kept to
            within 1/510.
        evidence: the numbers from which the probability is computed, if any. Their type says
            what they are, see :mod:`hybridvo.judge.probability`.
        hypotheses: every strong motion that was found, the selected one first.
        rivals: where it is degraded as an ambiguous motion: this motion as it was fitted, and the
            other one that may be the camera's, with their probabilities. The covariance above
            covers both.
        terms: what the motion is based on.
        photometric: what the photometric refinement did; None if it was not tried.
        probability: probability that this is the camera's motion rather than an
            object's; 0 if the estimate failed, NaN if a batch had no weights to
            compute it from.
        method: name of the method.
        ms: time spent, milliseconds.

    >>> ahead = np.eye(4)
    >>> ahead[2, 3] = -0.1  # the camera moved 10 cm forward, so points came closer
    >>> motion = RelativePose(ahead, covariance=1e-4 * np.eye(6))
    >>> motion.usable, float(motion.T_prev_curr[2, 3])
    (True, 0.1)
    """

    probability: float = 1.0
    method: str = ""
    ms: float = 0.0

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """A sort key that is larger for a more certain motion."""
        return self.ok, self.usable, self.probability

    @classmethod
    def failed(
        cls, reason: Reason, message: str, method: str = "", **extra: Any
    ) -> RelativePose:
        """Return a failed estimate: the identity, without information.

        Args:
            reason: why it failed.
            message: an explanation for people.
            method: name of the method that failed.
            extra: other fields.

        Returns:
            The estimate, with a covariance that carries no information.
        """
        return cls(
            covariance=UNINFORMATIVE_COVARIANCE.copy(),
            status=Status.failed(reason, message),
            method=method,
            probability=0.0,
            **extra,
        )

    def __repr__(self) -> str:
        return f"RelativePose({self.method or 'motion'}: {self._text()})"

    def _text(self) -> str:
        """The motion in words."""
        std_m, std_rad = stated_stds(self.covariance)
        std_deg = np.rad2deg(std_rad)
        x, y, z = self.T_curr_prev[:3, 3]
        degrees = np.rad2deg(rotation_angle(self.T_curr_prev[:3, :3]))
        return (
            f"{self.status}, t [{x:.4f} {y:.4f} {z:.4f}] +- {std_m:.3g} m, "
            f"{degrees:.3f} +- {std_deg:.3g} deg, probability {self.probability:.2f}"
        )


class StepMotion(RelativePose):
    """The motion of a step: its weights take a byte a pixel, since users keep all steps of a run.

    ``weights`` are made of these bytes when they are asked for, to within 1/510.

    Example:
        >>> import pickle
        >>> motion = RelativePose(weights=np.full((480, 640), 0.25, np.float32))
        >>> kept = StepMotion.of(motion)
        >>> kept.weights.shape, kept.weights.dtype.name, round(float(kept.weights[0, 0]), 2)
        ((480, 640), 'float32', 0.25)
        >>> len(pickle.dumps(kept)) < 310_000 < len(pickle.dumps(motion))
        True
    """

    @classmethod
    def of(cls, motion: RelativePose) -> StepMotion:
        """Return a motion as a step keeps it."""
        return cls(
            **{each.name: getattr(motion, each.name) for each in fields(motion)}
        )

    @property
    def weights(self) -> np.ndarray | None:
        """(H, W) float32 robust weight of each pixel, or None; a copy."""
        stored: np.ndarray | None = vars(self)["weight_bytes"]
        return None if stored is None else stored / np.float32(WEIGHT_STEPS)

    @weights.setter
    def weights(self, value: np.ndarray | None) -> None:
        if value is not None:
            value = np.rint(WEIGHT_STEPS * np.clip(value, 0, 1)).astype(np.uint8)
        vars(self)["weight_bytes"] = value


@dataclass(frozen=True, eq=False)
class MovingObject:
    """An object that moves on its own, as seen in one frame.

    Attributes:
        id: its number, starting at 1; constant while the object is tracked.
        mask: (H, W) bool, its pixels in the current frame; all False while it is hidden.
        T_curr_prev: (4, 4) maps the object's points from the previous camera to the current
            one, metres: the camera's motion and the object's own motion combined.
        covariance: (6, 6) of delta in ``Exp(delta) T_curr_prev``, as in :class:`RelativePose`.
        status: whether its motion may be used: degraded if the object is not rigid, failed if
            the motion is only a prediction.
        confidence: probability that something moves on its own here.
        age: frames since it was first seen; 0 in the first one.
        hidden: frames since it was last seen; 0 while it is visible.
        fraction: fraction of the image that it covers.
        inlier_ratio: fraction of its pixels that follow its motion.
        centre: (3,) centre of its visible surface in the current camera, metres.
        size: (3,) extent of that surface along the camera axes, metres.

    >>> aside = np.eye(4)
    >>> aside[0, 3] = 0.05  # 5 cm to the right, seen by a camera at rest
    >>> mask = np.zeros((60, 80), bool)
    >>> mask[20:40, 30:60] = True
    >>> cup = MovingObject(1, mask, aside, 1e-6 * np.eye(6), Status(), confidence=0.9)
    >>> cup.T_own(np.eye(4))[:3, 3].tolist()
    [0.05, 0.0, 0.0]
    """

    id: int
    mask: np.ndarray
    T_curr_prev: np.ndarray
    covariance: np.ndarray
    status: Status
    confidence: float
    age: int = 0
    hidden: int = 0
    fraction: float = 0.0
    inlier_ratio: float = 0.0
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    size: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def is_seen(self) -> bool:
        """Whether the object is visible in the frame; otherwise its motion is predicted."""
        return self.hidden == 0

    def T_own(self, T_camera: np.ndarray) -> np.ndarray:
        """Return the object's own motion, without that of the camera.

        Args:
            T_camera: (4, 4) ``T_curr_prev`` of the camera between the same two frames.

        Returns:
            (4, 4) in the axes of the current camera, metres; the identity if the object is at
            rest.
        """
        return self.T_curr_prev @ invert(T_camera)


@dataclass(frozen=True, eq=False)
class Edge:
    """A motion between two frames as it was measured: a factor of a pose graph.

    Attributes:
        start: index of the frame where it starts.
        T_curr_start: (4, 4) metres.
        covariance: (6, 6) of delta in ``Exp(delta) T_curr_start``, metres and radians.

    >>> Edge(3, np.eye(4), np.eye(6)).T_start_curr.shape
    (4, 4)
    """

    start: int
    T_curr_start: np.ndarray
    covariance: np.ndarray

    @property
    def T_start_curr(self) -> np.ndarray:
        """The inverse (4, 4), as expected by the "between" factors of pose graphs."""
        return invert(self.T_curr_start)


@dataclass(frozen=True, eq=False)
class Step:
    """One tracked frame. The world frame is that of the first camera unless set otherwise.

    Attributes:
        index: number of the frame.
        timestamp: seconds.
        T_world_cam: (4, 4) camera to world, metres.
        motion: motion from frame ``prev_index`` to this one; for the first frame, the
            identity with status ok.
        prev_index: the frame where the motion starts, usually the latest usable one; after
            relocalization, an earlier place; None for the first frame.
        depth_scale: factor by which this frame's depth was too large for the scale of the
            trajectory, and by which it was divided; 1 if ``depth.scale_per_frame`` is off.
        scale_change: factor by which lengths are longer from the next step on, because
            this frame made the scale of all frames observable.
        objects: what moves on its own, if ``track.objects`` is on, each with its motion
            from the previous frame.
        gravity: which way is down, if samples of an accelerometer were handed in; else None.
        measured: the motion from a keyframe by which this frame was measured, if ``motion``
            follows from that and from the pose of frame ``prev_index``; else None.
        corrected: the step before, once more, with ``track.lag``; the pose of this one goes on
            from there. None where that step stays as it was.

    >>> step = Step(1, 0.1, np.eye(4), RelativePose(covariance=1e-6 * np.eye(6)), prev_index=0)
    >>> step.ok, step.T_prev_curr.shape
    (True, (4, 4))
    >>> print(step)  # doctest: +ELLIPSIS
    Step(1 from 0, 0.1 s, at [0.0000 0.0000 0.0000] m: ok, t [0.0000 ...
    """

    index: int
    timestamp: float
    T_world_cam: np.ndarray
    motion: RelativePose
    prev_index: int | None
    depth_scale: float = 1.0
    scale_change: float = 1.0
    objects: tuple[MovingObject, ...] = ()
    gravity: Gravity | None = None
    measured: Edge | None = None
    corrected: Step | None = None

    def __repr__(self) -> str:
        start = "first" if self.prev_index is None else f"from {self.prev_index}"
        x, y, z = self.T_world_cam[:3, 3]
        place = f"at [{x:.4f} {y:.4f} {z:.4f}] m"
        count = len(self.objects)
        objects = f", {count} object{'s' if count > 1 else ''}" if count else ""
        return (
            f"Step({self.index} {start}, {self.timestamp:.6g} s, {place}: "
            f"{self.motion._text()}{objects})"
        )

    @property
    def edge(self) -> Edge | None:
        """The motion as it was measured: from a keyframe, or from frame ``prev_index``.

        The errors of successive motions have the keyframe's in common; those of successive edges
        do not add up. None for the first frame.
        """
        if self.measured is not None or self.prev_index is None:
            return self.measured
        return Edge(self.prev_index, self.T_curr_prev, self.covariance)

    @property
    def ok(self) -> bool:
        """Whether the motion is neither degraded nor failed."""
        return self.motion.ok

    @property
    def usable(self) -> bool:
        """Whether the motion may be used. A degraded one has a wider covariance."""
        return self.motion.usable

    @property
    def probability(self) -> float:
        """Probability that the motion is the camera's; 0 if it failed."""
        return self.motion.probability

    @property
    def status(self) -> Status:
        """Whether the motion may be used, and why not."""
        return self.motion.status

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (6, 6) of the motion; see :class:`RelativePose`."""
        return self.motion.covariance

    @property
    def T_curr_prev(self) -> np.ndarray:
        """The motion (4, 4), from the previous camera to this one, metres."""
        return self.motion.T_curr_prev

    @property
    def T_prev_curr(self) -> np.ndarray:
        """The inverse, as expected by the "between" factors of pose graphs."""
        return self.motion.T_prev_curr


@dataclass(frozen=True, eq=False)
class PixelwisePrediction:
    """Raw output of a network for a batch: T_curr_prev at every pixel (paper, 3.2).

    The six channels are the Euler angles X-Y-Z in degrees, R = Rx Ry Rz, and the
    translation in metres. VONet's maps have a single pixel.

    Attributes:
        motion: (B, 6, h, w) degrees, then metres.
        log_scale: (B, 6, h, w) s = log U, where U is the Laplace scale; None for
            networks without uncertainty.
        image_size: (H, W) of the pairs passed to the network.
        evidence: (B, 4) what speaks for the hypothesis among its rivals, a
            :class:`~hybridvo.hypotheses.select.ChoiceEvidence` each; NaN where there is none.
        patches: the pose of every patch, estimated from its own pixels, as
            :class:`~hybridvo.solver.torch.patches.PatchPoses`; only from PWVO with the extra
            ``train``, otherwise None.
    """

    motion: torch.Tensor
    log_scale: torch.Tensor | None = None
    image_size: tuple[int, int] | None = None
    evidence: torch.Tensor | None = None
    patches: Any = None

    @property
    def rotation(self) -> torch.Tensor:
        """The Euler angles, (B, 3, h, w), degrees."""
        return self.motion[:, :3]

    @property
    def translation(self) -> torch.Tensor:
        """The translations, (B, 3, h, w), metres."""
        return self.motion[:, 3:]


def identity_covariance() -> np.ndarray:
    """(6, 6) covariance, m^2 and rad^2, if a step is estimated as no motion at all."""
    return np.diag(np.repeat(IDENTITY_STD, 3) ** 2)


def stated_stds(covariance: np.ndarray) -> tuple[float, float]:
    """Return the standard deviations of translation and rotation under a covariance.

    Args:
        covariance: (6, 6) m^2, m rad, rad^2, translation first.

    Returns:
        Root of the summed variances, of the translation in metres and of the rotation in
        radians.

    >>> stated_stds(np.diag([0.01, 0.01, 0.02, 0, 0, 0.25]))
    (0.2, 0.5)
    """
    variances = np.maximum(np.diag(covariance), 0.0)
    return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))


def stated_sigmas(covariance: np.ndarray) -> dict[str, float]:
    """Return the standard deviations of a motion as lengths of its two halves.

    Args:
        covariance: (6, 6) m^2, m rad, rad^2, translation first.

    Returns:
        ``sigma_trans``, metres, and ``sigma_rot_deg``, degrees.

    Example:
        >>> stated_sigmas(np.diag([0.01, 0.01, 0.02, 0, 0, 0]))["sigma_trans"]
        0.2
    """
    std_m, std_rad = stated_stds(covariance)
    return {"sigma_trans": std_m, "sigma_rot_deg": float(np.degrees(std_rad))}
