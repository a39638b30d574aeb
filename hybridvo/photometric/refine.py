"""The motion of a pair by its images: one that the flow found made sharper, or one without flow.

With flow its covariance becomes a prior around its motion, and the 6x6 normal equations of flow,
images and depth maps add up. Without flow images and depth maps are followed coarse to fine; where
a region is left unexplained, or the motion is not precise, the flow has to be asked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from hybridvo.calibration import DIRECT_RIGHT
from hybridvo.geometry import invert, pose_matrix, projection_rows
from hybridvo.numba_tools import as_contiguous
from hybridvo.photometric import kernels
from hybridvo.photometric.factors import (
    MIN_POINTS,
    ImageFactor,
    PlaneFactor,
    blurred,
)
from hybridvo.refinement.solver import positive_inverse
from hybridvo.results import RelativePose, probability_right
from hybridvo.types import Camera, Frame, FramePair

NO_PRIOR = np.eye(4), np.zeros((6, 6))  # of a motion: inverse and information
# of estimating the noise, and most under each
ROUNDS = 3
STEPS = 3
# about, in even cells, and at least
PIXELS = 16_000
MIN_PIXELS = 200
# robust weight in the refinement on the flow below which a pixel is not used
MIN_WEIGHT = 0.25
# of the flow's covariance: its errors are alike far beyond the tiles
PRIOR_INFLATION = 32.0
MIN_CORRELATION = 0.5  # of the two images along the motion, at least
MIN_SEEN = 0.3  # share of the weight that both cameras see, at least
# least share of information added; longest shift, inflated std
MIN_GAIN = 0.1
MAX_SHIFT = 4.5

# of the image, coarse to fine; its least side, px
REDUCTIONS = (8, 4, 2)
MIN_SIDE = 24
# most on a reduced image
FEW_PIXELS = 2500
FEW_POINTS = 1250
FEW_STEPS = 6
# m and rad before the images are seen: decides nothing
SPREAD = np.repeat([0.3, 0.15], 3)
# residuals that these explain are noise
SHIFT_PX = 0.25
GREY_NOISE = 0.5
# sides, in points, of the squares averaged for light and for regions
NEIGHBOURS = 3
REGION = 5
FLAT = 4.0  # grey levels over two pixels: such a texture counts half
SMALL_REGION = 0.01  # share of the texture far below which smaller is no better
_REDUCED: WeakKeyDictionary[Frame, dict[int, Frame]] = WeakKeyDictionary()
"""Reduced frames by reduction, as long as the frame is kept."""


@dataclass(frozen=True, eq=False)
class PhotometricReport:
    """What came of the images of one pair."""

    taken: bool = False  # whether the motion was changed
    # why not, in words; empty where taken, not tried or not needed
    refusal: str = ""
    gain: float = 1.0  # of the current image over the previous one
    # of the parts of the image: factor in (0, 1] on the information
    agreement: float = 1.0


def refine_photometric(
    pair: FramePair, pose: RelativePose, prior_inflation: float = PRIOR_INFLATION
) -> RelativePose:
    """The motion of a pair, sharpened by its two images.

    ``pose``: what the refinement on flow found, with weights and covariance. It is the answer where
    images are missing or refused; ``photometric``, and the status, say why.
    """
    prev = pair.prev
    curr = pair.curr
    T = pose.T_curr_prev
    weights = pose.weights
    no_images = prev.rgb is None or curr.rgb is None
    if no_images or not pose.usable or weights is None or prev.depth is None:
        return pose.replace(photometric=PhotometricReport())
    covariance = prior_inflation * pose.covariance
    if (flow_information := positive_inverse(covariance)) is None:
        return pose.replace(photometric=PhotometricReport())
    index = choose_pixels(blurred(prev), prev.depth, weights, PIXELS)
    if len(index) < MIN_PIXELS:
        what = f"{len(index)} static pixels with texture and depth, {MIN_PIXELS} needed"
        return _refused(pose, PhotometricReport(refusal=what))
    images = ImageFactor(pair, pose, index)
    planes = PlaneFactor(pair, weights, MIN_WEIGHT)
    planes.estimate(T)
    prior = invert(T), flow_information
    for _ in range(ROUNDS):
        T = images.follow(planes, prior, T, STEPS)
        planes.estimate(T)
        images.estimate(T)
    joint = np.zeros((kernels.TERMS, kernels.TERMS))
    _, away = kernels.add_prior(*prior, T, joint)
    joint_covariance = positive_inverse(
        joint[1:7, 1:7] + images.information + planes.information
    )
    refusal = "the joint information is not definite"
    if joint_covariance is not None:
        refusal = _doubt(images, np.sqrt(away))
    report = PhotometricReport(
        False, refusal, float(images.light[0]), images.agreement
    )
    if refusal:
        return _refused(pose, report)
    added = np.linalg.eigvals(covariance @ images.information).real
    # the images add little to what the flow already knows
    if added.max() < MIN_GAIN:
        return pose.replace(photometric=report)
    return pose.replace(
        T_curr_prev=pose_matrix(T[:3]),
        covariance=joint_covariance,
        terms=(*pose.terms, "images"),
        photometric=replace(report, taken=True),
    )


def _refused(pose: RelativePose, report: PhotometricReport) -> RelativePose:
    """The motion of the flow, with a remark."""
    status = pose.status
    if not status.message:
        status = replace(status, message=f"images not used: {report.refusal}")
    return pose.replace(status=status, photometric=report)


def _doubt(images: ImageFactor, away: float) -> str:
    """Why the motion to which the images lead cannot be believed, or ""."""
    if images.seen < MIN_SEEN:
        return f"{100 * images.seen:.0f} % of the pixels are seen by both cameras"
    correlated = images.correlation()
    if not correlated >= MIN_CORRELATION:
        return f"the two images do not match along the motion ({correlated:.2f} correlated)"
    if away > MAX_SHIFT:
        return (
            f"they lead {away:.1f} standard deviations away from the flow's motion"
        )
    return ""


def direct_start(
    pair: FramePair, T_start: np.ndarray | None = None, least: float = 0.5
) -> RelativePose | None:
    """The motion that images and depth maps agree on, from a start (4, 4) or the identity.

    None where they do not match, or the probability of being the camera's is below ``least``.
    """
    prev = pair.prev
    curr = pair.curr
    if any(x is None for x in (prev.rgb, prev.depth, curr.rgb, curr.depth)):
        return None
    ones = np.ones(prev.camera.shape, np.float32)
    planes = PlaneFactor(pair, ones, 1.0, FEW_POINTS)
    if len(planes.index) < MIN_POINTS:
        return None
    start = RelativePose(
        covariance=np.diag(SPREAD**2), weights=ones, method="direct"
    )
    T = np.eye(4) if T_start is None else T_start
    T, gain = follow_images(pair, T, ones, planes)
    guess = start.replace(T_curr_prev=T, photometric=PhotometricReport(gain=gain))
    # as if it were precise
    likely = _explained(pair, guess.replace(covariance=np.zeros((6, 6))))
    if likely.probability < least:
        return None
    start = start.replace(T_curr_prev=T, weights=likely.weights)
    found = refine_photometric(pair, start, prior_inflation=1.0)
    if found.photometric is None or not found.photometric.taken:
        return None
    answer = _explained(pair, found)
    return answer if answer.probability >= least else None


def follow_images(
    pair: FramePair, T: np.ndarray, weights: np.ndarray, planes: PlaneFactor
) -> tuple[np.ndarray, float]:
    """Follow reduced images, coarse to fine, and depth maps from a motion (4, 4).

    Args:
        pair: two frames with images and the depth of the first.
        T: T_curr_prev to start from.
        weights: (H, W) of the pixels.
        planes: the depth maps; without points they have no say.

    Returns:
        The motion, and the gain between the two images.
    """
    prev = pair.prev
    curr = pair.curr
    start = RelativePose(covariance=np.diag(SPREAD**2))
    gain = 1.0
    for by in REDUCTIONS:
        if min(prev.camera.shape) < by * MIN_SIDE:
            continue
        small = FramePair(reduced(prev, by), reduced(curr, by), None)
        height, width = small.prev.camera.shape
        small_weights = cv2.resize(
            weights, (width, height), interpolation=cv2.INTER_AREA
        )
        count = min(FEW_PIXELS, height * width // 4)
        depth = np.asarray(small.prev.depth)
        index = choose_pixels(blurred(small.prev), depth, small_weights, count)
        if not len(index):
            continue
        at = start.replace(T_curr_prev=T, weights=small_weights)
        factor = ImageFactor(small, at, index)
        planes.estimate(T)
        T = factor.follow(planes, NO_PRIOR, T, FEW_STEPS)
        gain = float(factor.light[0])
    return T, gain


def _explained(pair: FramePair, motion: RelativePose) -> RelativePose:
    """A motion with its pixels and probability; the evidence is the ego flow's standard deviation,
    px, by the covariance, and log of the share of the texture that lies in unexplained regions.
    """
    T = motion.T_curr_prev
    images = motion.photometric
    planes = PlaneFactor(pair, np.ones(pair.prev.camera.shape, np.float32), 1.0)
    assert images is not None
    planes.estimate(T)
    (height, width), (v, u), rows = (
        pair.prev.camera.shape,
        planes.index.T,
        planes.rows,
    )
    x, y = rows[kernels.PLACE :]
    z = rows[kernels.SURFACE]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    before, after = (blurred(frame) for frame in (pair.prev, pair.curr))
    now = cv2.remap(after, x, y, cv2.INTER_LINEAR).reshape(-1)
    residual = now - images.gain * before[v, u]

    def around(values: np.ndarray, side: int) -> np.ndarray:
        return np.asarray(cv2.blur(planes.on_grid(values), (side, side)))[
            planes.cells
        ]

    # it changes over the image
    light = around(np.where(inside, residual, 0), NEIGHBOURS)
    residual -= light / np.maximum(around(inside, NEIGHBOURS), 1e-6)
    beside = np.minimum(u + 1, width - 1)
    below = np.minimum(v + 1, height - 1)
    across = before[v, beside] - before[v, np.maximum(u - 1, 0)]
    down = before[below, u] - before[np.maximum(v - 1, 0), u]
    slope2: np.ndarray = across * across + down * down
    usual = 9 * (GREY_NOISE**2 + (SHIFT_PX / 2) ** 2 * slope2)
    depth = np.where(z > 0, rows[kernels.ROBUST], 1.0)
    follows = inside & (usual / (usual + residual * residual) * depth > 0.5)
    # a smooth surface looks the same wherever it went
    texture = np.where(inside, slope2 / (slope2 + FLAT**2), 0.0)
    unexplained = around(texture * ~follows, REGION) > 0.5 * around(texture, REGION)
    region = float(texture[unexplained].sum() / np.maximum(texture.sum(), 1e-6))
    points = planes.points[inside] @ T[:3, :3].T + T[:3, 3]
    J = np.concatenate(projection_rows(points, pair.curr.camera))
    std_px = np.sqrt(np.sum(J @ motion.covariance * J) / max(len(points), 1))
    evidence = float(std_px), float(np.log(region + SMALL_REGION))
    z = z[z > 0]
    weights = cv2.resize(
        planes.on_grid(follows), (width, height), interpolation=cv2.INTER_NEAREST
    )
    return motion.replace(
        inlier_ratio=float(np.count_nonzero(follows) / max(len(points), 1)),
        probability=probability_right(evidence, DIRECT_RIGHT),
        evidence=evidence,
        weights=weights,
        depth_noise=float(np.median(planes.noise(z) / z) / np.sqrt(2))
        if len(z)
        else 0.0,
        terms=("images", "depth"),
    )


def choose_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray, count: int
) -> np.ndarray:
    """(N, 2) int32 rows and columns of the pixels to use: strong gradients, evenly spread."""
    usable = (
        as_contiguous(depth),
        as_contiguous(weights, np.float32),
        np.float32(MIN_WEIGHT),
    )
    return kernels.select_pixels(grey, *usable, np.sqrt(grey.size / count))


def reduced(frame: Frame, by: int) -> Frame:
    """The frame at 1 / ``by`` of its size: the image averaged, depth picked."""
    known = _REDUCED.setdefault(frame, {})
    if by not in known:
        K = frame.camera
        height = frame.camera.height // by
        width = frame.camera.width // by
        whole = np.s_[: height * by, : width * by]
        assert frame.rgb is not None and frame.depth is not None
        rgb = cv2.resize(
            frame.rgb[whole], (width, height), interpolation=cv2.INTER_AREA
        )
        depth = frame.depth[whole][by // 2 :: by, by // 2 :: by]
        cx, cy = ((c - (by - 1) / 2) / by for c in (K.cx, K.cy))
        camera = Camera(K.fx / by, K.fy / by, cx, cy, height, width)
        known[by] = Frame(rgb, np.ascontiguousarray(depth), camera)
    return known[by]
