"""What images show of a motion at video rate, where every point seems to follow it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Motion, PhotometricReport
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.judge.calibration import DIRECT_PROBABILITY
from hybridvo.judge.probability import direct_probability
from hybridvo.pipeline import sure_alignment
from hybridvo.solver.align import align_images
from hybridvo.solver.aligned_points import (
    SeenPoints,
    direct_evidence,
    see_points,
    weighted_median,
)
from hybridvo.solver.planes import planes_of
from hybridvo_lab.synthetic.slow_scenes import (
    noisy_image,
    slow_scene,
    structured_light,
)

SIZE = (240, 320)
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, height=SIZE[0], width=SIZE[1])
NO_MOTION = Motion(photometric=PhotometricReport(gain=1.0))
NOISE = 2.0
CUTOFF = RefineOptions().cutoff


def waves(shift_px: float) -> np.ndarray:
    """(H, W) grey values whose texture lies so far to the right."""
    v, u = np.indices(SIZE, dtype=np.float64)
    x = u - shift_px
    return 128 + 50 * np.sin(x / 4 + 0.02 * v) + 30 * np.sin(v / 5 + x / 9)


def frame(grey: np.ndarray, seed: int) -> Frame:
    """A noisy view of a wall two metres away."""
    grey = grey + np.random.default_rng(seed).normal(0, NOISE, SIZE)
    rgb = np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None].repeat(3, 2)
    return Frame(rgb, np.full(SIZE, 2.0, np.float32), CAMERA)


def seen(left_px: float, right_px: float) -> SeenPoints:
    """What no motion shows where the halves of a view moved so far."""
    grey = waves(left_px)
    grey[:, SIZE[1] // 2 :] = waves(right_px)[:, SIZE[1] // 2 :]
    pair = FramePair(frame(waves(0.0), 0), frame(grey, 1), None)
    ones = np.ones(SIZE, np.float32)
    planes = planes_of(pair).weighted(ones, 0.0, RefineOptions())
    at = planes.at(np.eye(4))
    return see_points(pair, planes, at, NO_MOTION, CUTOFF)


def test_of_a_right_motion_regions_stay_within_the_noise() -> None:
    assert seen(0.0, 0.0).shift_of_regions() < 1.5


@pytest.mark.parametrize("shift_px", [0.2, 0.4])
def test_regions_show_a_shift_that_no_point_shows(shift_px: float) -> None:
    """Each point would lie within a grey level of the noise; the regions lie far outside."""
    between_two = seen(-shift_px, shift_px).shift_of_regions()
    assert between_two > 2 * seen(0.0, 0.0).shift_of_regions()


def test_only_regions_that_count_as_static_are_asked() -> None:
    points = seen(0.0, 0.5)
    is_left = points.planes.index[:, 1] < SIZE[1] // 2 - 40
    of_left = points.shift_of_regions(is_left.astype(float))
    of_right = points.shift_of_regions(1.0 - is_left)
    assert of_left < 1.5 and of_right > 3 * of_left


def test_a_view_without_texture_shows_no_shift() -> None:
    pair = FramePair(
        frame(np.full(SIZE, 90.0), 0), frame(np.full(SIZE, 90.0), 1), None
    )
    ones = np.ones(SIZE, np.float32)
    planes = planes_of(pair).weighted(ones, 0.0, RefineOptions())
    at = planes.at(np.eye(4))
    points = see_points(pair, planes, at, NO_MOTION, CUTOFF)
    outside = points._replace(inside=np.zeros_like(points.inside))
    assert outside.shift_of_regions() == 0.0
    assert np.isfinite(points.shift_of_regions())


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30),
    st.integers(0, 2**32 - 1),
)
def test_half_of_the_weight_lies_on_each_side_of_the_median(values, seed) -> None:
    x = np.array(values)
    weights = np.random.default_rng(seed).random(len(x)) + 0.01
    middle = weighted_median(x, weights)
    half = weights.sum() / 2
    assert middle in x
    assert weights[x < middle].sum() <= half * (1 + 1e-9)
    assert weights[x > middle].sum() <= half * (1 + 1e-9)


def test_nothing_has_no_median() -> None:
    assert weighted_median(np.zeros(0), np.zeros(0)) == 0.0
    assert weighted_median(np.ones(3), np.zeros(3)) == 0.0


@given(
    st.floats(1e-4, 2.0),
    st.floats(0.0, 50.0),
    st.floats(0.0, 10.0),
    st.floats(0.0, 1.0),
)
def test_what_speaks_against_a_motion_lowers_its_probability(
    std, flow, shift, unexplained
) -> None:
    p = direct_probability(direct_evidence(std, flow, shift, unexplained))
    assert 0 <= p <= 1
    for worse in (
        (2 * std, flow, shift, unexplained),
        (std, flow, shift + 1, unexplained),
        (std, flow, shift, min(1.0, unexplained + 0.1)),
    ):
        assert direct_probability(direct_evidence(*worse)) <= p


def video(kind: str, seed: int, frames: int) -> list[tuple[Frame, np.ndarray]]:
    """Frames of a scene at video rate as a depth camera measures them, and where it was."""
    scene = slow_scene(kind, seed, frames, SIZE)
    rng = np.random.default_rng(seed)
    measured = []
    for index in range(frames):
        exact = scene.render(index)
        rgb = noisy_image(exact.rgb, rng)
        depth = structured_light(scene.depth(index), rng)
        taken = Frame(rgb, depth, exact.camera, exact.timestamp, index)
        measured.append((taken, scene.T_world_cam[index]))
    return measured


@pytest.mark.parametrize(("kind", "seed"), [("heavy_two", 702), ("light", 705)])
def test_a_motion_between_those_of_the_scene_and_of_things_is_not_sure(
    kind: str, seed: int
) -> None:
    """Of neighbouring frames every point seems to follow it: things are half a pixel away."""
    (before, _), (after, _) = video(kind, seed, 2)
    rough = align_images(FramePair(before, after, None))
    found = sure_alignment(rough, 0.0)
    assert found is not None
    assert direct_probability(found.evidence) < DIRECT_PROBABILITY
