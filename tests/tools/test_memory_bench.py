"""What the benchmarks of the memory take for wrong, and what they count."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scripts import load_script

memory = load_script("tools/bench/memory.py")
unseen = load_script("tools/bench/memory_unseen.py")


def test_steps_are_counted_by_whether_they_are_right_and_ok() -> None:
    steps = [
        memory.Judged(is_wrong=True, is_ok=True, has_flow=False, probability=0.95),
        memory.Judged(is_wrong=False, is_ok=False, has_flow=True, probability=0.5),
        memory.Judged(is_wrong=False, is_ok=True, has_flow=True, probability=0.99),
    ]
    assert memory.counted(steps) == {
        "steps": 3,
        "wrong": 1,
        "wrong_ok": 1,
        "right_not_ok": 1,
        "with_flow": 2,
        "auroc": 0.5,
    }


def test_without_a_wrong_step_nothing_can_be_ranked() -> None:
    right = memory.Judged(False, True, False, 0.99)
    assert memory.counted([right])["auroc"] is None


@pytest.mark.slow
def test_a_rendered_scene_comes_with_its_truth() -> None:
    family = unseen.Rendered("heavy_rigid", True, 1)
    frames, poses, moving_in = unseen.rendered(family, 1)
    assert len(frames) == len(poses) == unseen.SCENE_FRAMES
    moving = moving_in(0, 1)
    assert moving.shape == unseen.SIZE
    assert 0 < np.mean(moving) < 1
    again = unseen.rendered(family, 1).frames[0]
    np.testing.assert_array_equal(frames[0].depth, again.depth)
