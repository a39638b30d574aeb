"""Charts of one report state one thing alike."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from hybridvo_lab.evaluation.scores import FACTORS

pytest.importorskip("plotly", reason="extra report")

from hybridvo_lab.evaluation.charts import error_distribution, factor_charts


def test_every_chart_draws_the_limit_by_which_its_tables_count() -> None:
    rng = np.random.default_rng(0)
    factors = {
        name: np.repeat(
            np.mean([list(factor.edges)[:-1], list(factor.edges)[1:]], 0)[:2], 10
        )
        for name, factor in FACTORS.items()
    }
    scored = pd.DataFrame(
        {
            "method": "hybrid",
            "epe_l2_px": rng.uniform(0.1, 5, 20),
            "wrong_limit_px": 2.69,
            **factors,
        }
    )
    figures = [
        *error_distribution(scored, ["hybrid"]),
        *factor_charts(scored, ["hybrid"]),
    ]
    assert len(figures) == 1 + len(FACTORS)
    for figure in figures:
        (line,) = figure.layout.shapes
        assert 2.69 in (line.x0, line.y0)
