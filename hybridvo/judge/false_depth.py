"""Depth that is rigid and false: one value, a plane or a ramp before a scene that is none.

A network that failed, a saturated disparity or a wrong file hand out such maps. Two frames of
the same map agree with each other along nearly any motion, so that depth cannot contradict
itself. Two things speak against one: most of the map lies on one surface more exactly than
any sensor measures a wall; and the images do not move as that surface does. A sensor's view of
a wall is not exact, and a rendered wall moves with its images.
"""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.core.geometry import ego_flow, valid_depth
from hybridvo.core.kept import kept_with_frame
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Motion, Reason, Status
from hybridvo.core.types import Frame, FramePair
from hybridvo.evidence.pair import PairEvidence
from hybridvo.flow.calibration import UNSTATED_FLOW_STD_PX
from hybridvo.flow.frame_images import blurred
from hybridvo.judge.calibration import (
    CONTRADICTED_RIGHT,
    EXACT_SURFACE,
    MAX_OFF_SURFACE,
    MIN_ON_SURFACE,
    OFF_SURFACE_FLOW,
    OFF_SURFACE_GAIN,
    OFF_SURFACE_GREY,
    OFF_SURFACE_PX,
)
from hybridvo.judge.findings import Finding

# every so many rows and columns are looked at
STRIDE = 8
# times that a surface is fitted to what lies on it
ROUNDS = 6
# fewer pixels are no surface
MIN_PIXELS = 50
# side of the square over which two images are compared, px
PATCH = 9

SAMPLED = np.s_[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]


def false_depth(evidence: PairEvidence, motion: Motion) -> Finding | None:
    """Find that the depth of a pair is a surface that the images do not show.

    Args:
        evidence: of the pair, which has depth.
        motion: of the pair.

    Returns:
        That the motion is degraded, with a covariance as wide as its translation, whose length
        and direction rest on the depth; None where the depth may be right.
    """
    surface = _surface_of(evidence.pair.prev)
    if surface is None:
        return None
    pair = evidence.with_flow
    if pair.flow is None:
        return None
    cutoff = evidence.options.refine.cutoff
    off = ratio_off_surface(pair, motion, surface, cutoff)
    if off <= MAX_OFF_SURFACE:
        return None
    step = np.concatenate([motion.T_curr_prev[:3, 3], np.zeros(3)])
    text = (
        f"the depth of {100 * surface.mean():.0f} % of the pixels is one value, plane or "
        f"ramp, while {100 * off:.0f} % of these move otherwise in the images: see that "
        f"the depth map is that of this scene"
    )
    return Finding(
        np.outer(step, step),
        CONTRADICTED_RIGHT,
        Status.degraded(Reason.FALSE_DEPTH, text),
    )


@kept_with_frame
def _surface_of(frame: Frame) -> np.ndarray | None:
    """The exact surface in the depth of a frame, from which several motions may start."""
    assert frame.depth is not None
    return exact_surface(frame.depth)


def exact_surface(depth: np.ndarray) -> np.ndarray | None:
    """Return the pixels on the plane or ramp on which most of a depth map (H, W) lies.

    Returns:
        (h, w) bool, on every eighth pixel both ways; None where depth has more shape, or
        noise.

    >>> exact_surface(np.full((120, 160), 3.0, np.float32)).all()
    np.True_
    >>> rough = np.random.default_rng(0).uniform(2.0, 4.0, (120, 160))
    >>> exact_surface(rough) is None
    True
    """
    z = depth[SAMPLED].astype(np.float64)
    valid = valid_depth(z)
    count = np.count_nonzero(valid)
    if count < MIN_PIXELS:
        return None
    z = np.where(valid, z, 1.0)
    # a plane is linear in inverse depth; a picture's ramp is linear in depth
    for values in (1 / z, z):
        on_it = _on_linear(values, valid)
        if np.count_nonzero(on_it) >= MIN_ON_SURFACE * count:
            return on_it
    return None


def _on_linear(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Which of the valid values (h, w) are linear in their place, exactly."""
    v, u = np.indices(values.shape)
    rows = np.stack([np.ones_like(u), u, v], axis=-1).astype(np.float64)
    # begun at the most frequent values, which a few far ones do not draw away
    middle = np.median(values[valid])
    away = np.abs(values / middle - 1)
    on_it = valid & (away <= np.median(away[valid]))
    for _ in range(ROUNDS):
        linear, *_ = np.linalg.lstsq(rows[on_it], values[on_it], rcond=None)
        away = np.abs(rows @ linear / values - 1)
        limit = max(EXACT_SURFACE, float(np.median(away[valid])))
        on_it = valid & (away <= limit)
    return np.asarray(valid & (away <= EXACT_SURFACE))


def ratio_off_surface(
    pair: FramePair,
    motion: Motion,
    surface: np.ndarray,
    cutoff: float = RefineOptions.cutoff,
) -> float:
    """Return the fraction of a surface's pixels that move otherwise than it does.

    Their flow leads elsewhere by more than its noise, and the two images match clearly
    better there: flow in a weak texture errs as well.

    Args:
        pair: two frames with flow.
        motion: of the camera.
        surface: (h, w) bool, on every eighth pixel.
        cutoff: standard deviations of the flow beyond which a pixel moves otherwise.
    """
    prev = pair.prev
    assert prev.depth is not None and pair.flow is not None
    flow = np.asarray(pair.flow, np.float32)
    expected = ego_flow(
        prev.depth, motion.T_curr_prev, prev.camera, pair.curr.camera
    )
    away = np.linalg.norm(flow - expected, axis=-1)[SAMPLED]
    length = np.linalg.norm(flow, axis=-1)[SAMPLED]
    std = np.full(away.shape, UNSTATED_FLOW_STD_PX)
    if pair.flow_variance is not None:
        std = np.sqrt(np.asarray(pair.flow_variance)[SAMPLED])
    limit = np.hypot(OFF_SURFACE_PX, OFF_SURFACE_FLOW * length)
    is_off = away > np.maximum(limit, cutoff * std)
    used = surface & np.isfinite(away)
    if pair.flow_valid is not None:
        used &= np.asarray(pair.flow_valid)[SAMPLED]
    if pair.has_images:
        by_flow = _mismatch(pair, flow)
        by_surface = _mismatch(pair, expected.astype(np.float32))
        used &= np.isfinite(by_flow) & np.isfinite(by_surface)
        is_off &= by_surface > OFF_SURFACE_GAIN * by_flow + OFF_SURFACE_GREY
    count = np.count_nonzero(used)
    return np.count_nonzero(is_off & used) / count if count >= MIN_PIXELS else 0.0


def _mismatch(pair: FramePair, flow: np.ndarray) -> np.ndarray:
    """(h, w) root mean square of the difference of two images along a flow, grey levels.

    NaN where the flow leads out of the image.
    """
    height, width = pair.prev.camera.shape
    v, u = np.indices((height, width), np.float32)
    x = u + np.nan_to_num(flow[..., 0], nan=-1e6)
    y = v + np.nan_to_num(flow[..., 1], nan=-1e6)
    moved = cv2.remap(blurred(pair.curr), x, y, cv2.INTER_LINEAR)
    is_inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    difference = np.where(is_inside, moved - blurred(pair.prev), 0)
    square = cv2.blur(difference * difference, (PATCH, PATCH))
    mismatch = np.sqrt(np.maximum(square, 0))
    return np.asarray(np.where(is_inside, mismatch, np.nan)[SAMPLED])
