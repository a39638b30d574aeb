"""Errors of single motions, and their means over many; a failed estimate counts as no motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from hybridvo.core import geometry
from hybridvo.core.depth_units import typical_depth
from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.image_io import UNKNOWN_FLOW
from hybridvo.io.data.resize import resize_camera
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.truth import true_motion
from hybridvo_lab.calibration import (
    TRUTH_NOISE,
    WRONG_PX,
)
from hybridvo_lab.evaluation.belief import is_wrong, wrong_limits

# probability that the stated interval of a rate covers it
RATE_CONFIDENCE = 0.95
# of a depth map, whose ratio is stated in reports
DEPTH_SPREAD_QUANTILES = (0.1, 0.9)
# px between true flow and true ego flow, above which a pixel moves by itself
MOVING_PX = 1.0

PAPER_SIZE = (128, 256)
"""Height and width, pixels, at which the paper measures its EPE."""
PAPER_MAX_FLOW_PX = 400.0
"""Length of the true ego flow from which the paper does not count a pixel, at that size."""
PAPER_MIN_DEPTH = 1e-12
"""What the paper's code adds to |z|, so that it can divide by it."""
SAME_INTRINSICS = 1e-9
"""Relative difference of focal lengths and centres up to which two cameras are the same."""

MEAN_ERRORS = ("r_err_deg", "t_err", "epe", "epe_l2_px")
"""Errors of motions of which the mean is reported."""
MEAN_AND_MEDIAN_ERRORS = ("rot_err_deg", "trans_err")
"""Errors of motions of which mean and median are reported."""
ERRORS = (*MEAN_ERRORS, *MEAN_AND_MEDIAN_ERRORS)
PATH_KEYS = ("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg", "ate_rmse_origin")
"""Errors of a path that a comparison reports."""
SECOND_KEYS = ("rpe_trans_rmse_s", "rpe_rot_rmse_deg_s")
"""Relative errors over one second, of paths that last so long."""
RATE_KEYS = (
    "wrong",
    "wrong_share",
    "wrong_share_low",
    "wrong_share_high",
    "wrong_limit_px",
)
"""What :func:`wrong_motions` returns."""
NO_PAIRS = "no pair was estimated, or none has ground truth"
NO_TRUTH = "the sequence has no ground truth for these frames"
NO_MOVING = (
    "needs true flow of the whole scene (moving objects included) and ground truth"
)


class ErrorFactor(NamedTuple):
    """What may explain an error."""

    label: str
    edges: tuple[float, ...]  # of the bins of a chart


FACTORS: Mapping[str, ErrorFactor] = {
    "dynamic_fraction": ErrorFactor(
        "fraction of pixels that move", (0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1)
    ),
    "flow_magnitude_px": ErrorFactor(
        "median true ego flow [px]", (0, 1, 2, 5, 10, 20, 50, math.inf)
    ),
    "rotation_deg": ErrorFactor(
        "true rotation [deg]", (0, 0.1, 0.3, 1, 3, 10, 180)
    ),
    "translation_m": ErrorFactor(
        "true translation [m]", (0, 0.003, 0.01, 0.03, 0.1, 0.3, 1, math.inf)
    ),
    "depth_spread": ErrorFactor(
        "90th over 10th percentile of depth", (1, 1.5, 2, 4, 8, 16, math.inf)
    ),
}
"""Columns of ``pairs.csv`` that may explain an error."""
PAIR_COLUMNS = (
    "sequence",
    "index",
    "method",
    "flow_source",
    "status",
    "epe_l2_px",
    "rot_err_deg",
    "trans_err",
    "ms",
    "r_err_deg",
    "t_err",
    "epe",
    "flow_ms",
    *FACTORS,
    "prev",
    "next",
    "message",
    "wrong_limit_px",
    "probability",
    "sigma_trans",
    "sigma_rot_deg",
    "nees",
)
"""The columns of ``pairs.csv``."""
TEXT_COLUMNS = ("sequence", "method", "flow_source", "status", "message")
"""Those that hold texts; the others hold numbers."""


# -- one motion --------------------------------------------------------------------------


