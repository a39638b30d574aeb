"""Errors of single motions, and their means over many; a failed one counts as no motion."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from hybridvo import geometry
from hybridvo.calibration import MOVING_PX, TRUTH_NOISE, WRONG_PX
from hybridvo.data.image_io import UNKNOWN_FLOW
from hybridvo.data.resize import resize_camera
from hybridvo.data.sequence import Sequence
from hybridvo.depth_units import typical_depth
from hybridvo.errors import InputError
from hybridvo.files import parse_yaml
from hybridvo.trajectory import Trajectory
from hybridvo.types import Camera, Frame

PAPER_SIZE = (128, 256)  # height and width at which the paper measures its EPE
ERRORS = ("r_err_deg", "t_err", "epe", "epe_l2_px", "rot_err_deg", "trans_err")
PATH_KEYS = ("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg", "ate_rmse_origin")
NO_PAIRS = "no pair was estimated, or none has ground truth"
NO_TRUTH = "the sequence has no ground truth for these frames"
NO_MOVING = (
    "needs true flow of the whole scene (moving objects included) and ground truth"
)
FACTORS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "dynamic_fraction": (
        "share of pixels that move",
        (0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1),
    ),
    "flow_magnitude_px": (
        "median true ego flow [px]",
        (0, 1, 2, 5, 10, 20, 50, math.inf),
    ),
    "rotation_deg": ("true rotation [deg]", (0, 0.1, 0.3, 1, 3, 10, 180)),
    "translation_m": (
        "true translation [m]",
        (0, 0.003, 0.01, 0.03, 0.1, 0.3, 1, math.inf),
    ),
    "depth_spread": (
        "90th over 10th percentile of depth",
        (1, 1.5, 2, 4, 8, 16, math.inf),
    ),
}
"""What may explain an error: columns of ``pairs.csv``, with a label and the edges of the bins."""
PAIR_COLUMNS = (
    *("sequence", "index", "method", "flow_source", "status"),
    *("epe_l2_px", "rot_err_deg", "trans_err", "ms"),
    *("r_err_deg", "t_err", "epe", "flow_ms", *FACTORS, "prev", "next", "message"),
    "wrong_limit_px",
)
"""The columns of ``pairs.csv``."""


def true_motion(sequence: Sequence, prev: int, curr: int) -> np.ndarray | None:
    """Return the true T_curr_prev (4, 4) between two frames, or None where it is not known."""
    if sequence.poses is None:
        return None
    T = geometry.invert(sequence.poses[curr]) @ sequence.poses[prev]
    return T if np.isfinite(T).all() else None


def true_trajectory(
    sequence: Sequence, indices: Iterable[int]
) -> Trajectory | None:
    """Return the true poses of those frames that have one, or None where there are none."""
    poses = sequence.poses
    known = [
        i for i in indices if poses is not None and np.isfinite(poses[i]).all()
    ]
    if poses is None or not known:
        return None
    # text files carry six digits: made orthonormal as the trajectory demands
    T = np.stack([geometry.pose_matrix(poses[i][:3]) for i in known])
    return Trajectory(sequence.timestamps[known], T)


def step_errors(
    sequence: Sequence, prev: Frame | None, curr: int, T_curr_prev: np.ndarray
) -> dict[str, float | None]:
    """Compute :func:`pair_errors` of a motion to frame ``curr``; None where truth is unknown.

    ``wrong_limit_px`` is the ego-flow error beyond which this motion is called wrong.
    """
    T_gt = None if prev is None else true_motion(sequence, prev.index, curr)
    if prev is None or T_gt is None:
        return dict.fromkeys((*ERRORS, "wrong_limit_px"))
    depth = (
        prev.depth if prev.depth is not None else np.full(prev.camera.shape, np.nan)
    )
    errors = pair_errors(
        T_curr_prev, T_gt, depth, prev.camera, sequence.camera(curr)
    )
    return errors | {
        "wrong_limit_px": wrong_limit(sequence.kind, prev.camera, depth)
    }


def wrong_limit(kind: str, camera: Camera, depth: np.ndarray) -> float:
    """Return the error of the ego flow, px, beyond which a motion is called wrong.

    Args:
        kind: The reader's kind, which says how much the truth errs.
        camera: The camera of the previous frame.
        depth: Its depth (H, W), metres.

    Returns:
        One pixel, or what the truth's own error moves a pixel at the median depth by if that is
        more: a motion cannot be held against a truth more finely than the truth is known.
    """
    degrees, metres = TRUTH_NOISE.get(kind, (0.0, 0.0))
    median = typical_depth(depth)
    shift = metres / median if median else 0.0
    moved = np.hypot(np.radians(degrees), shift)
    return max(WRONG_PX, float(np.sqrt(camera.fx * camera.fy) * moved))


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def _paper_epe(
    T_est: np.ndarray,
    T_gt: np.ndarray,
    depth: np.ndarray,
    prev: Camera,
    curr: Camera,
) -> float | None:
    """Mean over pixels and components of |F_ego - F~_ego| at 128x256; invalid pixels count as 0."""
    pick = np.ix_(*map(geometry.nearest_pixels, prev.shape, PAPER_SIZE))
    small = np.asarray(depth[pick], dtype=np.float64)
    valid = np.isfinite(small) & (small > 0)
    if not valid.any():
        return None
    prev, curr = (resize_camera(camera, *PAPER_SIZE) for camera in (prev, curr))
    points = geometry.backproject(np.where(valid, small, np.nan), prev)
    flows = []
    for T in (T_est, T_gt):
        moved = (points @ T[:3, :3].T + T[:3, 3]) @ curr.K.T
        # the published code takes |z| "to avoid reflection", so that it is never undefined
        moved = moved[..., :2] / (np.abs(moved[..., 2:]) + 1e-12)
        flows.append(moved - geometry.pixel_grid(*PAPER_SIZE))
    # px; longer counts as right
    counted = valid & (np.linalg.norm(flows[1], axis=2) < 400.0)
    return float(np.abs(flows[0] - flows[1])[counted].sum()) / (2 * valid.size)


def pair_errors(
    T_est: np.ndarray,
    T_gt: np.ndarray,
    depth_prev: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> dict[str, float | None]:
    """Compute the errors of an estimated T_curr_prev (4, 4) with the depth (H, W), metres, it sees.

    The paper's are ``r_err_deg`` and ``t_err``, the mean absolute differences of the Euler angles
    X-Y-Z and of the translation, and ``epe``, px at 128x256. ``epe_l2_px`` is the mean distance of
    the ego flows at native size (the image diagonal for a pixel behind the camera), ``rot_err_deg``
    the geodesic angle, ``trans_err`` a distance. Both EPE are None without valid depth.
    """
    depth = np.asarray(depth_prev)
    euler = geometry.matrix_to_euler_deg(
        T_est[:3, :3]
    ) - geometry.matrix_to_euler_deg(T_gt[:3, :3])
    euler = (euler + 180.0) % 360.0 - 180.0
    translation = T_est[:3, 3] - T_gt[:3, 3]
    est, gt = (
        geometry.ego_flow(depth, T, camera_prev, camera_curr) for T in (T_est, T_gt)
    )
    native = np.linalg.norm(est - gt, axis=2)[np.isfinite(gt).all(axis=2)]
    native[~np.isfinite(native)] = np.hypot(*camera_prev.shape)
    return {
        "r_err_deg": float(np.abs(euler).mean()),
        "t_err": float(np.abs(translation).mean()),
        "epe": _paper_epe(T_est, T_gt, depth, camera_prev, camera_curr),
        "epe_l2_px": float(native.mean()) if len(native) else None,
        "rot_err_deg": float(
            np.degrees(geometry.rotation_angle(T_est[:3, :3] @ T_gt[:3, :3].T))
        ),
        "trans_err": float(np.linalg.norm(translation)),
    }


def pair_factors(sequence: Sequence, prev: int, curr: int) -> dict[str, float]:
    """Measure those of :data:`FACTORS` that are known of a pair."""
    T_gt = true_motion(sequence, prev, curr)
    depth = sequence.frame(prev).depth
    if T_gt is None or depth is None:
        return {}
    facts = {
        "rotation_deg": float(np.degrees(geometry.rotation_angle(T_gt[:3, :3]))),
        "translation_m": float(np.linalg.norm(T_gt[:3, 3])),
    }
    known = depth[np.isfinite(depth) & (depth > 0)]
    if len(known):
        low, high = np.quantile(known, [0.1, 0.9])
        facts["depth_spread"] = float(high / low)
    ego = geometry.ego_flow(
        depth, T_gt, sequence.camera(prev), sequence.camera(curr)
    )
    valid = np.isfinite(ego).all(axis=2)
    if valid.any():
        facts["flow_magnitude_px"] = float(
            np.median(np.linalg.norm(ego[valid], axis=1))
        )
    # TartanAir's true flow does not show what moves by itself
    whole = (
        sequence.flow_is_true and sequence.kind != "tartanair" and curr == prev + 1
    )
    with contextlib.suppress(InputError, OSError):
        flow_gt = sequence.flow(prev)[0] if whole else np.full_like(ego, np.nan)
        valid &= (np.abs(flow_gt) < UNKNOWN_FLOW).all(axis=2)
        moving = np.linalg.norm(ego[valid] - flow_gt[valid], axis=1) > MOVING_PX
        facts |= {"dynamic_fraction": float(moving.mean())} if len(moving) else {}
    return facts


def pair_table(pairs: Any) -> pd.DataFrame:
    """Make a table of :data:`PAIR_COLUMNS` of dictionaries or a table; unknown numbers are NaN."""
    table = pd.DataFrame(pairs, columns=list(PAIR_COLUMNS))
    text = ["sequence", "method", "flow_source", "status", "message"]
    numbers = table.columns.difference(text)
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
    failed = pairs["status"].str.startswith("failed")
    limits = pairs["wrong_limit_px"].fillna(WRONG_PX)
    error = pairs["epe_l2_px"]
    known = failed | error.notna()
    total = int(known.sum())
    names = (
        "wrong",
        "wrong_share",
        "wrong_share_low",
        "wrong_share_high",
        "wrong_limit_px",
    )
    if not total:
        return dict.fromkeys(names)
    wrong = int((failed | (error > limits)).sum())
    interval = binomtest(wrong, total).proportion_ci(0.95, method="wilson")
    limit = float(limits[known].median())
    values = wrong, wrong / total, float(interval.low), float(interval.high), limit
    return dict(zip(names, values, strict=True))


def pair_scores(pairs: pd.DataFrame) -> dict[str, Any]:
    """Compute every mean, median and count over some pairs, and why some of them are None."""
    scored = pairs[pairs["rot_err_deg"].notna()]
    figures = {name: scored[name].mean() for name in ERRORS[:4]}
    for name in ERRORS[4:]:
        figures |= {
            f"{name}_{how}": scored[name].agg(how) for how in ("mean", "median")
        }
    medians = pairs[["epe_l2_px", "ms", "flow_ms"]].median()
    figures |= zip(
        ("epe_l2_px_median", "ms_per_pair_median", "flow_ms_median"),
        medians,
        strict=True,
    )
    figures["dynamic_fraction"] = pairs["dynamic_fraction"].mean()
    known = {
        name: None if math.isnan(value) else float(value)
        for name, value in figures.items()
    }
    scores = (
        known
        | wrong_motions(pairs)
        | {"pairs": len(pairs), "pairs_scored": len(scored)}
    )
    reasons = {name: NO_PAIRS for name, value in scores.items() if value is None}
    reasons |= (
        {"dynamic_fraction": NO_MOVING} if "dynamic_fraction" in reasons else {}
    )
    counts = {
        state: int(pairs["status"].str.startswith(state).sum())
        for state in ("failed", "degraded")
    }
    return scores | counts | {"reasons": reasons}


def sequence_row(
    pairs: pd.DataFrame, path: Mapping[str, Any] | None, named: Mapping[str, Any]
) -> dict[str, Any]:
    """Make the line of a method on a sequence; ``path`` is what ``evaluate`` returned, if any."""
    line = {**named, **pair_scores(pairs)}
    path = path or {
        "alignment": "se3",
        "reasons": dict.fromkeys(PATH_KEYS, NO_TRUTH),
    }
    line["reasons"] |= {k: v for k, v in path["reasons"].items() if k in PATH_KEYS}
    return line | {name: path.get(name) for name in ("alignment", *PATH_KEYS)}


def total_row(pairs: pd.DataFrame, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Make the line of a method over all sequences: pairs pooled, trajectory errors averaged."""
    depth = ", ".join(dict.fromkeys(row["depth_source"] for row in rows))
    named = {"method": rows[0]["method"], "flow_source": rows[0]["flow_source"]}
    named |= {"sequence": "all", "depth_source": depth, "alignment": "se3"}
    line = {**named, "sequences": len(rows), **pair_scores(pairs)}
    for key in PATH_KEYS:
        known = [row[key] for row in rows if row[key] is not None]
        line[key] = float(np.mean(known)) if known else None
        if missing := [
            f"{r['sequence']}: {r['reasons'][key]}" for r in rows if r[key] is None
        ]:
            text = f"mean over {len(known)} of {len(rows)} sequences; without {'; '.join(missing)}"
            line["reasons"][key] = text
    return line


