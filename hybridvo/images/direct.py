"""A motion from the images and depth maps alone, coarse to fine: no flow is needed.

Where the motion leaves no region of the image unexplained, and the parts of the image agree about
it, nothing else moves: it is the answer. Where it does, something moves, or the images are too far
apart, and the flow has to be asked.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import cv2
import numpy as np

from hybridvo.calibration import DIRECT_RIGHT, right
from hybridvo.images.image_factor import ImageFactor, blurred, choose_pixels
from hybridvo.images.photometric import BLURS, PhotometricReport, refine_photometric
from hybridvo.images.plane_factor import MIN_POINTS, PlaneFactor
from hybridvo.refinement.solver import Factor, gauss_newton
from hybridvo.results import RelativePose
from hybridvo.types import Camera, Frame, FramePair

REDUCTIONS = (8, 4, 2)
"""Of the image, coarse to fine, before the image itself."""
MIN_SIDE = 24
"""Of a reduced image, px."""
PIXELS, POINTS, STEPS = 2500, 1250, 6
"""Pixels and points used and Gauss-Newton steps on a reduced image, at most."""
SPREAD = np.repeat([0.3, 0.15], 3)
"""Standard deviation of the motion before the images are seen, m and rad: it decides nothing."""
SHIFT_PX, GREY = 0.25, 1.0
"""A residual is noise where so small a shift of the image, and grey levels, explain it."""
NEIGHBOURS = 3
"""Side, in points of the grid, of the squares whose mean residual is taken for light."""
REGION, UNEXPLAINED = 5, 0.6
"""Side, in points of the grid, of the squares in which more than this share is unexplained: a
region that moves, where single points are noise."""
SMALL_REGION = 0.01
"""Share of the image far below which smaller is no better."""
_REDUCED: WeakKeyDictionary[Frame, dict[int, Frame]] = WeakKeyDictionary()
"""Reduced frames by reduction, as long as the frame is kept."""


def direct_start(
    pair: FramePair,
    T_start: np.ndarray | None = None,
    least: float = 0.5,
) -> RelativePose | None:
    """The motion that the images and depth maps agree on, from a start (4, 4) or the identity.

    Its ``inlier_ratio`` is the share of the pixels in view of both that it explains, its
    ``probability`` of being the camera's follows from that. None where the images do not match, or
    where that is below ``least``.
    """
    prev, curr = pair.prev, pair.curr
    if any(x is None for x in (prev.rgb, prev.depth, curr.rgb, curr.depth)):
        return None
    ones = np.ones(prev.camera.shape, np.float32)
    planes = PlaneFactor(pair, ones, 1.0, POINTS)
    if len(planes.points) < MIN_POINTS:
        return None
    start = RelativePose(covariance=np.diag(SPREAD**2), weights=ones, method="direct")
    T, gain = np.eye(4) if T_start is None else T_start, 1.0
    for by in REDUCTIONS:
        if min(prev.camera.shape) < by * MIN_SIDE:
            continue
        small = FramePair(reduced(prev, by), reduced(curr, by), None)
        weights = np.ones(small.prev.camera.shape, np.float32)
        before, after = (blurred(frame, BLURS[-1]) for frame in (small.prev, small.curr))
        depth = np.asarray(small.prev.depth)
        index = choose_pixels(before, depth, weights, min(PIXELS, weights.size // 4))
        if not len(index):
            continue
        factor = ImageFactor(small, start.replace(weights=weights), index)
        factor.use(before, after, T, uneven_light=False)
        factors: list[Factor] = [factor, planes] if planes.estimate(T) else [factor]
        T = gauss_newton(factors, T, STEPS, tolerance=0.1).T
        gain = factor.gain
    guess = start.replace(T_curr_prev=T, photometric=PhotometricReport(False, gain=gain))
    likely, _ = explained(pair, guess)
    if likely.probability < least:
        return None
    start = start.replace(T_curr_prev=T, weights=likely.weights)
    found = refine_photometric(pair, start, BLURS[-1:], prior_inflation=1.0)
    if found.photometric is None or not found.photometric.taken:
        return None
    answer, _ = explained(pair, found)
    return answer if answer.probability >= least else None


def reduced(frame: Frame, by: int) -> Frame:
    """The frame at 1 / ``by`` of its size: the image averaged, depth picked."""
    known = _REDUCED.setdefault(frame, {})
    if by not in known:
        K, height, width = frame.camera, frame.camera.height // by, frame.camera.width // by
        whole = np.s_[: height * by, : width * by]
        assert frame.rgb is not None and frame.depth is not None
        rgb = cv2.resize(frame.rgb[whole], (width, height), interpolation=cv2.INTER_AREA)
        depth = frame.depth[whole][by // 2 :: by, by // 2 :: by]
        cx, cy = ((c - (by - 1) / 2) / by for c in (K.cx, K.cy))
        camera = Camera(K.fx / by, K.fy / by, cx, cy, height, width)
        known[by] = Frame(rgb, np.ascontiguousarray(depth), camera)
    return known[by]


def explained(pair: FramePair, motion: RelativePose) -> tuple[RelativePose, tuple[float, float]]:
    """A motion by images and depth maps with the pixels that follow it, and its probability.

    And the evidence that this is logistic in: agreement of the image's parts, and log of the share
    of the image in unexplained regions.
    """
    T, images = motion.T_curr_prev, motion.photometric
    planes = PlaneFactor(pair, np.ones(pair.prev.camera.shape, np.float32), 1.0)
    assert images is not None
    planes.estimate(T)
    (height, width), (v, u), at = pair.prev.camera.shape, planes.index.T, planes.residuals(T)
    x, y = at.at.T
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    before, after = (blurred(frame, 1.0) for frame in (pair.prev, pair.curr))
    columns, rows = at.at.T[..., None].astype(np.float32)
    now = cv2.remap(after, columns, rows, cv2.INTER_LINEAR)[:, 0]

    def mean_around(values: np.ndarray, side: int) -> np.ndarray:
        total, count = (
            cv2.blur(planes.on_grid(x), (side, side)) for x in (np.where(inside, values, 0), inside)
        )
        return (total / np.maximum(count, 1e-6))[planes.cells]

    residual = now - images.gain * before[v, u]
    d2 = (residual - mean_around(residual, NEIGHBOURS)) ** 2
    beside, below = np.minimum(u + 1, width - 1), np.minimum(v + 1, height - 1)
    slope2 = (before[v, beside] - before[v, np.maximum(u - 1, 0)]) ** 2
    slope2 += (before[below, u] - before[np.maximum(v - 1, 0), u]) ** 2
    usual = 9 * (GREY**2 + (SHIFT_PX / 2) ** 2 * slope2)
    depth = np.where(at.seen, planes.robust(T), 1.0)
    follows = inside & (usual / (usual + d2) * depth > 0.5)
    unexplained = inside & (mean_around(~follows, REGION) > UNEXPLAINED)
    count = max(int(np.count_nonzero(inside)), 1)
    region = np.count_nonzero(unexplained) / count
    evidence = images.agreement, float(np.log(region + SMALL_REGION))
    z = at.z[at.seen]
    answer = motion.replace(
        inlier_ratio=float(np.count_nonzero(follows) / count),
        probability=right(evidence, DIRECT_RIGHT),
        weights=planes.image_of(follows),
        depth_noise=float(np.median(planes.noise(z) / z) / np.sqrt(2)) if len(z) else 0.0,
        terms=("images", "depth"),
    )
    return answer, evidence
