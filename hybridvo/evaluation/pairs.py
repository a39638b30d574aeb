"""Errors of one relative pose against the true one: the paper's three, and metric ones beside them.

The paper's EPE is no end-point error: it is the mean over pixels *and components* of the absolute
difference of ego flows at 128x256, with invalid pixels set to zero but counted. ``epe_l2_px`` is
the usual one: the mean L2 distance over valid pixels at native size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import matrix_to_euler_deg, rotation_angle
from hybridvo.types import Camera

__all__ = [
    "PAPER_SIZE",
    "dynamic_fraction",
    "mean_pair_errors",
    "pair_errors",
    "pair_facts",
]

PAPER_SIZE = (128, 256)
"""(height, width) at which the paper measures its EPE."""
PAPER_MAX_FLOW_PX = 400.0
"""Pixels whose true ego flow is at least this long count with error zero in the paper's EPE."""
_PAPER_MIN_DEPTH = 1e-12
_UNKNOWN_FLOW_PX = 1e9  # Middlebury's mark of an unknown flow vector
_BLOCK_PIXELS = 16384  # so that the dozen temporaries of a block stay in the second-level cache
NO_DEPTH = "no pixel has a valid depth and a true motion that stays in front of the camera"


def _check_pose(T: Any, name: str) -> np.ndarray:
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{name}: expected a finite (4, 4) transform, got shape {T.shape}.")
    return T


def _check_depth(depth: Any, camera_prev: Camera, camera_curr: Camera) -> np.ndarray:
    depth = np.asarray(depth)
    if depth.shape != camera_prev.shape or camera_curr.shape != camera_prev.shape:
        raise InputError(
            f"depth: expected shape {camera_prev.shape} of both cameras, got {depth.shape} and a "
            f"current camera of {camera_curr.shape}."
        )
    return depth


