"""What every method promises of any pair, whatever it computes.

Finite, rigid, with a positive covariance; failed means identity with a reason; layouts, threads and
seeds change nothing. hybridvo's own methods are in addition never ok and outside of three of their
own standard deviations where nothing but rounding could excuse it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybridvo.api import estimate
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import se3_exp
from hybridvo.core.results import MotionPrior, Reason, State
from hybridvo.core.types import FramePair
from hybridvo.hypotheses.generate import without_sky
from hybridvo.pipeline import DEFAULT_METHOD, check_method, method_names
from hybridvo_lab.baselines import WITHOUT_FLOW
from hybridvo_lab.synthetic.noise_scenarios import make_pair
from tests import worlds

SEARCHING = ("hybrid", "hybrid-flow", "classical")
"""Methods that look for every motion of a pair, and so know when two are as good."""
OWN = (*SEARCHING, "pwvo", "pwvo-refine")
EXACT = (
    "hybrid",
    "hybrid-flow",
    "classical",
    "pwvo-refine",
    "pnp-ransac",
    "pnp-ransac-tuned",
)
EXACT += ("usac-magsac", "poselib")
"""Methods whose answer on exact data is exact."""
NO_FLOW = ("opencv-rgbd", "open3d-rgbd", *WITHOUT_FLOW)
"""Methods that take no flow."""
SLOW = ("pwvo", "vonet", "rgbd", "pixelwise", "icp")
"""A tenth of a second and more a pair: the long tables are slow tests for them."""


def runs_here(method: str) -> bool:
    try:
        check_method(method)
    except InputError:
        return False
    return True


HERE = [method for method in method_names() if runs_here(method)]


def of_methods(
    names: tuple[str, ...] | list[str], brief: bool = False
) -> pytest.MarkDecorator:
    """One test for each of these methods that can run; slow ones are marked unless it is brief."""
    marked = [
        pytest.param(name, marks=pytest.mark.long)
        if not brief
        and name != "pwvo-refine"
        and any(part in name for part in SLOW)
        else name
        for name in names
        if name in HERE
    ]
    return pytest.mark.parametrize("method", marked)


@cache
def exact() -> tuple[FramePair, np.ndarray]:
    return worlds.world(two_cameras=True)


@cache
def noisy(seed: int = 0) -> tuple[FramePair, np.ndarray]:
    return worlds.world(noise=(0.3, 0.005), movers=1, seed=seed, two_cameras=True)


def test_the_methods_of_the_readme_run_here() -> None:
    assert {
        "hybrid",
        "hybrid-flow",
        "classical",
        "pwvo",
        "pnp-ransac",
        "identity",
    } <= set(HERE)
    assert DEFAULT_METHOD in HERE


@of_methods(HERE, brief=True)
def test_exact_data(method: str) -> None:
    pair, T = exact()
    found = estimate(pair, method=method)
    worlds.assert_sane(found)
    assert found.method == method
    if method in EXACT:
        assert found.status.state is State.OK
        worlds.assert_pose_close(found.T_curr_prev, T, rad=1e-5, m=1e-4)


@of_methods(HERE, brief=True)
def test_noise_and_a_moving_object(method: str) -> None:
    for seed in range(2):
        pair, _ = noisy(seed)
        worlds.assert_sane(estimate(pair, method=method))


@of_methods([name for name in EXACT if name in OWN])
def test_the_covariance_covers_the_error_of_noise(method: str) -> None:
    """Of chi-square with six degrees of freedom the median is 5.3; model noise alone."""
    errors = []
    for seed in range(5):
        pair, T = worlds.world(noise=(0.3, 0.005), seed=seed, texture=False)
        errors.append(worlds.normalised_error(estimate(pair, method=method), T))
    assert 1.0 < np.median(errors) < worlds.CHI2_3SIGMA


def test_images_sharpen_the_motion_of_a_noisy_flow() -> None:
    """The photometric refinement of the default method does its work."""
    by_flow, by_images = (
        np.median(
            [
                worlds.pose_error(estimate(pair, method=method).T_curr_prev, T)[1]
                for pair, T in (
                    worlds.world((120, 160), noise=(1.0, 0.0), seed=s)
                    for s in range(3)
                )
            ]
        )
        for method in ("hybrid-flow", "hybrid")
    )
    assert by_images < by_flow / 3


# --- invalid values -------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.5, 1.0])
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0])
@of_methods(HERE)
def test_invalid_depth(method: str, value: float, fraction: float) -> None:
    pair, T = exact()
    where = np.random.default_rng(0).random(pair.prev.camera.shape) < fraction
    found = estimate(worlds.masked(pair, where, value), method=method)
    worlds.assert_sane(found)
    if method in EXACT:
        assert (found.status.state is State.OK) == (fraction < 1)
    if method in EXACT and fraction < 1:
        worlds.assert_pose_close(found.T_curr_prev, T, rad=1e-5, m=1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e6, 1e30, 3e38])
@of_methods(HERE)
def test_flow_that_is_none_or_leaves_the_image(method: str, value: float) -> None:
    pair, T = exact()
    flow = pair.flow.copy()
    flow[:, : flow.shape[1] // 3] = value
    found = estimate(replace(pair, flow=flow), method=method)
    worlds.assert_sane(found)
    if method in ("classical", "hybrid-flow"):
        assert found.usable
        worlds.assert_pose_close(found.T_curr_prev, T, rad=1e-4, m=1e-3)
    nowhere = estimate(replace(pair, flow=np.full_like(flow, value)), method=method)
    worlds.assert_sane(nowhere)
    if method in EXACT:
        assert nowhere.status.state is State.FAILED


@of_methods(HERE)
def test_depths_from_one_end_of_the_numbers_to_the_other(method: str) -> None:
    pair, _ = exact()
    shape = pair.prev.camera.shape
    rng = np.random.default_rng(0)
    for depth in (
        10.0 ** rng.uniform(-6, 6, shape),
        np.full(shape, 1e300),
        np.full(shape, 3e38),
        np.full(shape, 1e-40),
        np.where(np.arange(shape[1]) < 64, 1e6, 1e-6) * np.ones(shape),
    ):
        changed = replace(pair, prev=replace(pair.prev, depth=depth))
        worlds.assert_sane(estimate(changed, method=method))


@of_methods(HERE, brief=True)
def test_what_is_masked_changes_nothing(method: str) -> None:
    pair, _ = exact()
    mask = np.random.default_rng(1).random(pair.prev.camera.shape) < 0.7
    clean, garbage = (
        replace(
            pair,
            prev=replace(
                pair.prev, depth=np.where(mask, pair.prev.depth, depth), mask=mask
            ),
            flow=np.where(mask[..., None], pair.flow, flow).astype(np.float32),
        )
        for depth, flow in ((np.nan, np.nan), (7.0, -40.0))
    )
    first, second = (
        estimate(p, method=method).T_curr_prev for p in (clean, garbage)
    )
    limit = 1e-3 if method in ("pwvo", "opencv-rgbd", "open3d-rgbd") else 1e-5
    worlds.assert_pose_close(first, second, rad=limit, m=10 * limit)


@of_methods([name for name in HERE if name != "identity"], brief=True)
def test_what_is_missing_is_named(method: str) -> None:
    pair, _ = exact()
    without_flow = estimate(replace(pair, flow=None), method=method)
    without_depth = estimate(
        replace(pair, prev=replace(pair.prev, depth=None)), method=method
    )
    for found, reason in (
        (without_flow, Reason.NO_FLOW),
        (without_depth, Reason.NO_VALID_DEPTH),
    ):
        worlds.assert_sane(found)
        if method not in NO_FLOW:
            assert (
                found.status.state is State.FAILED and found.status.reason is reason
            )


# --- geometry that says little --------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 3, 5, 6, 23])
@of_methods(HERE)
def test_a_handful_of_pixels(method: str, count: int) -> None:
    pair, T = exact()
    keep = np.random.default_rng(2).permutation(pair.flow[..., 0].size) < count
    few = worlds.masked(pair, ~keep.reshape(pair.prev.camera.shape), np.nan)
    found = estimate(few, method=method)
    worlds.assert_sane(found)
    if method in OWN:
        worlds.assert_never_wrong_and_sure(found, T)


@pytest.mark.parametrize(
    "noise", [(0.0, 0.0), (0.3, 0.005)], ids=["exact", "noisy"]
)
@pytest.mark.parametrize("kind", worlds.DEGENERATE)
@of_methods(HERE)
def test_degenerate_data(
    method: str, kind: str, noise: tuple[float, float]
) -> None:
    for seed in range(2):
        pair, T = worlds.degenerate(kind, noise, seed)
        found = estimate(pair, method=method, seed=seed)
        worlds.assert_sane(found)
        if method in SEARCHING and found.status.state is State.OK:
            # drawn noise: three sigma are left now and then, nonsense is thousands away
            limit = worlds.CHI2_3SIGMA * (3 if any(noise) else 1)
            assert worlds.normalised_error(found, T) < limit


@pytest.mark.parametrize(
    "motion",
    [
        (0,) * 6,
        (0, 0, 0, 0.02, -0.03, 0.01),
        (0, 0, 0.01, 0, 0, 0),
        (0, 0, 0, 0, 0, 0.1),
    ],
    ids=["rest", "rotation", "centimetre", "roll"],
)
@of_methods(HERE)
def test_motions_with_little_parallax(
    method: str, motion: tuple[float, ...]
) -> None:
    pair, T = worlds.world(motion=motion)
    found = estimate(pair, method=method)
    worlds.assert_sane(found)
    if method in EXACT:
        # PWVO is less sure of exact flow that is zero everywhere: no camera gives it
        is_unsure = motion == (0,) * 6 and found.probability > 0.8
        assert found.status.state is State.OK or is_unsure
        worlds.assert_pose_close(found.T_curr_prev, T, rad=1e-5, m=1e-4)


@pytest.mark.parametrize(
    "size", [(1, 1), (2, 3), (8, 8), (16, 16), (17, 301), (301, 17)]
)
@of_methods(HERE)
def test_small_and_odd_images(method: str, size: tuple[int, int]) -> None:
    pair, T = worlds.world(size, noise=(0.1, 0.005))
    found = estimate(pair, method=method)
    worlds.assert_sane(found)
    if method in OWN:
        worlds.assert_never_wrong_and_sure(found, T)


# --- units, layouts, threads, seeds ---------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 2e5])
@of_methods(HERE)
def test_a_scaled_scene_scales_the_translation_alone(
    method: str, scale: float
) -> None:
    pair, T = worlds.world(scale=scale)
    found = estimate(pair, method=method)
    worlds.assert_sane(found)
    if method in ("hybrid", "hybrid-flow", "classical"):
        # lengths right in their unit, which cannot be metres
        assert found.status.reason is Reason.DEPTH_UNIT and found.usable
        assert "expects metres" in found.status.message
        worlds.assert_pose_close(found.T_curr_prev, T, rad=1e-6, m=1e-5 * scale)


@pytest.mark.parametrize("layout", worlds.LAYOUTS)
@of_methods(HERE)
def test_the_layout_in_memory_changes_nothing(method: str, layout: str) -> None:
    pair, _ = noisy()
    expected, found = (
        estimate(p, method=method).T_curr_prev
        for p in (pair, worlds.with_layout(pair, layout))
    )
    worlds.assert_pose_close(found, expected, rad=1e-6, m=1e-6)


@of_methods(HERE, brief=True)
def test_threads_and_repetition_change_nothing(method: str) -> None:
    pairs = [noisy(seed)[0] for seed in (0, 1)]
    serial = [estimate(pair, method=method, seed=3).T_curr_prev for pair in pairs]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(2):
            found = pool.map(
                lambda pair: estimate(pair, method=method, seed=3), pairs
            )
            for one, other in zip(found, serial, strict=True):
                worlds.assert_pose_close(one.T_curr_prev, other, rad=1e-6, m=1e-6)


@pytest.mark.parametrize("kind", ["true", "before", "wrong"])
@of_methods([*SEARCHING, "pwvo-refine"])
def test_no_prior_makes_an_answer_worse(method: str, kind: str) -> None:
    pair, T = noisy()
    apart = {"true": 0.0, "before": 0.01, "wrong": 0.3}[kind]
    T_prior = se3_exp(apart * np.array([1, -1, 1, 0.1, 0.1, -0.1])) @ T
    # a prior may be wrong: its covariance says 5 cm and 1 degree
    prior = MotionPrior(T_prior, np.diag([0.05**2] * 3 + [0.02**2] * 3))
    without, with_prior = (
        worlds.pose_error(estimate(pair, method=method, prior=p).T_curr_prev, T)
        for p in (None, prior)
    )
    assert with_prior[0] <= 1.1 * without[0] + 1e-5
    assert with_prior[1] <= 1.1 * without[1] + 1e-4


@pytest.mark.parametrize("shape", ["(H, W)", "(H, W, 1)"])
def test_a_grey_image_is_three_equal_channels(shape: str) -> None:
    pair, _ = exact()
    grey = [frame.rgb[..., 0] for frame in (pair.prev, pair.curr)]
    answers = []
    for rgb in (grey, [image[..., None].repeat(3, 2) for image in grey]):
        if shape == "(H, W, 1)":
            rgb = [image.reshape(*image.shape[:2], -1) for image in rgb]
        prev, curr = (
            replace(frame, rgb=image)
            for frame, image in zip((pair.prev, pair.curr), rgb, strict=True)
        )
        answers.append(estimate(replace(pair, prev=prev, curr=curr)).T_curr_prev)
    worlds.assert_pose_close(answers[0], answers[1], rad=1e-9, m=1e-9)


def test_the_sky_that_a_renderer_states_names_no_motion() -> None:
    pair, truth = make_pair("moving00", 3, 120, 160)
    sky = np.zeros((120, 160), bool)
    sky[:50] = True
    # textureless: it follows what lies below
    flow = pair.flow + 4.0 * sky[..., None]
    answers = []
    for depth in (4e4, 0.0):
        prev = replace(
            pair.prev, depth=np.where(sky, np.float32(depth), pair.prev.depth)
        )
        answers.append(
            estimate(replace(pair, prev=prev, flow=flow), method="classical")
        )
    seen, hidden = answers
    for one, other in zip(seen.hypotheses, hidden.hypotheses, strict=True):
        np.testing.assert_allclose(one.T_curr_prev, other.T_curr_prev, atol=1e-9)
    # where its flow is right it would tell the rotation
    np.testing.assert_allclose(seen.T_curr_prev, truth["T_curr_prev"], atol=4e-3)
    assert (
        seen.ok
        and seen.weights.shape == sky.shape
        and seen.weights[:50].mean() < 0.05
    )
    assert without_sky(pair).prev is pair.prev
    # of another unit, or from the air, nearly all lies beyond
    far = replace(pair, prev=replace(pair.prev, depth=1000 * pair.prev.depth))
    assert without_sky(far).prev is far.prev
