"""Drift as the KITTI odometry benchmark defines it: relative error over sub-paths of fixed length.

Definition (Geiger, Lenz, Urtasun, CVPR 2012, and its development kit): from every ``start_step``-th
frame and for every length L, the last frame is the first one whose distance along the true path
exceeds L. With the motions ``D = inv(T_first) T_last`` of both trajectories, the error is
``E = inv(D_est) D_true``; its translation (m) and rotation angle are divided by L. Nothing is
aligned and nothing is scaled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, Literal

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import invert, rotation_angle

__all__ = ["KITTI_LENGTHS", "SHORT_LENGTHS", "KittiDrift", "kitti_drift"]

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Sub-path lengths of the benchmark, metres."""
SHORT_LENGTHS = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
"""Sub-path lengths for flying and indoor sequences, metres."""

Averaging = Literal["lengths", "segments"]


@dataclass(frozen=True)
class KittiDrift:
    """Relative error over sub-paths.

    Args:
        translation: mean translation error per metre (a fraction; times 100 is KITTI's per cent),
            or None.
        rotation_deg_per_m: mean rotation error, degrees per metre, or None.
        per_length: for each length that occurs: (length in metres, sub-paths, translation,
            rotation_deg_per_m).
        segments: number of sub-paths.
        path_length: length of the true path, metres; None where it is not a finite number.
        start_step, averaging: how it was computed.
        reasons: why a value is None, by name of the value.
    """

    translation: float | None
    rotation_deg_per_m: float | None
    per_length: tuple[tuple[float, int, float, float], ...]
    segments: int
    path_length: float | None
    start_step: int
    averaging: Averaging
    reasons: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready mapping."""
        return {
            "translation": self.translation,
            "rotation_deg_per_m": self.rotation_deg_per_m,
            "per_length": [
                {
                    "length_m": length,
                    "segments": count,
                    "translation": translation if np.isfinite(translation) else None,
                    "rotation_deg_per_m": rotation if np.isfinite(rotation) else None,
                }
                for length, count, translation, rotation in self.per_length
            ],
            "segments": self.segments,
            "path_length_m": self.path_length,
            "start_step": self.start_step,
            "averaging": self.averaging,
            "reasons": dict(self.reasons),
        }


@np.errstate(over="ignore", invalid="ignore")
def kitti_drift(
    T_world_cam_est: np.ndarray,
    T_world_cam_true: np.ndarray,
    *,
    lengths: Sequence[float] = KITTI_LENGTHS,
    start_step: int = 1,
    averaging: Averaging = "lengths",
) -> KittiDrift:
    """KITTI drift of an estimated path, unaligned and unscaled.

    Args:
        T_world_cam_est: (N, 4, 4) estimated camera to world, metres.
        T_world_cam_true: (N, 4, 4) true camera to world of the same frames, metres.
        lengths: sub-path lengths, metres.
        start_step: frames between starts; 1 (every frame) as TartanAir's evaluator does, 10 as
            KITTI's development kit does.
        averaging: ``lengths``: mean over the lengths of the mean of each length (TartanAir's
            evaluator); ``segments``: mean over all sub-paths (KITTI's server).

    Returns:
        The drift; values are None, with a reason, where the path is shorter than every length.

    Raises:
        InputError: shapes that do not match, lengths or a step that are not positive.
    """
    est = np.asarray(T_world_cam_est, dtype=np.float64)
    true = np.asarray(T_world_cam_true, dtype=np.float64)
    if est.shape != true.shape or true.ndim != 3 or true.shape[1:] != (4, 4) or not len(true):
        raise InputError(
            f"kitti_drift: expected two arrays (N, 4, 4) of the same length N >= 1, got "
            f"{est.shape} and {true.shape}. Associate the trajectories first."
        )
    if not len(lengths) or not all(np.isfinite(length) and length > 0 for length in lengths):
        raise InputError(f"kitti_drift: expected positive lengths in metres, got {lengths!r}.")
    whole = isinstance(start_step, Real) and not isinstance(start_step, bool)
    if not whole or start_step % 1 or start_step < 1:
        raise InputError(f"kitti_drift: expected start_step >= 1, got {start_step!r}.")
    if averaging not in ("lengths", "segments"):
        raise InputError(f"averaging: expected lengths or segments, got {averaging!r}.")
    steps = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    path_length = float(distance[-1])
    starts = np.arange(0, len(true), int(start_step))
    per_length: list[tuple[float, int, float, float]] = []
    for length in lengths:
        # side="right": the first frame strictly beyond the length
        ends = np.searchsorted(distance, distance[starts] + length, side="right")
        inside = ends < len(true)
        first, last = starts[inside], ends[inside]
        if not len(first):
            continue
        motion_est = invert(est[first]) @ est[last]
        motion_true = invert(true[first]) @ true[last]
        error = invert(motion_est) @ motion_true
        translation = np.linalg.norm(error[:, :3, 3], axis=1) / length
        rotation = np.degrees(rotation_angle(error[:, :3, :3])) / length
        per_length.append(
            (float(length), len(first), float(translation.mean()), float(rotation.mean()))
        )
    segments = sum(count for _, count, _, _ in per_length)
    translation_mean = rotation_mean = None
    reason = ""
    if per_length:
        weights = [count if averaging == "segments" else 1 for _, count, _, _ in per_length]
        means = np.average([row[2:] for row in per_length], axis=0, weights=weights)
        if np.isfinite(means).all():
            translation_mean, rotation_mean = float(means[0]), float(means[1])
        else:
            reason = "the error is not a finite number: positions are too large"
    else:
        reason = (
            f"the true path of {path_length:.4g} m is shorter than the shortest length, "
            f"{min(lengths):g} m"
        )
    return KittiDrift(
        translation=translation_mean,
        rotation_deg_per_m=rotation_mean,
        per_length=tuple(per_length),
        segments=segments,
        path_length=path_length if np.isfinite(path_length) else None,
        start_step=int(start_step),
        averaging=averaging,
        reasons={"translation": reason, "rotation_deg_per_m": reason} if reason else {},
    )
