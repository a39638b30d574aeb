"""The join of the learned and the classical half: a pair in, its camera motion out.

The only place where network and pose meet. Until the network's weights are part of the package the
estimate is the classical refinement or a named baseline.
"""

from __future__ import annotations

import difflib
import time

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.pose.refinement import RefinementOptions, refine
from hybridvo.types import Camera, Frame, FramePair, RelativePose

__all__ = ["DEFAULT_METHOD", "METHODS", "check_method", "estimate", "warm_up"]

DEFAULT_METHOD = "refine"

_BASELINES = (
    "pnp-ransac",
    "pnp-ransac-tuned",
    "usac-magsac",
    "poselib",
    "opencv-rgbd",
    "open3d-rgbd",
    "identity",
)
_WITH_NETWORK = (
    "hybrid",
    "hybrid-flow",
    "pwvo",
    "pwvo-naive",
    "pixelwise",
    "vonet",
    "vonet-attention",
)

METHODS = (*_WITH_NETWORK[:2], "refine", *_WITH_NETWORK[2:], *_BASELINES)
"""Every method name, in the order of the results' tables."""


def check_method(method: str) -> None:
    """Refuse a method that cannot run here.

    Raises:
        InputError: an unknown name (the nearest known one is named), a method whose network has no
            weights yet, or a baseline whose package is missing (with the command that installs it).
    """
    if method not in METHODS:
        near = difflib.get_close_matches(str(method), METHODS, n=1, cutoff=0.4)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise InputError(f"method: '{method}' is unknown{hint}; known: {', '.join(METHODS)}.")
    if method in _WITH_NETWORK:
        raise InputError(
            f"method '{method}' needs network weights, which this version does not ship yet; "
            f"use --method refine (the classical refinement)."
        )
    if method in _BASELINES:
        from hybridvo.pose.baselines import missing

        absent = missing()
        if method in absent:
            raise InputError(f"method '{method}' cannot run here: {absent[method]}.")


def estimate(
    pair: FramePair,
    *,
    T_last: np.ndarray | None = None,
    method: str = DEFAULT_METHOD,
    options: RefinementOptions | None = None,
    seed: int = 0,
) -> RelativePose:
    """Camera motion of one pair.

    Args:
        pair: two frames and the flow between them.
        T_last: (4, 4) motion of the pair before: a start among others and a cue for the judge, for
            the methods that can use one.
        method: one of :data:`METHODS` that can run here.
        options: of the refinement.
        seed: of everything that is drawn at random; the same seed gives the same bytes.

    Returns:
        ``T_curr_prev`` with covariance and status. Bad data give a failed status, never an
        exception and never a value that is not finite.

    Raises:
        InputError: an unknown method, or one that cannot run here.

    Example:
        >>> import numpy as np
        >>> frame = Frame(None, np.ones((24, 32)), Camera(30, 30, 15.5, 11.5, 24, 32))
        >>> estimate(FramePair(frame, frame, None)).status.reason.value
        'no_flow'
    """
    if method == "refine":
        return refine(pair, T_last=T_last, options=options, seed=seed)
    check_method(method)
    from hybridvo.pose.baselines import baselines

    return baselines()[method](pair, seed=seed)


def warm_up(method: str = DEFAULT_METHOD) -> float:
    """Pay for the compilation (or the reading of its cache) before the first real frame.

    Runs the refinement once on a made pair of each size class. Costs half a minute on the very
    first call after an installation, half a second after that, and nothing in the same process.

    Returns:
        Seconds spent.
    """
    started = time.perf_counter()
    if method in _BASELINES:
        return 0.0
    # the second size takes the parallel kernels
    for height, width in ((48, 64), (320, 400)):
        camera = Camera(width, width, (width - 1) / 2, (height - 1) / 2, height, width)
        u = np.arange(width)
        v = np.arange(height)[:, None]
        depth = (4.0 + np.sin(u / 7.0) + np.cos(v / 5.0)).astype(np.float32)
        motion = se3_exp(np.array([0.02, -0.01, 0.05, 0.002, 0.004, -0.003]))
        flow = ego_flow(depth, motion, camera, camera).astype(np.float32)
        # a mask, a variance and a second motion: every branch is compiled
        flow[: height // 3, : width // 3] += 3.0
        valid = np.ones((height, width), np.bool_)
        variance = np.full((height, width), 0.01, np.float32)
        frame = Frame(None, depth, camera)
        refine(FramePair(frame, frame, flow, variance, valid))
        refine(FramePair(frame, frame, flow))
    return time.perf_counter() - started
