"""Frames that a camera hands out again: its image, its depth map, or both, byte for byte.

A camera in the dark exposes longer than a frame lasts, and the recorder gets the last image
or depth map once more. Sensors have noise: two maps that are equal in every byte are one. A
rendered view has none, so that a camera that stands still repeats its frames rightly. What
repeats is therefore old only where the camera was expected to move, or where the other part
of the frame shows that it did.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import (
    backproject,
    invert,
    mean_flow,
    project,
    transform_points,
    valid_depth,
)
from hybridvo.core.results import (
    Motion,
    MotionPrior,
    Reason,
    RelativePose,
    Status,
    Term,
    identity_covariance,
)
from hybridvo.core.types import Frame, FramePair
from hybridvo.judge.consistency import contradiction_by_depth
from hybridvo.judge.findings import Finding, covering
from hybridvo.judge.verdict import believed, with_finding
from hybridvo.solver.depth_alone import DepthEvidence, motion_by_depth
from hybridvo.tracking.calibration import EQUAL_DEPTH, STANDING_FLOW_PX
from hybridvo.tracking.tracker_state import TrackerState

# every so many rows and columns of a depth map are compared
STRIDE = 8
# of single precision, relative: values that differ by less are equal
ROUNDING = 1e-5


class Repeat(NamedTuple):
    """Which parts of a frame are those of the frame before."""

    colour: bool = False
    depth: bool = False

    @property
    def entire(self) -> bool:
        """Whether nothing of the frame is new."""
        return self.colour and self.depth

    @property
    def message(self) -> str:
        """What is repeated, in words."""
        what = "image and depth are" if self.entire else "the depth is"
        if not self.depth:
            what = "the image is"
        return (
            f"{what} that of the frame before, byte for byte: the camera handed it "
            f"out again; in the dark, allow it a longer exposure or fewer frames"
        )

    def marked(self, motion: RelativePose) -> RelativePose:
        """Return a motion by the images as degraded: the old depth could not confirm it."""
        if not motion.ok:
            return motion
        status = Status.degraded(Reason.REPEATED_FRAME, self.message)
        return motion.replace(status=status)


def repeat_of(before: Frame | None, frame: Frame) -> Repeat:
    """Return which parts of a frame are those of the frame before, byte for byte.

    A map of one value, such as a black image, equals any other of it: that means nothing. Nor
    does the depth of a network, which is no sensor.
    """
    if before is None:
        return Repeat()
    is_sensed = frame.depth_source != "network"
    return Repeat(
        _is_the_same(before.rgb, frame.rgb),
        is_sensed and _is_the_same(before.depth, frame.depth),
    )


def _is_the_same(before: np.ndarray | None, now: np.ndarray | None) -> bool:
    if before is None or now is None or before.shape != now.shape:
        return False
    # most pairs differ in the first row
    if before[0].tobytes() != now[0].tobytes():
        return False
    if before.tobytes() != now.tobytes():
        return False
    return not _has_one_value(now)


def _has_one_value(values: np.ndarray) -> bool:
    """Whether all that is valid in a map (H, W) or (H, W, 3) is the same."""
    if values.dtype.kind != "f":
        return bool((values == values[0, 0]).all())
    valid = values[valid_depth(values)]
    return valid.size == 0 or bool(np.ptp(valid) <= ROUNDING * valid.max())


def motion_without_image(
    state: TrackerState,
    frame: Frame,
    given: MotionPrior | None,
    repeat: Repeat,
    depth_is_fresh: bool,
) -> RelativePose | None:
    """Return the motion from the reference to a frame whose image is old, or does not show it.

    Fresh depth maps are followed from the expected motion. Without them the last known pose is
    that of an instant before, from which the camera may have gone on.

    Args:
        state: of the tracker.
        frame: the current one.
        given: what the user knows of the motion; None: constant velocity.
        repeat: which parts are old.
        depth_is_fresh: whether its depth may be followed.

    Returns:
        The motion; None where the camera may as well have stood still.
    """
    reference = state.known_reference.frame
    held = state.T_last_reference
    expected = given or state.expected()
    pair = FramePair(reference, frame, None)
    if expected is None or _stands(reference, expected.T_curr_prev @ invert(held)):
        if not depth_is_fresh or _agrees_with_standing(pair, held):
            return None
    went_on = None
    if depth_is_fresh:
        start = expected or MotionPrior(held, identity_covariance())
        known = motion_by_depth(pair, start)
    elif given is not None:
        known = given
    else:
        assert expected is not None
        known = MotionPrior(held, expected.covariance)
        went_on = Finding(covering(expected.T_curr_prev @ invert(held)))
    motion = Motion(
        T_curr_prev=known.T_curr_prev,
        covariance=known.covariance,
        status=Status.degraded(Reason.REPEATED_FRAME, repeat.message),
        evidence=DepthEvidence(),
        terms=(Term.DEPTH,) if depth_is_fresh else (),
    )
    return with_finding(believed(motion), went_on)


def _stands(reference: Frame, step: np.ndarray) -> bool:
    """Whether an expected step (4, 4) is hardly visible."""
    return mean_flow(reference, step) * reference.camera.width < STANDING_FLOW_PX


def _agrees_with_standing(pair: FramePair, T_held: np.ndarray) -> bool:
    """Whether fresh depth does not show that the camera moved since ``T_held`` (4, 4)."""
    if pair.prev.depth is None or pair.curr.depth is None:
        return True
    everywhere = np.ones(pair.prev.camera.shape, np.float32)
    held = Motion(T_curr_prev=T_held, weights=everywhere)
    return contradiction_by_depth(pair, held) is None


def is_as_good_as_new(frame: Frame, T_curr_prev: np.ndarray) -> bool:
    """Whether an old depth map is what the frame must show after a motion.

    It is where the camera stands, and where it moves along a wall.

    Args:
        frame: with the depth of the frame before.
        T_curr_prev: (4, 4) motion since that frame.
    """
    if frame.depth is None:
        return False
    camera = frame.camera
    v, u = np.mgrid[: camera.height : STRIDE, : camera.width : STRIDE]
    pixels = np.stack([v.ravel(), u.ravel()], axis=1)
    points = backproject(frame.depth, camera, pixels)
    moved = transform_points(T_curr_prev, points[valid_depth(points[:, 2])])
    places = project(moved, camera).astype(np.float32)
    shown = cv2.remap(
        np.where(frame.depth > 0, frame.depth, np.float32(np.nan)),
        places[:, None, 0],
        places[:, None, 1],
        cv2.INTER_LINEAR,
        borderValue=np.nan,
    )
    ratio = shown[:, 0] / moved[:, 2]
    ratio = ratio[np.isfinite(ratio)]
    return len(ratio) > 0 and float(np.median(np.abs(ratio - 1))) < EQUAL_DEPTH
