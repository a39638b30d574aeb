from __future__ import annotations

import numpy as np

from hybridvo.geometry import ego_flow, invert, se3_exp, se3_log
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.proposals import draw_three
from hybridvo.hypotheses.search import distances
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.options import Options
from hybridvo.types import Camera, Frame, FramePair

CAMERA = Camera(150.0, 150.0, 79.5, 47.5, 96, 160)
WORLD = se3_exp(np.array([0.05, -0.02, 0.1, 0.004, -0.01, 0.006]))
OBJECT = se3_exp(np.array([-0.2, 0.05, 0.0, 0.02, 0.03, -0.01]))


def pair_of_two_motions() -> FramePair:
    """An object on the left third, and noise of a tenth of a pixel."""
    v, u = np.mgrid[:96, :160]
    depth = (4 + np.sin(u / 9.0) + np.cos(v / 7.0)).astype(np.float32)
    flow = ego_flow(depth, WORLD, CAMERA, CAMERA)
    flow[:, :55] = ego_flow(depth, OBJECT, CAMERA, CAMERA)[:, :55]
    flow += np.random.default_rng(0).normal(0, 0.1, flow.shape)
    frame = Frame(None, depth, CAMERA)
    return FramePair(frame, frame, flow.astype(np.float32))


def search(seed: int = 0) -> HypothesisSet:
    return generate(pair_of_two_motions(), np.eye(4)[None], Options(), seed)


def test_both_motions_are_found_the_larger_one_first() -> None:
    found = search()
    for pose, true in zip(found.poses, (WORLD, OBJECT), strict=False):
        error = se3_log(np.vstack([pose, [0, 0, 0, 1]]) @ invert(true))
        # a tenth of a pixel over a thousand pixels and more is 3e-5 rad
        assert np.abs(error[3:]).max() < 1e-3 and np.abs(error[:3]).max() < 5e-3
    assert found.is_ambiguous


def test_pixels_behind_both_cameras_do_not_make_one_motion_two() -> None:
    """The camera drives through what is nearer than 4 m; a metre sideways is 150 px at 1 m."""
    grid = search().grid
    ahead = se3_exp(np.array([0.0, 0.0, -4.0, 0.0, 0.0, 0.0]))
    beside = se3_exp(np.array([1.0, 0.0, -4.0, 0.0, 0.0, 0.0]))
    gaps = distances(grid, [x[:3] for x in (ahead, ahead, beside, np.eye(4))], 0)
    assert max(gaps[:2]) < 1e-9
    # behind one camera counts as 1000 px of this image
    assert gaps[2] > 100 and gaps[3] > 1000


def test_a_seed_gives_the_same_motions_again() -> None:
    np.testing.assert_allclose(search(3).poses, search(3).poses, atol=1e-9)


def test_drawn_pixels_are_distinct_and_usable() -> None:
    samples = np.zeros((8, 12 * 16), np.float32)
    samples[7, ::3] = 1.0
    rng, pick = np.random.default_rng(1), np.zeros(3, np.int64)
    usable = np.flatnonzero(samples[7])
    drawn = 0
    for k in range(200):
        if draw_three(samples, usable, 12, 16, k % 2 == 0, rng, pick):
            drawn += 1
            assert len(set(pick.tolist())) == 3 and (pick % 3 == 0).all()
    assert drawn > 180  # in a corner there may be no other one near by
    assert not draw_three(0 * samples, usable, 12, 16, False, rng, pick)
