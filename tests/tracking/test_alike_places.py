"""A path that is lost before one of two places that look alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert
from hybridvo.lab.synthetic.bays import ALIKE, BAY_WIDTH, row_of_bays
from hybridvo.lab.synthetic.slow_scenes import noisy_image

SIZE = (120, 160)
SEED = 1
ELSEWHERE = -0.05
"""The first bay, before which the tracker has never been."""
BORDER = 1.5
"""Between the two that are alike: no other view shows this."""


class Walk:
    """A camera along the row of bays."""

    def __init__(self, along: np.ndarray) -> None:
        later = [ALIKE[0] + 0.03, ALIKE[1] + 0.03, BORDER, ELSEWHERE]
        self.positions = np.concatenate([along, later])
        self.scene = row_of_bays(SEED, self.positions, SIZE)
        self.rng = np.random.default_rng(SEED)

    def frame(self, position: float, seconds: float) -> hvo.Frame:
        """What a sensor delivers at a position of the walk, in bays."""
        index = int(np.argmin(np.abs(self.positions - position)))
        seen = self.scene.render(index)
        noise = 0.002 * self.rng.standard_normal(SIZE)
        return replace(
            seen,
            rgb=noisy_image(seen.rgb, self.rng),
            depth=(seen.depth * (1 + noise)).astype(np.float32),
            timestamp=seconds,
            index=None,
        )


@pytest.fixture(scope="module")
def walk() -> Walk:
    return Walk(np.arange(ALIKE[0], ALIKE[1] + 0.4, 0.07))


@pytest.fixture(scope="module")
def state(walk: Walk) -> hvo.odometry.TrackerState:
    """Of a tracker that walked past both, and was then lost before another bay."""
    vo = hvo.Odometry()
    along = walk.positions[:-4]
    for k, position in enumerate(along):
        assert vo.track(walk.frame(position, 0.03 * k)).ok
    step = vo.track(walk.frame(ELSEWHERE, 1.0))
    assert not step.ok
    for seconds in (1.1, 1.2):
        vo.track(walk.frame(ELSEWHERE, seconds))
    return vo.state


@pytest.mark.parametrize("bay", ALIKE)
def test_of_two_places_that_look_alike_none_is_believed(walk, state, bay):
    vo = hvo.Odometry()
    vo.resume(state)
    step = vo.track(walk.frame(bay + 0.03, 2.0))
    assert not step.usable


def test_a_place_that_looks_like_no_other_is_found(walk, state):
    vo = hvo.Odometry()
    vo.resume(state)
    step = vo.track(walk.frame(BORDER, 2.0))
    assert step.ok
    true = BAY_WIDTH * (BORDER - ALIKE[0])
    assert step.T_world_cam[0, 3] == pytest.approx(true, abs=0.05)
    # the factor is from the place that was seen before, not from where the path was lost
    assert step.prev_index < len(walk.positions) - 4
    before = BAY_WIDTH * (walk.positions[step.prev_index] - ALIKE[0])
    assert invert(step.T_curr_prev)[0, 3] == pytest.approx(true - before, abs=0.05)