@functools.cache
def paper_protocol() -> dict[str, Any]:
    """Read the paper's protocol: sequences with their frames, pairs, columns, published lines."""
    path = Path(__file__).with_name("protocols.yaml")
    return dict(parse_yaml(path.read_text(encoding="utf-8"), path.name))


def same_intrinsics(first: Camera, second: Camera) -> bool:
    """Return whether two cameras are the same, as in the pairs that the paper keeps."""
    return first.shape == second.shape and np.allclose(
        first.K, second.K, 0, 1e-9 * first.fx
    )


def check_protocol(sequences: Iterable[Sequence]) -> None:
    """Raise an InputError for sequences that the protocol does not score."""
    known = paper_protocol()["sequences"]
    expected = "training sequences of MPI Sintel"
    if wrong := [
        s.name for s in sequences if s.kind != "sintel" or s.name not in known
    ]:
        raise InputError(
            f"--protocol paper: expected {expected}, got {', '.join(wrong)}."
        )


def protocol_summary(scored: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what ``results.json`` says of the protocol: published lines, and what is missing."""
    protocol = paper_protocol()
    names = [s["name"] for s in scored]
    count = sum(s["pairs_scored"] for s in scored)
    absent = [name for name in protocol["sequences"] if name not in names]
    note = ""
    if absent or count != protocol["pairs"]:
        note = f"{count} pairs, the complete set has {protocol['pairs']}: not those of the "
        note += f"published figures; missing: {', '.join(absent) or 'no sequence'}"
    return protocol | {"note": note, "missing_sequences": absent, "pairs": count}
