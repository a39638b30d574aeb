"""Is stated doubt honest? Normalised errors of covariances, reliability of a probability.

A covariance is right where the normalised error squared of six parameters has a mean of 6 (Bar-
Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4). A
probability is right where, of the answers that state p, a share p is right (reliability diagram,
expected calibration error: Guo et al., ICML 2017; score: Brier, 1950).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hybridvo.errors import InputError
from hybridvo.evaluation.breakdown import wilson
from hybridvo.geometry import invert, se3_log

__all__ = [
    "CHI2_6_3SIGMA",
    "flag_cost",
    "nees_summary",
    "normalised_error",
    "proportion",
    "recalibrate",
    "recalibrated",
    "reliability",
]

CHI2_6_3SIGMA = 20.062
"""Quantile 0.9973 of chi-square with six degrees of freedom: the ellipsoid of 3 sigma."""
BINS = 10
PRIOR = 0.05
"""Inverse variance of the prior on each coefficient of :func:`recalibrate`."""


def normalised_error(T_est: np.ndarray, covariance: np.ndarray, T_true: np.ndarray) -> float | None:
    """Normalised estimation error squared of one motion.

    Args:
        T_est: (4, 4) estimated ``T_curr_prev``.
        covariance: (6, 6) of the left perturbation (translation, rotation).
        T_true: (4, 4) true ``T_curr_prev``.

    Returns:
        delta^T C^-1 delta with Exp(delta) T_true = T_est; None where C is singular.

    Example:
        >>> T = np.eye(4)
        >>> T[0, 3] = 0.2
        >>> normalised_error(T, np.diag([0.01] * 6), np.eye(4))
        4.0
    """
    delta = se3_log(T_est @ invert(T_true))
    try:
        value = float(delta @ np.linalg.solve(covariance, delta))
    except np.linalg.LinAlgError:
        return None
    return round(value, 12) if np.isfinite(value) and value >= 0 else None


def proportion(count: int, total: int) -> dict[str, Any]:
    """``count``, ``of``, ``share`` and its 95 % interval ``low``, ``high`` (None without trial)."""
    low, high = wilson(count, total)
    share = count / total if total else None
    return {"count": count, "of": total, "share": share, "low": low, "high": high}


def nees_summary(values: Sequence[float | None]) -> dict[str, Any]:
    """Normalised errors of many motions, None where there is none.

    Returns:
        ``pairs``, ``unknown``, ``mean`` (expected 6), ``median`` (expected 5.35), ``q95``
        (expected 12.59) and ``contained``, the share inside 3 sigma (expected 0.9973).
    """
    known = np.array([v for v in values if v is not None], dtype=float)
    inside = int(np.count_nonzero(known < CHI2_6_3SIGMA))
    statistics: dict[str, float | None] = dict.fromkeys(("mean", "median", "q95"))
    if known.size:
        statistics = {
            "mean": float(known.mean()),
            "median": float(np.median(known)),
            "q95": float(np.quantile(known, 0.95)),
        }
    return {
        "pairs": len(values),
        "unknown": len(values) - known.size,
        **statistics,
        "contained": proportion(inside, len(values)),
    }


def _checked(probability: ArrayLike, right: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    p, y = np.asarray(probability, dtype=float), np.asarray(right, dtype=float)
    if p.ndim != 1 or p.shape != y.shape or not ((p >= 0) & (p <= 1)).all():
        raise InputError(
            f"reliability: expected (N,) probabilities in [0, 1] and as many outcomes, got shapes "
            f"{p.shape} and {y.shape}."
        )
    return p, y


def reliability(probability: ArrayLike, right: ArrayLike, bins: int = BINS) -> dict[str, Any]:
    """Stated probability of being right against the observed frequency.

    Args:
        probability: (N,) stated, in [0, 1].
        right: (N,) bool, what happened.
        bins: of equal width.

    Returns:
        ``answers``; ``right``, share observed; ``stated``, mean probability; ``brier``, mean
        squared error; ``brier_base_rate``, that of stating the observed share always; ``ece``,
        mean distance of stated and observed over the bins, weighted by their answers; ``bins``,
        each with ``low``, ``high``, ``answers``, ``stated`` and ``observed`` (a proportion).
        Everything but the counts is None without an answer.

    Raises:
        InputError: shapes that do not match, a probability outside [0, 1].
    """
    p, y = _checked(probability, right)
    n = len(p)
    rows: list[dict[str, Any]] = []
    which = np.minimum((p * bins).astype(int), bins - 1)
    ece = 0.0
    for k in range(bins):
        mine = which == k
        count = int(mine.sum())
        stated = float(p[mine].mean()) if count else None
        observed = proportion(int(y[mine].sum()), count)
        if stated is not None:
            ece += count / n * abs(stated - observed["share"])
        rows.append({"low": k / bins, "high": (k + 1) / bins, "answers": count,
                     "stated": stated, "observed": observed})  # fmt: skip
    rate = float(y.mean()) if n else None
    return {
        "answers": n,
        "right": rate,
        "stated": float(p.mean()) if n else None,
        "brier": float(((p - y) ** 2).mean()) if n else None,
        "brier_base_rate": None if rate is None else rate * (1 - rate),
        "ece": ece if n else None,
        "bins": rows,
    }


def recalibrate(
    probability: ArrayLike, right: ArrayLike, evidence: Mapping[str, ArrayLike] | None = None
) -> dict[str, Any]:
    """Logistic map that makes a stated probability as likely as possible (Platt, 1999).

    The new logit is the sum of ``coefficients`` times the stated logit, the evidence and one. A
    weak prior holds it at the stated probability where the answers say nothing, so that separable
    answers stay finite.

    Args:
        probability: (N,) stated.
        right: (N,) bool, what happened.
        evidence: name to (N,) values that the statement may have left out.

    Returns:
        ``coefficients`` by name (``logit``, those of the evidence, ``constant``), and
        ``loss_before`` and ``loss_after``, mean log losses (None without an answer).

    Raises:
        InputError: see :func:`reliability`.
    """
    p, y = _checked(probability, right)
    A = _design(p, evidence or {})
    prior = np.zeros(A.shape[1])
    prior[0] = 1.0
    theta = prior.copy()

    def loss(parameters: np.ndarray) -> float:
        m = A @ parameters
        away = parameters - prior
        return float((np.logaddexp(0, m) - y * m).sum() + 0.5 * PRIOR * away @ away)

    for _ in range(50):
        q = 1 / (1 + np.exp(-(A @ theta)))
        H = (A * (q * (1 - q))[:, None]).T @ A + PRIOR * np.eye(len(theta))
        step = np.linalg.solve(H, A.T @ (y - q) - PRIOR * (theta - prior))
        size = 1.0
        while size > 1e-6 and loss(theta + size * step) > loss(theta):
            size /= 2
        theta = theta + size * step
        if np.abs(size * step).max() < 1e-10:
            break
    names = ("logit", *(evidence or {}), "constant")
    losses = [
        float((np.logaddexp(0, A @ t) - y * (A @ t)).mean()) if len(p) else None
        for t in (prior, theta)
    ]
    return {
        "coefficients": dict(zip(names, map(float, theta), strict=True)),
        "loss_before": losses[0],
        "loss_after": losses[1],
    }


def _design(p: np.ndarray, evidence: Mapping[str, ArrayLike]) -> np.ndarray:
    """(N, 2 + evidence): stated logit, evidence, one."""
    clipped = np.clip(p, 1e-4, 1 - 1e-4)
    columns = [np.log(clipped / (1 - clipped)), *(np.asarray(e, float) for e in evidence.values())]
    return np.column_stack([*columns, np.ones(len(p))])


def recalibrated(
    probability: ArrayLike, evidence: Mapping[str, ArrayLike], coefficients: Mapping[str, float]
) -> np.ndarray:
    """(N,) probabilities after the map that :func:`recalibrate` found.

    Args:
        probability: (N,) stated.
        evidence: name to (N,) values, in the order of the fit.
        coefficients: of :func:`recalibrate`.
    """
    A = _design(np.asarray(probability, dtype=float), evidence)
    return 1 / (1 + np.exp(-(A @ np.array(list(coefficients.values())))))


def flag_cost(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What a status other than ok catches, and what it costs.

    Args:
        records: with ``failure`` (bool), ``status`` (word) and ``nees`` (float or None).

    Returns:
        Proportions: ``failures`` of all; of the failures, ``flagged`` (status other than ok),
        ``inside`` (error within 3 sigma), ``caught`` (either) and ``silent`` (neither); of the
        right answers, ``degraded`` (status other than ok).
    """
    wrong = [r for r in records if r["failure"]]
    right = [r for r in records if not r["failure"]]
    flagged = [r["status"] != "ok" for r in wrong]
    inside = [r["nees"] is not None and r["nees"] < CHI2_6_3SIGMA for r in wrong]
    caught = sum(a or b for a, b in zip(flagged, inside, strict=True))
    return {
        "failures": proportion(len(wrong), len(records)),
        "flagged": proportion(sum(flagged), len(wrong)),
        "inside": proportion(sum(inside), len(wrong)),
        "caught": proportion(caught, len(wrong)),
        "silent": proportion(len(wrong) - caught, len(wrong)),
        "degraded": proportion(sum(r["status"] != "ok" for r in right), len(right)),
    }
