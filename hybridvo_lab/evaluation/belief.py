"""Whether what an estimate states of itself can be believed: sigma, probability and status."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtri

from hybridvo.core.geometry import invert, se3_log
from hybridvo_lab.calibration import WRONG_PX

DOF = 6
"""Degrees of freedom of a motion."""
THREE_SIGMA = 0.9973
"""Fraction of a normal distribution within three standard deviations."""
PROBABILITY_BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0)
"""Edges of the bins of a probability: finer where most of them lie."""


def normalised_error(
    T_est: np.ndarray, T_gt: np.ndarray, covariance: np.ndarray
) -> float | None:
    """Return the squared error in units of its covariance (NEES), which is 6 in the mean.

    Args:
        T_est: (4, 4) the estimated T_curr_prev.
        T_gt: (4, 4) the true one.
        covariance: (6, 6) of delta in ``Exp(delta) T_est``.

    Returns:
        The error, dimensionless; None where the covariance is not definite.

    Example:
        >>> normalised_error(np.eye(4), np.eye(4), np.eye(6))
        0.0
    """
    delta = se3_log(T_gt @ invert(T_est))
    try:
        nees = float(delta @ np.linalg.solve(covariance, delta))
    except np.linalg.LinAlgError:
        return None
    return nees if math.isfinite(nees) and nees >= 0 else None


def is_wrong(pairs: pd.DataFrame) -> pd.Series:
    """Return which motions failed or err by more than their limit."""
    failed = pairs["status"].str.startswith("failed")
    return failed | (pairs["epe_l2_px"] > wrong_limits(pairs))


def wrong_limits(pairs: pd.DataFrame) -> pd.Series:
    """Return the error of each motion, px, beyond which it is wrong."""
    return pairs["wrong_limit_px"].fillna(WRONG_PX)


def belief_rows(pairs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return a line for each method: how often it is wrong and says ok, and its NEES.

    Args:
        pairs: A table of :func:`hybridvo_lab.evaluation.scores.pair_table`.

    Returns:
        ``method``; ``ok``, motions that are called ok; ``wrong_ok``, those of them that are
        wrong, and ``wrong_ok_share``; ``wrong_told``, the fraction of the wrong ones that are not
        called ok; ``nees_median`` of the right ones, and ``beyond_share``, the fraction of them
        beyond three standard deviations. None where nothing is known.
    """
    rows = []
    scored = pairs[pairs["epe_l2_px"].notna()]
    for method, own in scored.groupby("method", sort=False):
        wrong = is_wrong(own)
        ok = own["status"] == "ok"
        nees = own[~wrong]["nees"].dropna()
        rows.append(
            {
                "method": method,
                "pairs": len(own),
                "ok": int(ok.sum()),
                "wrong_ok": int((wrong & ok).sum()),
                "wrong_ok_share": _share(wrong & ok, ok),
                "wrong_told": _share(wrong & ~ok, wrong),
                "nees_median": None if nees.empty else float(nees.median()),
                "beyond_share": _beyond(nees),
            }
        )
    return rows


def _share(part: pd.Series, of: pd.Series) -> float | None:
    """Return how many of some motions are of a kind; None where there are none."""
    return float(part.sum() / of.sum()) if of.any() else None


def _beyond(nees: pd.Series) -> float | None:
    """Return the fraction of errors beyond three standard deviations."""
    if nees.empty:
        return None
    # scipy.stats states the same and takes half a second to import, in every run
    limit = chdtri(DOF, 1 - THREE_SIGMA)
    return float((nees > limit).mean())


def reliability(pairs: pd.DataFrame) -> pd.DataFrame:
    """Return how often motions with about the same probability are right.

    Args:
        pairs: A table of :func:`hybridvo_lab.evaluation.scores.pair_table`.

    Returns:
        A row for each method and bin that has motions: ``method``, ``probability``, their mean,
        ``right``, the fraction that is right, and ``motions``, their number.
    """
    known = pairs[pairs["epe_l2_px"].notna() & pairs["probability"].notna()]
    known = known.assign(right=~is_wrong(known))
    bins = pd.cut(known["probability"], PROBABILITY_BINS, include_lowest=True)
    groups = known.groupby(["method", bins.rename("bin")], observed=True)
    rows = groups.agg(
        probability=("probability", "mean"),
        right=("right", "mean"),
        motions=("right", "size"),
    )
    return rows.reset_index().drop(columns="bin")
