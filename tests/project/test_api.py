"""The public names: what ``import hybridvo as hvo`` offers, and what each says of itself."""

from __future__ import annotations

import inspect

import pytest

import hybridvo

NAMES = {
    *("Camera", "Frame", "FramePair", "PairBatch", "RelativePose", "Status", "Step", "MotionPrior"),
    *("Options", "Odometry", "Trajectory", "PWVO", "estimate", "select", "refine", "dis_flow"),
    *("InputError", "FlowField", "Reason", "State", "BatchedPose", "resize_frame"),
    *("open_sequence", "iter_pairs", "evaluate", "to_gtsam_covariance", "to_ros_covariance"),
}


def test_the_public_names() -> None:
    assert {name for name in hybridvo.__all__ if name != "__version__"} == NAMES
    assert set(dir(hybridvo)) >= NAMES


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'hybridvo' has no attribute 'Odometer'"):
        _ = hybridvo.Odometer


@pytest.mark.parametrize("name", sorted(NAMES))
def test_every_public_name_has_a_docstring(name: str) -> None:
    value = getattr(hybridvo, name)
    assert inspect.getdoc(value)
    for member, function in vars(value).items() if inspect.isclass(value) else ():
        if inspect.isfunction(function) and not member.startswith("_"):
            assert inspect.getdoc(function), f"{name}.{member}"
