"""Is the covariance right? Normalised error of ``refine`` under the model's own noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmark_scores import CHI2_6_3SIGMA, normalised_error, proportion

SHAPE = (160, 320)


def run_nees(pairs: int, seed0: int) -> dict[str, Any]:
    """Normalised estimation error squared over pairs with independent noise of known form.

    With a right covariance it is chi-square with six degrees of freedom: mean 6, standard
    deviation sqrt(12), 99.73 % below the 3 sigma ellipsoid.
    """
    from hybridvo.pipeline import refine
    from hybridvo.synthetic.scenarios import make_model_pair

    values = []
    unanswered = 0
    for seed in range(seed0, seed0 + pairs):
        pair, truth = make_model_pair(seed, *SHAPE)
        result = refine(pair)
        if result.ok:
            values.append(normalised_error(result, truth["T_curr_prev"]))
        else:
            unanswered += 1
    finite = np.array([v for v in values if np.isfinite(v)])
    many = len(finite) > 1
    return {
        "pairs": pairs,
        "seeds": [seed0, seed0 + pairs - 1],
        "shape": list(SHAPE),
        "noise": "flow 0.5 px, log depth 0.02, Gaussian, independent per pixel",
        "mean": float(finite.mean()) if len(finite) else None,
        "standard_error": float(finite.std(ddof=1) / np.sqrt(len(finite))) if many else None,
        "median": float(np.median(finite)) if len(finite) else None,
        "quantiles": {
            str(q): float(np.quantile(finite, q)) for q in (0.05, 0.5, 0.95) if len(finite)
        },
        "contained": proportion(sum(v < CHI2_6_3SIGMA for v in values), pairs),
        "not_estimated": unanswered,
        "not_finite": len(values) - len(finite),
    }


def correlated_nees(
    summary: dict[str, dict[str, dict[str, Any]]], method: str = "refine"
) -> dict[str, Any]:
    """The cells' own figures: their depth noise is correlated in space, their outliers gross."""
    return {
        cell: {
            "mean": rows[method]["nees_mean"],
            "median": rows[method]["nees_median"],
            "contained": proportion(rows[method]["contained"], rows[method]["pairs"]),
        }
        for cell, rows in summary.items()
        if method in rows
    }