def step_errors(
    sequence: Sequence, prev: Frame | None, curr: int, T_curr_prev: np.ndarray
) -> dict[str, float | None]:
    """Compute the errors of a motion to frame ``curr``.

    Args:
        sequence: The sequence, which may have true poses.
        prev: The frame from which the motion starts.
        curr: Index of the frame to which it leads.
        T_curr_prev: The estimated motion.

    Returns:
        The figures of :func:`pair_errors`, and ``wrong_limit_px``, the ego-flow error beyond which
        this motion is called wrong. All are None where the ground truth is not known.
    """
    T_gt = None if prev is None else true_motion(sequence, prev.index, curr)
    if prev is None or T_gt is None:
        return dict.fromkeys((*ERRORS, "wrong_limit_px"))
    depth = prev.depth
    if depth is None:
        depth = np.full(prev.camera.shape, np.nan)
    errors = pair_errors(
        T_curr_prev, T_gt, depth, prev.camera, sequence.camera(curr)
    )
    limit = wrong_limit(sequence.kind, prev.camera, depth)
    return errors | {"wrong_limit_px": limit}


def wrong_limit(kind: str, camera: Camera, depth: np.ndarray) -> float:
    """Return the error of the ego flow, pixels, beyond which a motion is called wrong.

    Args:
        kind: The reader's kind, which states how much the ground truth errs.
        camera: The camera of the previous frame.
        depth: Its depth (H, W), metres.

    Returns:
        ``WRONG_PX``, or what the error of the ground truth moves a pixel at the median depth by if
        that is
        more: an estimate cannot be judged more finely than the ground truth is known.
    """
    degrees, metres = TRUTH_NOISE.get(kind, (0.0, 0.0))
    median = typical_depth(depth)
    rotation = np.radians(degrees)
    parallax = metres / median if median else 0.0
    focal_length = np.sqrt(camera.fx * camera.fy)
    truth_error_px = float(focal_length * np.hypot(rotation, parallax))
    return max(WRONG_PX, truth_error_px)


