"""``refine.cutoff`` reaches what the images and the flow state."""

from __future__ import annotations

import numpy as np
import pytest

import hybridvo
from hybridvo.core.options import Options, RefineOptions
from hybridvo.core.types import FramePair
from hybridvo.flow.providers import dis_flow, with_flow
from tests import worlds


@pytest.mark.parametrize("method", ["hybrid", "classical", "pwvo-refine"])
def test_a_narrower_kernel_changes_what_an_answer_states(method: str) -> None:
    pair, _ = worlds.world((120, 160), movers=1)
    pair = with_flow(FramePair(pair.prev, pair.curr, None), dis_flow())
    wide, narrow = (
        hybridvo.estimate(
            pair,
            method=method,
            options=Options(refine=RefineOptions(cutoff=cutoff)),
        )
        for cutoff in (3.0, 1.0)
    )
    change = np.linalg.norm(wide.covariance - narrow.covariance)
    assert change > 1e-3 * np.linalg.norm(wide.covariance)
