"""Motions for steps that are too wide for flow: from sparse matches of the two images.

Flow estimators follow a tenth of the image's width. Matches have no such limit, and with
depth each rigid motion that many of them follow is a start: for the flow, which then only
has to find what the motion leaves, and for the search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.depth_units import nearer_than_sky
from hybridvo.core.geometry import backproject, ego_flow, make_transform
from hybridvo.core.kept import kept_with_frame
from hybridvo.core.stages import stage
from hybridvo.core.types import Frame, FramePair
from hybridvo.flow.frame_images import grey_bytes, reduced
from hybridvo.flow.providers import FlowField
from hybridvo.hypotheses.calibration import (
    GUIDED_MIN_TEXTURE,
    MATCH_MIN_INLIERS,
    MATCH_RATIO,
    MATCH_RESIDUAL_PX,
)

# SIFT features of an image at most, for a step that flow cannot follow.
MATCH_FEATURES = 2000
# Contrast of a feature at least, where OpenCV asks for .04: bare rooms have few with more.
MATCH_CONTRAST = 0.01
# Motions of a pair that are sought: the scene's, and a moving object's before it.
MATCH_MAX_MOTIONS = 2

RANSAC_ITERATIONS = 300
RANSAC_CONFIDENCE = 0.999
# reduction of the frames on which the flow of a motion is computed
GUIDE_REDUCTION = 2
# px, of the flow where a point ends behind the camera: it leads out of any image
FAR_AWAY = 1e6
# px, of the side of the patch over which texture is measured
TEXTURE_SIDE = 9
# matches of a feature whose distances are compared: the best and the second
NEIGHBOURS = 2


class Features(NamedTuple):
    """Points of an image that can be found again in another one."""

    pixels: np.ndarray  # (N, 2) px
    descriptors: np.ndarray  # (N, 128)


class Matches(NamedTuple):
    """Points of the previous frame, and where they are in the current image."""

    points: np.ndarray  # (N, 3) metres, previous camera
    pixels: np.ndarray  # (N, 2) px, current image


@stage("search")
def matched_motions(pair: FramePair, seed: int = 0) -> list[np.ndarray]:
    """Find rigid motions that many sparse matches follow.

    Args:
        pair: two frames with images, and depth of the previous one.
        seed: of the random samples.

    Returns:
        Motions ``T_curr_prev`` (4, 4), metres, that of most matches first; each explains
        matches that those before it do not. Empty where matches are too few.
    """
    matches = match_features(pair)
    motions: list[np.ndarray] = []
    cv2.setRNGSeed(seed)
    while (
        len(matches.points) >= MATCH_MIN_INLIERS
        and len(motions) < MATCH_MAX_MOTIONS
    ):
        solved = _solve(matches, pair)
        if solved is None:
            break
        T, is_inlier = solved
        motions.append(T)
        matches = Matches(matches.points[~is_inlier], matches.pixels[~is_inlier])
    return motions


def match_features(pair: FramePair) -> Matches:
    """Match features of the two images whose depth is known."""
    nothing = Matches(np.zeros((0, 3)), np.zeros((0, 2)))
    depth = pair.prev.depth
    if not pair.has_images or depth is None:
        return nothing
    # points of the sky determine no translation
    depth = nearer_than_sky(depth)
    prev = find_features(pair.prev)
    curr = find_features(pair.curr)
    if not len(prev.pixels) or len(curr.pixels) < NEIGHBOURS:
        return nothing
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    found = matcher.knnMatch(prev.descriptors, curr.descriptors, k=NEIGHBOURS)
    kept = [
        best
        for best, second in (two for two in found if len(two) == NEIGHBOURS)
        if best.distance < MATCH_RATIO * second.distance
    ]
    if not kept:
        return nothing
    at_prev = prev.pixels[[match.queryIdx for match in kept]]
    at_curr = curr.pixels[[match.trainIdx for match in kept]]
    height, width = depth.shape
    cells = np.rint(at_prev[:, ::-1]).astype(int)
    cells = np.clip(cells, 0, (height - 1, width - 1))
    points = backproject(depth, pair.prev.camera, cells)
    is_known = np.isfinite(points).all(axis=1) & (points[:, 2] > 0)
    return Matches(points[is_known], at_curr[is_known])


@kept_with_frame
def find_features(frame: Frame) -> Features:
    """The features of a frame's image."""
    detector = cv2.SIFT.create(MATCH_FEATURES, contrastThreshold=MATCH_CONTRAST)
    keypoints, descriptors = detector.detectAndCompute(grey_bytes(frame), None)
    return Features(
        np.array([point.pt for point in keypoints]).reshape(-1, 2), descriptors
    )


