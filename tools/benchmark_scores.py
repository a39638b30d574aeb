"""What the parts of the benchmark share: errors of one answer, quartiles, intervals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

CHI2_6_3SIGMA = 20.062
"""Quantile 0.9973 of chi-square with six degrees of freedom: the 3 sigma ellipsoid."""

FAILURE_PX = 1.0


def score(result: Any, pair: Any, truth: dict[str, Any]) -> dict[str, Any]:
    """Errors of one answer against the truth; a failed one is the identity that it carries."""
    from hybridvo.geometry import invert, rotation_angle

    T, T_true = result.T_curr_prev, truth["T_curr_prev"]
    error = T @ invert(T_true)
    nees = normalised_error(result, T_true)
    hit = [epe(h.T_curr_prev, pair, truth) < FAILURE_PX for h in result.hypotheses]
    return {
        "status": str(result.status),
        "estimated": bool(result.ok),
        "epe_px": epe(T, pair, truth),
        "rotation_error_deg": float(np.rad2deg(rotation_angle(error[:3, :3]))),
        "translation_error_m": float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])),
        "nees": nees if np.isfinite(nees) else None,
        "contained": bool(nees < CHI2_6_3SIGMA),
        "inlier_ratio": float(result.inlier_ratio),
        "hypotheses": len(hit),
        "hypothesis_hit": any(hit) if hit else None,
    }


def normalised_error(result: Any, T_true: np.ndarray) -> float:
    """delta^T C^-1 delta of the left perturbation delta; inf where C is singular."""
    from hybridvo.geometry import invert, se3_log

    delta = se3_log(result.T_curr_prev @ invert(T_true))
    try:
        return float(delta @ np.linalg.solve(result.covariance, delta))
    except np.linalg.LinAlgError:
        return float("inf")


def epe(T: np.ndarray, pair: Any, truth: dict[str, Any]) -> float:
    """Mean L2 end-point error (px, native size) of the ego flow of ``T`` over the true depth.

    Every second pixel each way: the field is smooth within a surface. Where the true depth is NaN
    nothing is compared; a point that a wrong motion puts behind the camera counts as an error of
    one image width.
    """
    prev, curr = pair.prev.camera, pair.curr.camera
    depth = truth["depth_true"][::2, ::2].astype(np.float64)
    x = (np.arange(0, prev.width, 2) - prev.cx) / prev.fx * depth
    y = (np.arange(0, prev.height, 2)[:, None] - prev.cy) / prev.fy * depth

    def seen(M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        X, Y, Z = (row[0] * x + row[1] * y + row[2] * depth + row[3] for row in M[:3])
        Z = np.where(Z > 1e-6, Z, np.nan)
        return curr.fx * X / Z, curr.fy * Y / Z, Z

    u, v, _ = seen(T)
    u_true, v_true, z_true = seen(truth["T_curr_prev"])
    error = np.hypot(u - u_true, v - v_true)[np.isfinite(z_true)]
    return float(np.minimum(np.nan_to_num(error, nan=curr.width), curr.width).mean())


def is_failure(record: dict[str, Any]) -> bool:
    """Wrong by more than a pixel, or no answer at all."""
    return record["epe_px"] > FAILURE_PX or not record["estimated"]


def quartiles(values: list[float]) -> dict[str, float]:
    """Median, both quartiles and the largest value."""
    q25, median, q75 = np.percentile(values, [25, 50, 75])
    return {"median": float(median), "q25": float(q25), "q75": float(q75), "max": max(values)}


def wilson(count: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Interval of a share at 95 %, score method (Wilson, JASA 22, 1927)."""
    if trials == 0:
        return 0.0, 1.0
    share = count / trials
    scale = 1 + z * z / trials
    centre = (share + z * z / (2 * trials)) / scale
    half = z / scale * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    # exact at the ends, where the formula is off by a rounding error
    return (0.0 if count == 0 else centre - half), (1.0 if count == trials else centre + half)


def proportion(count: int, trials: int) -> dict[str, Any]:
    """Count, trials, share and its 95 % interval; share None without a trial."""
    low, high = wilson(count, trials)
    share = count / trials if trials else None
    return {"count": count, "of": trials, "share": share, "low": low, "high": high}
