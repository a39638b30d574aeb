"""Covariances of chained motions, and those of other libraries' factors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import adjoint
from hybridvo.core.results import (
    UNINFORMATIVE_COVARIANCE,
    Edge,
    RelativePose,
    Step,
)

G2O_ROTATION = 0.5
"""A small rotation in g2o: the vector part of its quaternion is half of the angle."""
SHOWN_FRAMES = 4
"""Frames that a message names."""


class PathCovariance:
    """The covariance of the latest pose, along the path from the first one.

    Every motion adds its own to that of the frame from which it was measured: while a camera
    stands before one keyframe, the errors of its steps do not add up. A motion that failed adds
    one without information, which goes again where a later motion spans it.
    """

    def __init__(self) -> None:
        self._known: dict[int, np.ndarray] = {}
        self._last = np.zeros((6, 6))

    @property
    def last(self) -> np.ndarray:
        """(6, 6) covariance of delta in ``Exp(delta) T_cam_first``, m and rad."""
        return self._last

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames from which a motion may start."""
        return tuple(self._known)

    def begin(self, index: int) -> None:
        """Let the path go on at a frame to which no motion leads."""
        self._known[index] = self._last

    def add(self, step: Step) -> np.ndarray:
        """Go on by a step.

        Args:
            step: The next one.

        Returns:
            (6, 6) covariance of delta in ``Exp(delta) T_cam_first``, m and rad.
        """
        if step.prev_index is None:
            self._last = _chained(self._last, step.T_curr_prev, step.covariance)
        else:
            edge = self._edge(step, step.prev_index)
            before = self._known[edge.start]
            self._last = _chained(before, edge.T_curr_start, edge.covariance)
        self._known[step.index] = self._last
        return self._last

    def _edge(self, step: Step, prev_index: int) -> Edge:
        """The motion as it was measured, or, where its start is not on the path, as it is given."""
        if step.measured is not None and step.measured.start in self._known:
            return step.measured
        return Edge(prev_index, step.T_curr_prev, step.covariance)

    def follow(self, step: Step) -> np.ndarray:
        """Go on by a step, as :meth:`add` does, also where no motion leads to its start."""
        start = step.index if step.prev_index is None else step.prev_index
        if step.prev_index is None or start not in self._known:
            self.begin(start)
        return self.add(step)

    def add_motion(self, motion: RelativePose) -> np.ndarray:
        """Go on by a motion that starts at the latest pose; returns as :meth:`add` does."""
        self._last = _chained(self._last, motion.T_curr_prev, motion.covariance)
        return self._last

    def keep(self, indices: Iterable[int]) -> None:
        """Forget all frames but those from which a motion may start."""
        kept = set(indices)
        self._known = {i: C for i, C in self._known.items() if i in kept}

    def lose(self) -> None:
        """Begin anew: how the camera moved meanwhile is not known."""
        self._last = self._last + UNINFORMATIVE_COVARIANCE
        self._known = {}


def _chained(
    before: np.ndarray, T_curr_prev: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """The covariance (6, 6) of a pose, from that of the pose before and of the motion between."""
    A = adjoint(T_curr_prev)
    return A @ before @ A.T + covariance


def chain_covariance(steps: Iterable[Step | RelativePose]) -> np.ndarray:
    """Covariance of the motion over several steps.

    It is what a pose graph computes from one factor for each step, its ``edge``: what was
    measured from a keyframe starts there. If the keyframe comes before the first of the steps,
    the motion from ``prev_index`` takes its place. Steps that failed are passed over, as in such a
    graph: the next one spans them.

    Args:
        steps: of a tracker, in their order; or motions, each from where the one before
            ended.

    Returns:
        (6, 6) covariance of delta in ``Exp(delta) T_last_first``, translation first, m and
        rad; zero without any motion. First is the frame from which the first step starts,
        last that of the last step that is usable.

    Raises:
        InputError: a step starts at a frame to which no step leads, or what is given is no
            steps.

    Example:
        >>> import numpy as np
        >>> from hybridvo import RelativePose
        >>> step = RelativePose(covariance=np.diag([1e-4] * 3 + [1e-6] * 3))
        >>> np.diag(chain_covariance([step, step])).round(6).tolist()
        [0.0002, 0.0002, 0.0002, 2e-06, 2e-06, 2e-06]
    """
    if isinstance(steps, Step | RelativePose) or not isinstance(steps, Iterable):
        got = type(steps).__name__
        raise InputError(
            f"chain_covariance: expected a list of steps or motions, got {got}."
        )
    path = PathCovariance()
    for number, step in enumerate(steps):
        if isinstance(step, Step):
            _follow(path, number, step)
        elif not isinstance(step, RelativePose):
            got = type(step).__name__
            raise InputError(
                f"chain_covariance: expected steps or motions, got {got}."
            )
        elif not step.usable:
            raise InputError(f"chain_covariance: motion {number} failed.")
        else:
            path.add_motion(step)
    return path.last


def _follow(path: PathCovariance, number: int, step: Step) -> None:
    """Go on by a step of a tracker; an InputError where no step leads to its start."""
    if step.prev_index is None:
        path.begin(step.index)
        return
    if not step.usable:
        return
    if not path.frames:
        path.begin(step.prev_index)
    if step.prev_index not in path.frames:
        known = ", ".join(str(index) for index in path.frames[-SHOWN_FRAMES:])
        raise InputError(
            f"chain_covariance: step {number} starts at frame {step.prev_index}; expected a "
            f"frame to which a usable step before it leads, such as {known}."
        )
    path.add(step)


def to_g2o_information(covariance: np.ndarray) -> np.ndarray:
    """Information for g2o's ``EDGE_SE3:QUAT`` of ``T_prev_curr``.

    g2o's error is the translation and the vector part of the quaternion of
    ``inverse(measurement) estimate``. As GTSAM's it is on the right, so that no axes
    change; the vector part is half of the angle.

    Args:
        covariance: (6, 6) or (N, 6, 6) of ``T_curr_prev``, as in a RelativePose.

    Returns:
        The same shape, (x, y, z, qx, qy, qz); a g2o file has its upper triangle.

    Raises:
        InputError: for another shape, and for a covariance that is not definite.

    >>> information = to_g2o_information(np.diag([0.25, 1, 1, 1, 1, 0.5]))
    >>> np.diag(information).tolist()
    [4.0, 1.0, 1.0, 4.0, 4.0, 8.0]
    """
    C = np.asarray(covariance, dtype=np.float64)
    if C.ndim not in (2, 3) or C.shape[-2:] != (6, 6):
        raise InputError(
            f"to_g2o_information: expected (6, 6) or (N, 6, 6), got {C.shape}."
        )
    scale = np.repeat([1.0, G2O_ROTATION], 3)
    scaled = C * scale * scale[:, None]
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        raise InputError(
            "to_g2o_information: expected a positive definite covariance."
        ) from None
    return np.linalg.inv(scaled)