def pair_errors(
    T_est: np.ndarray,
    T_gt: np.ndarray,
    depth_prev: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> dict[str, float | None]:
    """Compute the errors of an estimated motion.

    Args:
        T_est: The estimated T_curr_prev (4, 4).
        T_gt: The true one.
        depth_prev: (H, W) metres, of the previous frame.
        camera_prev: The camera of the previous frame.
        camera_curr: The camera of the current frame.

    Returns:
        - ``r_err_deg`` and ``t_err``, the paper's: mean absolute differences of the Euler angles
          X-Y-Z, degrees, and of the components of the translation, metres.
        - ``epe``, the paper's, pixels at 128x256; None without valid depth.
        - ``epe_l2_px``: mean distance of the ego flows at native size, with the image diagonal for
          a pixel that comes to lie behind the camera; None without valid depth.
        - ``rot_err_deg``: the angle between the rotations.
        - ``trans_err``: the distance of the translations, metres.
    """
    depth = np.asarray(depth_prev)
    translation = T_est[:3, 3] - T_gt[:3, 3]
    relative_rotation = T_est[:3, :3] @ T_gt[:3, :3].T
    angle = float(np.degrees(geometry.rotation_angle(relative_rotation)))
    cameras = (camera_prev, camera_curr)
    error_px = geometry.ego_flow_error(T_est, T_gt, depth, *cameras)
    return {
        "r_err_deg": float(np.abs(_euler_difference(T_est, T_gt)).mean()),
        "t_err": float(np.abs(translation).mean()),
        "epe": _paper_epe(T_est, T_gt, depth, *cameras),
        "epe_l2_px": None if math.isnan(error_px) else error_px,
        "rot_err_deg": angle,
        "trans_err": float(np.linalg.norm(translation)),
    }


def _euler_difference(T_est: np.ndarray, T_gt: np.ndarray) -> np.ndarray:
    """Return the differences (3,) of the Euler angles X-Y-Z, degrees, from -180 to 180."""
    est = geometry.matrix_to_euler_deg(T_est[:3, :3])
    gt = geometry.matrix_to_euler_deg(T_gt[:3, :3])
    return (est - gt + 180.0) % 360.0 - 180.0


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def _paper_epe(
    T_est: np.ndarray,
    T_gt: np.ndarray,
    depth: np.ndarray,
    prev: Camera,
    curr: Camera,
) -> float | None:
    """Return the mean of |F_ego - F~_ego| over pixels and components, as the paper measures it.

    The size is 128x256 pixels; invalid pixels, and those with a long true flow, count as right.
    """
    nearest = np.ix_(*map(geometry.nearest_pixels, prev.shape, PAPER_SIZE))
    small_depth = np.asarray(depth[nearest], dtype=np.float64)
    is_valid = np.isfinite(small_depth) & (small_depth > 0)
    if not is_valid.any():
        return None
    small_prev = resize_camera(prev, *PAPER_SIZE)
    small_curr = resize_camera(curr, *PAPER_SIZE)
    points = geometry.backproject(
        np.where(is_valid, small_depth, np.nan), small_prev
    )
    est = _paper_ego_flow(T_est, points, small_curr)
    gt = _paper_ego_flow(T_gt, points, small_curr)
    is_counted = is_valid & (np.linalg.norm(gt, axis=2) < PAPER_MAX_FLOW_PX)
    total = np.abs(est - gt)[is_counted].sum()
    return float(total) / (2 * is_valid.size)


def _paper_ego_flow(
    T_curr_prev: np.ndarray, points: np.ndarray, camera: Camera
) -> np.ndarray:
    """Return the ego flow (H, W, 2), pixels, of points (H, W, 3), metres, as the paper's code does.

    That code divides by |z| "to avoid reflection", so that the flow is never undefined.
    """
    moved = geometry.transform_points(T_curr_prev, points)
    projected = moved @ camera.K.T
    depth = np.abs(projected[..., 2:]) + PAPER_MIN_DEPTH
    pixels = projected[..., :2] / depth
    return pixels - geometry.pixel_grid(*PAPER_SIZE)


def pair_factors(sequence: Sequence, prev: int, curr: int) -> dict[str, float]:
    """Measure those of :data:`FACTORS` that are known of a pair."""
    T_gt = true_motion(sequence, prev, curr)
    depth = sequence.frame(prev).depth
    if T_gt is None or depth is None:
        return {}
    angle = geometry.rotation_angle(T_gt[:3, :3])
    factors = {
        "rotation_deg": float(np.degrees(angle)),
        "translation_m": float(np.linalg.norm(T_gt[:3, 3])),
    }
    valid_depth = depth[np.isfinite(depth) & (depth > 0)]
    if len(valid_depth):
        low, high = np.quantile(valid_depth, DEPTH_SPREAD_QUANTILES)
        factors["depth_spread"] = float(high / low)
    ego = geometry.ego_flow(
        depth, T_gt, sequence.camera(prev), sequence.camera(curr)
    )
    is_valid = np.isfinite(ego).all(axis=2)
    if is_valid.any():
        lengths = np.linalg.norm(ego[is_valid], axis=1)
        factors["flow_magnitude_px"] = float(np.median(lengths))
    if curr == prev + 1:
        fraction = _dynamic_fraction(sequence, prev, ego)
        if fraction is not None:
            factors["dynamic_fraction"] = fraction
    return factors


def _dynamic_fraction(
    sequence: Sequence, prev: int, ego: np.ndarray
) -> float | None:
    """Return the fraction of the pixels that move by themselves; None where it is not known.

    Args:
        sequence: The sequence.
        prev: Index of the first frame of the pair.
        ego: (H, W, 2) pixels, the true ego flow.
    """
    # The true flow of TartanAir is that of the camera alone.
    shows_objects = sequence.flow_is_true and sequence.kind != "tartanair"
    if not shows_objects:
        return None
    try:
        flow_gt, _ = sequence.flow(prev)
    except (InputError, OSError):
        return None
    is_known = (np.abs(flow_gt) < UNKNOWN_FLOW).all(axis=2)
    is_known &= np.isfinite(ego).all(axis=2)
    if not is_known.any():
        return None
    own_flow = np.linalg.norm(ego[is_known] - flow_gt[is_known], axis=1)
    return float((own_flow > MOVING_PX).mean())


# -- many motions ------------------------------------------------------------------------


def pair_table(pairs: Any) -> pd.DataFrame:
    """Make a table of :data:`PAIR_COLUMNS`; unknown numbers are NaN.

    Args:
        pairs: Dictionaries, or a table.
    """
    table = pd.DataFrame(pairs, columns=list(PAIR_COLUMNS))
    numbers = table.columns.difference(list(TEXT_COLUMNS))
    table[numbers] = table[numbers].apply(pd.to_numeric)
    return table


def wrong_motions(pairs: pd.DataFrame) -> dict[str, Any]:
    """Count the motions that failed or err by more than their limit.

    Args:
        pairs: A table of :func:`pair_table`.

    Returns:
        ``wrong``, a count; ``wrong_share`` of the motions with a known outcome, with its Wilson
        interval (95 %) from ``wrong_share_low`` to ``wrong_share_high``; ``wrong_limit_px``, the
        median of the limits. All are None where no outcome is known.
    """
    has_failed = pairs["status"].str.startswith("failed")
    is_known = has_failed | pairs["epe_l2_px"].notna()
    total = int(is_known.sum())
    if not total:
        return dict.fromkeys(RATE_KEYS)
    # takes half a second to import: only where there is something to count
    from scipy.stats import binomtest

    wrong = int(is_wrong(pairs).sum())
    interval = binomtest(wrong, total).proportion_ci(
        RATE_CONFIDENCE, method="wilson"
    )
    return {
        "wrong": wrong,
        "wrong_share": wrong / total,
        "wrong_share_low": float(interval.low),
        "wrong_share_high": float(interval.high),
        "wrong_limit_px": float(wrong_limits(pairs)[is_known].median()),
    }


def pair_scores(pairs: pd.DataFrame) -> dict[str, Any]:
    """Compute every mean, median and count over some pairs, and why some of them are None."""
    scores: dict[str, Any] = _means(pairs)
    scores |= wrong_motions(pairs)
    scores["pairs"] = len(pairs)
    scores["pairs_scored"] = int(pairs["rot_err_deg"].notna().sum())
    reasons = {name: NO_PAIRS for name, value in scores.items() if value is None}
    if "dynamic_fraction" in reasons:
        reasons["dynamic_fraction"] = NO_MOVING
    for state in ("failed", "degraded"):
        scores[state] = int(pairs["status"].str.startswith(state).sum())
    scores["reasons"] = reasons
    return scores


def _means(pairs: pd.DataFrame) -> dict[str, float | None]:
    """Return means and medians over some pairs; None where no pair has a value."""
    scored = pairs[pairs["rot_err_deg"].notna()]
    figures = {name: scored[name].mean() for name in MEAN_ERRORS}
    for name in MEAN_AND_MEDIAN_ERRORS:
        figures[f"{name}_mean"] = scored[name].mean()
        figures[f"{name}_median"] = scored[name].median()
    figures["epe_l2_px_median"] = pairs["epe_l2_px"].median()
    figures["ms_per_pair_median"] = pairs["ms"].median()
    figures["flow_ms_median"] = pairs["flow_ms"].median()
    figures["dynamic_fraction"] = pairs["dynamic_fraction"].mean()
    return {
        name: None if math.isnan(value) else float(value)
        for name, value in figures.items()
    }


# -- lines of a comparison ---------------------------------------------------------------


def sequence_row(
    pairs: pd.DataFrame, path: Mapping[str, Any] | None, named: Mapping[str, Any]
) -> dict[str, Any]:
    """Make the line of a method on a sequence.

    Args:
        pairs: Its motions, a table of :func:`pair_table`.
        path: What ``evaluate`` returned for its path; None without ground truth.
        named: What the line begins with: sequence, method, sources.
    """
    row = {**named, **pair_scores(pairs)}
    if path is None:
        path = {"alignment": "se3", "reasons": dict.fromkeys(PATH_KEYS, NO_TRUTH)}
    for key, reason in path["reasons"].items():
        if key in PATH_KEYS:
            row["reasons"][key] = reason
    for name in ("alignment", *PATH_KEYS, *SECOND_KEYS):
        row[name] = path.get(name)
    if "reasons_s" in path:
        row["reasons"] |= dict.fromkeys(SECOND_KEYS, path["reasons_s"])
    return row


def total_row(pairs: pd.DataFrame, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Make the line of a method over all sequences.

    Args:
        pairs: The motions on all sequences, which are pooled.
        rows: Its lines of :func:`sequence_row`, whose trajectory errors are averaged.
    """
    sources = dict.fromkeys(row["depth_source"] for row in rows)
    total = {
        "method": rows[0]["method"],
        "flow_source": rows[0]["flow_source"],
        "sequence": "all",
        "depth_source": ", ".join(sources),
        "alignment": "se3",
        "sequences": len(rows),
        **pair_scores(pairs),
    }
    for key in (*PATH_KEYS, *SECOND_KEYS):
        known = [row[key] for row in rows if row[key] is not None]
        total[key] = float(np.mean(known)) if known else None
        missing = [
            f"{row['sequence']}: {row['reasons'].get(key, NO_TRUTH)}"
            for row in rows
            if row[key] is None
        ]
        if missing:
            total["reasons"][key] = (
                f"mean over {len(known)} of {len(rows)} sequences; "
                f"without {'; '.join(missing)}"
            )
    return total


# -- which pairs the paper keeps ----------------------------------------------------------


def same_intrinsics(first: Camera, second: Camera) -> bool:
    """Return whether two cameras are the same, as in the pairs that the paper keeps."""
    if first.shape != second.shape:
        return False
    tolerance = SAME_INTRINSICS * first.fx
    return np.allclose(first.K, second.K, rtol=0, atol=tolerance)