def _projection_rows(
    T: np.ndarray, camera_prev: Camera, camera_curr: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """(A (3, 3), b (3,)): homogeneous pixel of x at depth d is ``A (u, v, 1) + b / d``.

    The optical axis keeps scale one, so that its third entry is the moved depth over d.
    """
    A = camera_curr.K @ T[:3, :3] @ np.linalg.inv(camera_prev.K)
    return A, camera_curr.K @ T[:3, 3]


def _blocks(camera: Camera) -> Iterator[slice]:
    rows = max(1, _BLOCK_PIXELS // camera.width)
    for start in range(0, camera.height, rows):
        yield slice(start, min(start + rows, camera.height))


def _moved_pixels(
    A: np.ndarray, b: np.ndarray, u: np.ndarray, v: np.ndarray, inverse_depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, moved depth over depth) of a block of rows: ``v`` is a column, ``u`` a row."""
    s = A[2, 0] * u + (A[2, 1] * v + A[2, 2]) + b[2] * inverse_depth
    x = (A[0, 0] * u + (A[0, 1] * v + A[0, 2]) + b[0] * inverse_depth) / s
    y = (A[1, 0] * u + (A[1, 1] * v + A[1, 2]) + b[1] * inverse_depth) / s
    return x, y, s


def _native_epe(
    T_est: np.ndarray,
    T_true: np.ndarray,
    depth: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> float | None:
    """Mean L2 distance of the two ego flows over valid pixels, px; every pixel is looked at."""
    height, width = camera_prev.shape
    u, v = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]
    est = _projection_rows(T_est, camera_prev, camera_curr)
    true = _projection_rows(T_true, camera_prev, camera_curr)
    lost_error = float(np.hypot(width, height))
    total, count = 0.0, 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for rows in _blocks(camera_prev):
            inverse_depth = 1.0 / depth[rows].astype(np.float64)
            x_true, y_true, s_true = _moved_pixels(*true, u, v[rows], inverse_depth)
            x_est, y_est, s_est = _moved_pixels(*est, u, v[rows], inverse_depth)
            # 0 < 1/d < inf drops zero, negative, infinite and NaN depth at once
            valid = (inverse_depth > 0) & (inverse_depth < np.inf) & (s_true > 0)
            error = np.sqrt((x_est - x_true) ** 2 + (y_est - y_true) ** 2)
            lost = ~(s_est > 0) | ~np.isfinite(error)
            np.copyto(error, lost_error, where=lost)
            total += float(error.sum(where=valid))
            count += int(np.count_nonzero(valid))
    return total / count if count else None


def _paper_epe(
    T_est: np.ndarray,
    T_true: np.ndarray,
    depth: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> float | None:
    """Component mean of |F_ego - F~_ego| at 128x256; None where no pixel has a depth."""
    height, width = PAPER_SIZE
    small = []
    for camera in (camera_prev, camera_curr):
        sx, sy = width / camera.width, height / camera.height
        K = np.diag([sx, sy, 1.0]) @ camera.K
        K[:2, 2] = sx * (camera.cx + 0.5) - 0.5, sy * (camera.cy + 0.5) - 0.5
        small.append(K)
    # nearest at pixel centres: centre i of the small grid lies at (i + 0.5) / s - 0.5
    rows = ((np.arange(height) + 0.5) * camera_prev.height / height).astype(int)
    columns = ((np.arange(width) + 0.5) * camera_prev.width / width).astype(int)
    depth = depth[np.ix_(rows, columns)].astype(np.float64)
    valid = np.isfinite(depth) & (depth > 0)
    if not valid.any():
        return None
    depth = np.where(valid, depth, 1.0)
    u, v = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]
    K_inv = np.linalg.inv(small[0])
    flows = []
    for T in (T_est, T_true):
        A, b = small[1] @ T[:3, :3] @ K_inv, small[1] @ T[:3, 3]
        x, y, z = (depth * (a[0] * u + (a[1] * v + a[2])) + c for a, c in zip(A, b, strict=True))
        # |z| as in the published code ("to avoid reflection"): never undefined
        z = np.abs(z) + _PAPER_MIN_DEPTH
        flows.append((x / z - u, y / z - v))
    (du_est, dv_est), (du_true, dv_true) = flows
    counted = valid & (np.hypot(du_true, dv_true) < PAPER_MAX_FLOW_PX)
    errors = np.abs(du_est - du_true) + np.abs(dv_est - dv_true)
    return float(errors.sum(where=counted)) / (2 * height * width)


def pair_errors(
    T_est: np.ndarray,
    T_true: np.ndarray,
    depth_prev: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> dict[str, float | None]:
    """Errors of one estimated ``T_curr_prev``.

    Args:
        T_est: (4, 4) estimated ``T_curr_prev``, metres.
        T_true: (4, 4) true ``T_curr_prev``, metres.
        depth_prev: (H, W) true depth of the previous frame, metres; not finite or not positive is
            invalid.
        camera_prev: previous camera, (H, W).
        camera_curr: current camera, (H, W).

    Returns:
        ``r_err_deg``: mean over the axes of the absolute Euler X-Y-Z difference, degrees (wrapped
        to 180). ``t_err``: mean over the components of the absolute translation difference, m.
        ``epe``: the paper's, px at 128x256. ``epe_l2_px``: mean L2 distance of the ego flows over
        valid pixels at native size; a pixel that the estimate puts behind the camera counts with
        the image diagonal. ``rot_err_deg``: geodesic angle. ``trans_err``: norm of the translation
        difference, m. ``epe`` and ``epe_l2_px`` are None where no pixel is valid.

    Raises:
        InputError: poses that are not finite, shapes that do not match.
    """
    T_est, T_true = _check_pose(T_est, "T_est"), _check_pose(T_true, "T_true")
    depth = _check_depth(depth_prev, camera_prev, camera_curr)
    euler = matrix_to_euler_deg(T_est[:3, :3]) - matrix_to_euler_deg(T_true[:3, :3])
    euler = (euler + 180.0) % 360.0 - 180.0
    translation = T_est[:3, 3] - T_true[:3, 3]
    return {
        "r_err_deg": float(np.abs(euler).mean()),
        "t_err": float(np.abs(translation).mean()),
        "epe": _paper_epe(T_est, T_true, depth, camera_prev, camera_curr),
        "epe_l2_px": _native_epe(T_est, T_true, depth, camera_prev, camera_curr),
        "rot_err_deg": float(np.degrees(rotation_angle(T_est[:3, :3] @ T_true[:3, :3].T))),
        "trans_err": float(np.linalg.norm(translation)),
    }


def mean_pair_errors(pairs: Iterable[Mapping[str, float | None]]) -> dict[str, Any]:
    """Means and medians of :func:`pair_errors` over pairs, under the names of ``results.json``.

    Args:
        pairs: what :func:`pair_errors` returned for each pair.

    Returns:
        ``pairs`` (their number), the means ``r_err_deg``, ``t_err``, ``epe``, ``epe_l2_px``,
        ``rot_err_deg_mean``, ``trans_err_mean``, the medians ``rot_err_deg_median``,
        ``trans_err_median``, and ``reasons`` for every value that is None or leaves pairs out.
    """
    pairs = list(pairs)
    report: dict[str, Any] = {"pairs": len(pairs)}
    reasons: dict[str, str] = {}
    for key, name, statistic in (
        ("r_err_deg", "r_err_deg", np.mean),
        ("t_err", "t_err", np.mean),
        ("epe", "epe", np.mean),
        ("epe_l2_px", "epe_l2_px", np.mean),
        ("rot_err_deg_mean", "rot_err_deg", np.mean),
        ("rot_err_deg_median", "rot_err_deg", np.median),
        ("trans_err_mean", "trans_err", np.mean),
        ("trans_err_median", "trans_err", np.median),
    ):
        known = [value for pair in pairs if (value := pair.get(name)) is not None]
        report[key] = float(statistic(known)) if known else None
        if not pairs:
            reasons[key] = "no pair with truth"
        elif len(known) < len(pairs):
            reasons[key] = (
                f"unknown for {len(pairs) - len(known)} of {len(pairs)} pairs: {NO_DEPTH}"
            )
    report["reasons"] = reasons
    return report


def dynamic_fraction(
    flow_true: np.ndarray,
    depth_prev: np.ndarray,
    T_true: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
    *,
    threshold_px: float = 1.0,
) -> float | None:
    """Share of valid pixels whose true flow differs from the true ego flow by more than 1 px.

    Args:
        flow_true: (H, W, 2) true total flow, px; NaN or components above 1e9 are unknown.
        depth_prev: (H, W) true depth, metres.
        T_true: (4, 4) true ``T_curr_prev``.
        camera_prev: previous camera, (H, W).
        camera_curr: current camera, (H, W).
        threshold_px: L2 difference, px, above which a pixel moves by itself.

    Returns:
        The share in [0, 1]; None where no pixel has flow, depth and a point in front of the camera.

    Raises:
        InputError: shapes that do not match.
    """
    T_true = _check_pose(T_true, "T_true")
    depth = _check_depth(depth_prev, camera_prev, camera_curr)
    flow = np.asarray(flow_true)
    if flow.shape != (*camera_prev.shape, 2):
        raise InputError(f"flow_true: expected {(*camera_prev.shape, 2)}, got {flow.shape}.")
    height, width = camera_prev.shape
    u, v = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]
    true = _projection_rows(T_true, camera_prev, camera_curr)
    moving = count = 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for rows in _blocks(camera_prev):
            inverse_depth = 1.0 / depth[rows].astype(np.float64)
            x, y, s = _moved_pixels(*true, u, v[rows], inverse_depth)
            du, dv = flow[rows, :, 0].astype(np.float64), flow[rows, :, 1].astype(np.float64)
            known = (np.abs(du) < _UNKNOWN_FLOW_PX) & (np.abs(dv) < _UNKNOWN_FLOW_PX)
            valid = known & (inverse_depth > 0) & (inverse_depth < np.inf) & (s > 0)
            difference = np.hypot(x - u - du, y - v[rows] - dv)
            moving += int(np.count_nonzero(valid & (difference > threshold_px)))
            count += int(np.count_nonzero(valid))
    return moving / count if count else None


def pair_facts(
    T_true: np.ndarray | None,
    depth_prev: np.ndarray | None,
    camera_prev: Camera,
    camera_curr: Camera,
    flow_true: np.ndarray | None = None,
) -> dict[str, float | None]:
    """What may explain an error: how much moves, how far, before what. None where unknown.

    Args:
        T_true: (4, 4) true ``T_curr_prev``, metres, or None.
        depth_prev: (H, W) depth of the previous frame, metres, or None.
        camera_prev: previous camera, (H, W).
        camera_curr: current camera, (H, W).
        flow_true: (H, W, 2) true flow of everything, px, NaN where unknown; None where there is
            none, or where it holds the motion of the camera alone.

    Returns:
        ``dynamic_fraction`` (:func:`dynamic_fraction`); ``flow_magnitude_px``: median length of the
        true ego flow over every second row and column; ``rotation_deg`` and ``translation_m`` of
        the true motion; ``depth_spread``: 90th over 10th percentile of the valid depth, one for a
        plane parallel to the image.

    Raises:
        InputError: a pose that is not finite, shapes that do not match.
    """
    facts: dict[str, float | None] = dict.fromkeys(
        ("dynamic_fraction", "flow_magnitude_px", "rotation_deg", "translation_m", "depth_spread")
    )
    if T_true is not None:
        T_true = _check_pose(T_true, "T_true")
        facts["rotation_deg"] = float(np.degrees(rotation_angle(T_true[:3, :3])))
        facts["translation_m"] = float(np.linalg.norm(T_true[:3, 3]))
    if depth_prev is None:
        return facts
    depth = _check_depth(depth_prev, camera_prev, camera_curr)
    if T_true is not None and flow_true is not None:
        facts["dynamic_fraction"] = dynamic_fraction(
            flow_true, depth, T_true, camera_prev, camera_curr
        )
    # a percentile over a quarter of the pixels is known to far less than the width of a bin
    depth = depth[::2, ::2].astype(np.float64)
    valid = np.isfinite(depth) & (depth > 0)
    if not valid.any():
        return facts
    low, high = np.quantile(depth[valid], [0.1, 0.9])
    facts["depth_spread"] = float(high / low)
    if T_true is not None:
        v, u = np.nonzero(valid)
        A_b = _projection_rows(T_true, camera_prev, camera_curr)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y, s = _moved_pixels(*A_b, 2.0 * u, 2.0 * v, 1.0 / depth[valid])
            length = np.hypot(x - 2.0 * u, y - 2.0 * v)[s > 0]
        if length.size:
            facts["flow_magnitude_px"] = float(np.median(length))
    return facts
