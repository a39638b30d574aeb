"""Steps that are too wide for flow are not searched."""

from __future__ import annotations

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.results import Reason, StageFailed
from hybridvo.evidence.pair import check_flow
from tests import worlds


def pair_with(valid_fraction: float, source: str) -> hvo.FramePair:
    shape = (40, 50)
    frame = hvo.Frame(None, np.ones(shape, np.float32), worlds.camera(shape))
    valid = np.zeros(shape, bool)
    valid.ravel()[: round(valid_fraction * valid.size)] = True
    flow = np.zeros((*shape, 2), np.float32)
    return hvo.FramePair(frame, frame, flow, flow_valid=valid, flow_source=source)


def test_flow_that_hardly_agrees_with_itself_is_refused():
    with pytest.raises(StageFailed, match="8 % of the flow") as failure:
        check_flow(pair_with(0.08, "dis"))
    assert failure.value.reason is Reason.NO_FLOW


def test_other_flow_is_taken():
    check_flow(pair_with(0.2, "dis"))
    # another source may have a sparse mask of its own
    check_flow(pair_with(0.01, "file"))
