"""A motion from a keyframe that corrects the path since."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.lab.synthetic.scenes import make_scene
from hybridvo.tracking.corrections import corrects_path
from hybridvo.tracking.keyframes import Keyframe
from tests import slow_walk

TIGHT = 1e-3**2 * np.eye(6)


class Walk(NamedTuple):
    """A path in equal steps, of which all were measured from the first frame."""

    frames: list[hvo.Frame]
    poses: np.ndarray  # (4, 4, 4) T_world_cam

    @property
    def step(self) -> np.ndarray:
        """(4, 4) motion from each frame to the next."""
        return invert(self.poses[1]) @ self.poses[0]

    def start(self) -> Keyframe:
        """The first frame."""
        return Keyframe(self.frames[0], self.poses[0], 0, 0, TIGHT)

    def reference(self, aside_m: float) -> Keyframe:
        """The last but one, thought to be so far aside of where it is."""
        aside = se3_exp(np.array([aside_m, 0, 0, 0, 0, 0]))
        return Keyframe(self.frames[2], self.poses[2] @ aside, 2, 0, TIGHT)

    def motion(self) -> RelativePose:
        """The true motion from the first frame to the last."""
        return RelativePose(invert(self.poses[3]) @ self.poses[0], covariance=TIGHT)


@pytest.fixture(scope="module")
def walk() -> Walk:
    scene = make_scene("static", 6, height=120, width=160, frames=4)
    poses = np.asarray(scene.T_world_cam)
    return Walk([scene.render(k) for k in range(4)], poses)


@pytest.mark.parametrize(("aside_m", "corrects"), [(0.0, False), (0.05, True)])
def test_a_path_that_was_elsewhere_is_corrected(
    walk: Walk, aside_m: float, corrects: bool
) -> None:
    T_last = invert(walk.poses[3]) @ walk.poses[2]
    expected = MotionPrior(T_last, TIGHT)
    reference = walk.reference(aside_m)
    rest = (walk.frames[3], expected, RefineOptions())
    assert corrects_path(walk.motion(), walk.start(), reference, *rest) == corrects
    # from the frame before there is no path since
    assert not corrects_path(walk.motion(), reference, reference, *rest)


def test_a_sudden_motion_that_the_images_show_corrects_nothing(walk: Walk) -> None:
    sudden = se3_exp(np.array([0.2, 0, 0, 0, 0.05, 0])) @ walk.step
    ahead = (walk.motion(), walk.start(), walk.reference(0.0), walk.frames[3])
    assert not corrects_path(*ahead, MotionPrior(sudden, TIGHT), RefineOptions())
    # nor where nothing is expected, or hardly anything
    assert not corrects_path(*ahead, None, RefineOptions())
    loose = MotionPrior(sudden, np.eye(6))
    assert not corrects_path(*ahead, loose, RefineOptions())


@pytest.mark.slow
def test_a_corrected_path_goes_on_from_the_keyframe_that_corrects_it() -> None:
    """Slow things lead it away by a centimetre in each of the first steps."""
    frames, poses = slow_walk.frames("heavy_two", seed=7, count=16)
    vo = hvo.Odometry()
    vo.set_pose(poses[0])
    steps = [vo.track(frame) for frame in frames]
    correction = next(s for s in steps[2:] if s.prev_index < s.index - 1)
    for step in steps[correction.index :]:
        true = invert(poses[step.index]) @ poses[step.prev_index]
        np.testing.assert_allclose(step.T_curr_prev, true, atol=0.01)
        held = {keyframe.count for keyframe in vo.state.keyframes}
        # what was taken on the wrong path is no longer a start
        assert not held & set(range(correction.prev_index + 1, correction.index))
