"""Results of the trajectory metrics: frozen values with a reason for each that is missing."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np

__all__ = ["AbsoluteError", "Alignment", "Association", "RelativeError", "Scale"]

Alignment = Literal["se3", "sim3", "origin", "none"]
Scale = Literal["umeyama", "norms"]


@dataclass(frozen=True, eq=False)
class Association:
    """Poses of two trajectories that belong together.

    Args:
        est_indices, gt_indices: (M,) indices into the estimate and the truth.
        total: poses of the shorter trajectory.
        by: ``time`` or, where a file has no stamps, ``index``.
        max_diff: largest time difference allowed, seconds; None by index.
        reason: why no error can be computed from these matches, or the empty string.
    """

    est_indices: np.ndarray
    gt_indices: np.ndarray
    total: int
    by: str
    max_diff: float | None = None
    reason: str = ""

    @property
    def matched(self) -> int:
        """Number of matched poses."""
        return len(self.est_indices)


class _Result:
    """to_dict of a frozen result: its numbers and reasons, without arrays."""

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready mapping of the values; arrays are left out."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        values["reasons"] = dict(values["reasons"])
        return {k: v for k, v in values.items() if not isinstance(v, np.ndarray)}


@dataclass(frozen=True, eq=False)
class AbsoluteError(_Result):
    """Absolute trajectory error (ATE): distances of matched positions after alignment, metres.

    Args:
        rmse, mean, median, max: statistics of the distances; None with a reason where they cannot
            be computed.
        rmse_unaligned: RMSE without any alignment; None only when nothing could be matched.
        alignment: ``se3``, ``sim3``, ``origin`` or ``none``. scale: factor applied to the estimate
            (1 unless ``sim3``); None when the alignment failed. scale_kind: how it was found.
        matched, total: matched poses, and poses of the shorter trajectory.
        evo_version: version of evo that computed the errors.
        reasons: why a value is None, by name of the value.
        T_gt_est: (4, 4) alignment; an estimated position p becomes ``T_gt_est @ (scale p)``.
        errors: (matched,) distances, metres, or None. timestamps: (matched,) their stamps.
    """

    rmse: float | None
    mean: float | None
    median: float | None
    max: float | None
    rmse_unaligned: float | None
    alignment: Alignment
    scale: float | None
    scale_kind: Scale
    matched: int
    total: int
    evo_version: str
    reasons: dict[str, str] = field(default_factory=dict)
    T_gt_est: np.ndarray | None = None
    errors: np.ndarray | None = None
    timestamps: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class RelativeError(_Result):
    """Relative pose error (RPE) over ``delta`` frames: drift of the odometry.

    Args:
        trans_rmse, trans_mean, trans_median: translation of the relative error, metres.
        rot_rmse_deg, rot_mean_deg, rot_median_deg: its rotation angle, degrees.
        delta: frames between the poses of a pair. pairs: pairs compared, overlapping ones included.
        alignment, scale, matched, total, evo_version, reasons: as in :class:`AbsoluteError`; only
            ``sim3`` changes the values, through its scale.
    """

    trans_rmse: float | None
    trans_mean: float | None
    trans_median: float | None
    rot_rmse_deg: float | None
    rot_mean_deg: float | None
    rot_median_deg: float | None
    delta: int
    pairs: int
    alignment: Alignment
    scale: float | None
    matched: int
    total: int
    evo_version: str
    reasons: dict[str, str] = field(default_factory=dict)
