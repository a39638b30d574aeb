"""Depth that cannot be in metres is named, whatever else is wrong with the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridvo import Reason, State, estimate
from hybridvo.core.types import FramePair
from hybridvo.run.commands.advice import advice_on
from tests import worlds


def in_millimetres(pair: FramePair) -> FramePair:
    assert pair.prev.depth is not None
    depth = 1000 * pair.prev.depth
    return replace(pair, prev=replace(pair.prev, depth=depth), curr=pair.curr)


@pytest.mark.parametrize(
    ("kind", "before", "state"),
    [
        ("five_motions", Reason.AMBIGUOUS_MOTION, State.DEGRADED),
        ("line", Reason.DEGENERATE_GEOMETRY, State.DEGRADED),
        ("every_pixel_its_own", Reason.LOW_INLIERS, State.FAILED),
    ],
)
def test_the_unit_is_named_whatever_else_is_wrong(
    kind: str, before: Reason, state: State
) -> None:
    pair, _ = worlds.degenerate(kind)
    pair = replace(pair, curr=replace(pair.curr, depth=None, rgb=pair.curr.rgb))
    assert estimate(pair, method="classical").status.reason is before
    found = estimate(in_millimetres(pair), method="classical")
    assert found.status.state is state
    assert found.status.reason is Reason.DEPTH_UNIT
    first, _, rest = found.status.message.partition("; besides, ")
    assert first.endswith("expects metres: divide by 1000 (millimetres)")
    assert rest
    worlds.assert_sane(found)


def test_images_without_flow_are_no_matter_of_depth() -> None:
    pair, _ = worlds.world(texture=False)
    black = np.zeros((*pair.prev.camera.shape, 3), np.uint8)
    pair = in_millimetres(pair)
    frames = [replace(frame, rgb=black) for frame in (pair.prev, pair.curr)]
    found = estimate(FramePair(*frames, None), method="classical")
    assert found.status.reason is Reason.NO_FLOW
    assert "divide by 1000" in found.status.message


def test_the_remedy_is_the_unit() -> None:
    (sentence,) = advice_on([("degraded", "depth_unit")])
    assert "--depth-scale" in sentence and "sensor" not in sentence