def _solve(
    matches: Matches, pair: FramePair
) -> tuple[np.ndarray, np.ndarray] | None:
    """The motion that most matches follow, and which do; None where too few do."""
    camera = pair.curr.camera
    residual_px = MATCH_RESIDUAL_PX * camera.width / 640
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            matches.points,
            matches.pixels,
            camera.K,
            None,
            iterationsCount=RANSAC_ITERATIONS,
            reprojectionError=residual_px,
            confidence=RANSAC_CONFIDENCE,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:
        return None
    if not found or inliers is None or len(inliers) < MATCH_MIN_INLIERS:
        return None
    is_inlier = np.zeros(len(matches.points), bool)
    is_inlier[inliers.ravel()] = True
    R, _ = cv2.Rodrigues(rotation)
    T = make_transform(R, translation.ravel())
    return (T, is_inlier) if np.isfinite(T).all() else None


@dataclass(frozen=True, eq=False)
class GuidedFlow:
    """A provider of flow that is found from what a motion leaves, see :func:`guided_flow`."""

    provider: Callable[[Frame, Frame], FlowField]
    T_curr_prev: np.ndarray  # (4, 4) metres

    @property
    def source(self) -> str:
        """That of the provider."""
        return getattr(self.provider, "source", "")

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        """Compute the flow of two frames with images; the first one has depth."""
        pair = FramePair(prev, curr, None)
        return guided_flow(pair, self.T_curr_prev, self.provider)


def guided_flow(
    pair: FramePair,
    T_curr_prev: np.ndarray,
    provider: Callable[[Frame, Frame], FlowField],
) -> FlowField:
    """Estimate the flow of a pair from what a motion leaves of it.

    The current image is taken back along the motion, and the flow from the previous image
    to that one is added to the motion's own. Pixels without texture would confirm any
    motion, and are not valid.

    Args:
        pair: two frames with images, and depth of the previous one.
        T_curr_prev: (4, 4) the motion, metres.
        provider: estimates flow of two frames.

    Returns:
        The flow; none where the motion leads out of the image or images are missing.
    """
    depth = pair.prev.depth
    if pair.prev.rgb is None or pair.curr.rgb is None or depth is None:
        return FlowField(None)
    guide = _smooth_ego_flow(pair, T_curr_prev)
    height, width = depth.shape
    rows, columns = np.indices(depth.shape, dtype=np.float32)
    u = columns + guide[..., 0]
    v = rows + guide[..., 1]
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    taken_back = cv2.remap(
        pair.curr.rgb, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    left = provider(pair.prev, Frame(taken_back, None, pair.prev.camera))
    if left.flow is None:
        return FlowField(None)
    # what is left was found where the motion leads: it belongs to where it came from
    valid = inside & _is_textured(pair.prev)
    if left.valid is not None:
        valid &= left.valid
    at = np.stack([columns + left.flow[..., 0], rows + left.flow[..., 1]])
    at = at.astype(np.float32)
    guide_there = cv2.remap(
        guide, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    flow = left.flow + guide_there
    return FlowField(flow, left.variance, valid, left.source)


def _smooth_ego_flow(pair: FramePair, T_curr_prev: np.ndarray) -> np.ndarray:
    """(H, W, 2) px float32, ego flow of a motion, computed on a reduced frame."""
    prev = reduced(pair.prev, GUIDE_REDUCTION)
    curr = reduced(pair.curr, GUIDE_REDUCTION)
    assert prev.depth is not None
    small = ego_flow(_filled(prev.depth), T_curr_prev, prev.camera, curr.camera)
    small = np.nan_to_num(GUIDE_REDUCTION * small, nan=FAR_AWAY).astype(np.float32)
    height, width = prev.camera.shape
    size = (width * GUIDE_REDUCTION, height * GUIDE_REDUCTION)
    flow = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)
    # the rows and columns that were cut off
    below = pair.prev.camera.height - size[1]
    right = pair.prev.camera.width - size[0]
    return cv2.copyMakeBorder(flow, 0, below, 0, right, cv2.BORDER_REPLICATE)


def _filled(depth: np.ndarray) -> np.ndarray:
    """Depth (H, W) metres with the nearest known one where it is unknown."""
    known = np.isfinite(depth) & (depth > 0)
    if known.all() or not known.any():
        return depth
    unknown = (~known).astype(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(
        unknown, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(labels.max() + 1, np.float32)
    values[labels[known]] = depth[known]
    return values[labels]


@kept_with_frame
def _is_textured(frame: Frame) -> np.ndarray:
    """(H, W) bool, where an image changes by more than its noise."""
    grey = grey_bytes(frame).astype(np.float32)
    side = (TEXTURE_SIDE, TEXTURE_SIDE)
    mean = cv2.blur(grey, side)
    variance = cv2.blur(grey * grey, side) - mean * mean
    return variance > GUIDED_MIN_TEXTURE**2
