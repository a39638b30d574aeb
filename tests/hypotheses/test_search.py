"""The search: all strong motions of a pair, their statistics, and pairs without any."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybridvo.core.geometry import ego_flow, invert, pose_matrix, se3_exp, se3_log
from hybridvo.core.options import Options, RefineOptions, SearchOptions
from hybridvo.core.results import Reason, StageFailed
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.proposals import draw_three
from hybridvo.hypotheses.search import distances, find_motions
from hybridvo.hypotheses.select import search_candidates, to_hypotheses
from hybridvo.hypotheses.types import Candidate, HypothesisSet, MotionSource
from hybridvo.solver.pixels import PixelGrid

IDENTITY = np.eye(4)[None]
CAMERA = Camera(150.0, 150.0, 79.5, 47.5, height=96, width=160)
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


def by_opencv(pair: FramePair, columns: slice) -> np.ndarray:
    """(4, 4) motion of some columns of a pair, from every 7th pixel, by solvePnP."""
    v, u = np.mgrid[:96, :160].astype(float)[:, :, columns]
    depth = pair.prev.depth[:, columns].astype(float)
    flow = pair.flow[:, columns]
    K = CAMERA.K
    rays = np.stack(
        [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1 + 0 * u], -1
    )
    points = (rays * depth[..., None]).reshape(-1, 3)[::7]
    targets = (np.stack([u, v], -1) + flow).reshape(-1, 2)[::7]
    _, angles, shift = cv2.solvePnP(points.copy(), targets.copy(), K, None)
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(angles)[0]
    T[:3, 3:] = shift
    return T


def motions_of(
    pair: FramePair, starts: np.ndarray = IDENTITY, **options: object
) -> tuple[Candidate, ...]:
    tree = Options(search=SearchOptions(**options))
    return find_motions(PixelGrid(pair, None), starts[:, :3], tree, 0)


def test_two_motions_are_those_that_opencv_finds_in_their_parts() -> None:
    pair = pair_of_two_motions()
    world, moving, *_ = motions_of(pair)
    for motion, columns in ((world, slice(55, None)), (moving, slice(0, 55))):
        error = se3_log(pose_matrix(motion.pose) @ invert(by_opencv(pair, columns)))
        # two estimates from other pixels, of 0.1 px over 1000 of them
        assert np.abs(error[3:]).max() < 1e-3
        assert np.abs(error[:3]).max() < 5e-3


def test_statistics_are_those_of_the_pair() -> None:
    world, moving, *_ = motions_of(pair_of_two_motions())
    # 55 of 160 columns move
    assert world.inlier_ratio == pytest.approx(105 / 160, abs=0.05)
    assert moving.inlier_ratio == pytest.approx(55 / 160, abs=0.05)
    for motion in (world, moving):
        # 0.1 px of noise, and what inliers of the other motion add
        assert motion.flow_noise_px == pytest.approx(0.1, abs=0.03)
        assert motion.iterations > 0
        assert motion.source is not MotionSource.RUNNER_UP


def test_a_start_competes_with_the_motions_of_the_pixels() -> None:
    pair = pair_of_two_motions()
    starts = np.stack([np.eye(4), OBJECT])
    # the object's motion is handed in, and only one motion may be found: it is the larger
    (only,) = motions_of(pair, starts, max_hypotheses=1)
    assert np.abs(se3_log(pose_matrix(only.pose) @ invert(WORLD))).max() < 5e-3
    poses = [motion.pose for motion in motions_of(pair, starts)]
    errors = [se3_log(pose_matrix(pose) @ invert(OBJECT)) for pose in poses]
    assert min(np.abs(error).max() for error in errors) < 5e-3


def test_one_motion_of_all_pixels_ends_the_search() -> None:
    pair = pair_of_two_motions()
    flow = ego_flow(pair.prev.depth, WORLD, CAMERA, CAMERA).astype(np.float32)
    motions = motions_of(replace(pair, flow=flow))
    assert len(motions) == 1
    assert motions[0].inlier_ratio > 0.95


def test_few_pixels_beside_a_motion_of_nearly_all_show_another_one() -> None:
    pair = pair_of_two_motions()
    moved = ego_flow(pair.prev.depth, OBJECT, CAMERA, CAMERA)
    # 20 of 160 columns are left of the world
    flow = ego_flow(pair.prev.depth, WORLD, CAMERA, CAMERA)
    flow[:, 20:] = moved[:, 20:]
    first, second, *_ = motions_of(replace(pair, flow=flow.astype(np.float32)))
    assert first.inlier_ratio > 0.85
    # without noise, to single precision and what other pixels pull
    for motion, T in ((first, OBJECT), (second, WORLD)):
        assert np.abs(se3_log(pose_matrix(motion.pose) @ invert(T))).max() < 5e-3


def test_weak_motions_are_left_out() -> None:
    # the object has a third of the pixels
    motions = motions_of(pair_of_two_motions(), min_inlier_ratio=0.5)
    assert len(motions) == 1
    assert motions[0].inlier_ratio > 0.5


def test_inliers_follow_the_option_of_the_cutoff() -> None:
    pair = pair_of_two_motions()
    inlier_sums = []
    for cutoff in (1.5, 3.0, 6.0):
        options = Options(refine=RefineOptions(cutoff=cutoff))
        found = generate(pair, np.eye(4)[None], options)
        world = to_hypotheses(found, search_candidates(found))[0]
        inlier_sums.append(float(world.inliers.sum()))
    # (c^2 / (c^2 + d^2))^2 of d^2 = 2, the mean of two directions: 0.28, 0.67, 0.90
    assert inlier_sums[0] < 0.75 * inlier_sums[1]
    assert inlier_sums[1] < 0.9 * inlier_sums[2]


def test_pairs_without_any_motion_fail_with_a_reason() -> None:
    pair = pair_of_two_motions()
    no_depth = Frame(None, None, CAMERA)
    broken = np.full_like(pair.flow, np.nan)
    for changed, reason in (
        (replace(pair, flow=None), Reason.NO_FLOW),
        (replace(pair, flow=broken), Reason.NO_FLOW),
        (replace(pair, prev=no_depth), Reason.NO_VALID_DEPTH),
    ):
        with pytest.raises(StageFailed) as failure:
            generate(changed, np.eye(4)[None], Options())
        assert failure.value.reason is reason
        assert str(failure.value)


def test_pixels_behind_both_cameras_do_not_make_one_motion_two() -> None:
    """The camera drives through what is nearer than 4 m; a metre sideways is 150 px at 1 m."""
    grid = search().grid
    ahead = se3_exp(np.array([0.0, 0.0, -4.0, 0.0, 0.0, 0.0]))
    beside = se3_exp(np.array([1.0, 0.0, -4.0, 0.0, 0.0, 0.0]))
    gaps = distances(grid, [x[:3] for x in (ahead, ahead, beside, np.eye(4))], 0)
    assert max(gaps[:2]) < 1e-9
    # behind one camera counts as 1000 px of this image
    assert gaps[2] > 100 and gaps[3] > 1000


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
