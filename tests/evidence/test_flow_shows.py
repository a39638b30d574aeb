"""Flow from a matched motion is sought where the flow that is there does not show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.core.options import Options
from hybridvo.evidence.pair import FlowEvidence, PairEvidence

WIDTH = 64
CAMERA = hvo.Camera(60.0, 60.0, 31.5, 23.5, height=48, width=WIDTH)
DEPTH = np.full(CAMERA.shape, 2.0, np.float32)
T = se3_exp(np.array([0.1, 0, 0, 0, 0, 0]))


def evidence_of(flow: np.ndarray | None) -> FlowEvidence:
    frame = hvo.Frame(None, DEPTH, CAMERA)
    pair = hvo.FramePair(frame, frame, flow)
    return FlowEvidence(
        pair, PairEvidence(pair, Options(), None, None, None, None, 0)
    )


@pytest.mark.parametrize(
    ("columns", "expected"), [(64, True), (40, True), (24, False)]
)
def test_most_of_the_flow_decides(columns: int, expected: bool) -> None:
    flow = ego_flow(DEPTH, T, CAMERA, CAMERA)
    flow[:, columns:] += 5.0
    assert evidence_of(flow).shows(T) is expected
    assert not evidence_of(flow).shows(np.eye(4))


def test_flow_that_is_unknown_does_not_count() -> None:
    flow = ego_flow(DEPTH, T, CAMERA, CAMERA)
    flow[:, 24:] = np.nan
    assert evidence_of(flow).shows(T)
    assert not evidence_of(np.full_like(flow, np.nan)).shows(T)
    assert not evidence_of(None).shows(T)


def test_flows_of_one_motion_are_near() -> None:
    flow = ego_flow(DEPTH, T, CAMERA, CAMERA)
    apart = WIDTH / 320
    assert evidence_of(flow + [0.9 * apart, 0]).shows(T)
    assert not evidence_of(flow + [1.1 * apart, 0]).shows(T)


def test_without_depth_nothing_is_shown() -> None:
    evidence = evidence_of(ego_flow(DEPTH, T, CAMERA, CAMERA))
    blank = replace(
        evidence.pair.prev, depth=None, rgb=np.zeros((48, WIDTH, 3), np.uint8)
    )
    assert not replace(evidence, pair=replace(evidence.pair, prev=blank)).shows(T)
