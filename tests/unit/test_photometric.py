"""Photometric polish: the term against numbers and its torch twin, the guard, the monitor."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hybridvo.refinement.photometric_monitor import CHECK_EVERY, PhotometricMonitor

from hybridvo.errors import InputError
from hybridvo.flow import dis_flow
from hybridvo.geometry import ego_flow, invert, se3_exp, se3_log
from hybridvo.odometry import Odometry
from hybridvo.pipeline import estimate, refine
from hybridvo.refinement import photometric_batch as batch
from hybridvo.refinement import photometric_kernels as kernels
from hybridvo.refinement.photometric import PhotometricOptions, polish_photometric
from hybridvo.refinement.photometric_images import Level, blurred, grey_image, match_blur
from hybridvo.refinement.photometric_problem import Problem, State, small_log
from hybridvo.refinement.registration import OffsetCost, depth_offset_cost
from hybridvo.synthetic.render import SyntheticSequence, make_scene
from hybridvo.types import FramePair, RelativePose

MEASURED = range(300, 306)
"""Seeds of the development range that no constant was tuned on."""


def made_pair(kind: str, seed: int, index: int = 0, height: int = 160, width: int = 256):
    """(pair with DIS flow, true T_curr_prev, true flow)."""
    scene = make_scene(kind, seed, height=height, width=width)
    sequence = SyntheticSequence(scene)
    prev, curr = sequence.frame(index), sequence.frame(index + 1)
    field = dis_flow()(prev, curr)
    pair = FramePair(prev, curr, field.flow, field.variance, field.valid, "dis")
    T = invert(sequence.poses[index + 1]) @ sequence.poses[index]
    return pair, T, sequence.flow(index)[0]


def error_px(pair: FramePair, T: np.ndarray, T_true: np.ndarray) -> float:
    """Mean end-point error of the ego flow."""
    cameras = pair.prev.camera, pair.curr.camera
    difference = ego_flow(pair.prev.depth, T, *cameras) - ego_flow(
        pair.prev.depth, T_true, *cameras
    )
    return float(np.nanmean(np.linalg.norm(difference, axis=2)))


@pytest.fixture(scope="module")
def light():
    """(pair, refined motion, true motion) of a scene with movers."""
    pair, T, _ = made_pair("light", 301)
    return pair, refine(pair), T


def as_problem(pair: FramePair, motion: RelativePose, n: int = 400) -> tuple[Problem, Level]:
    images = Level(grey_image(pair.prev.rgb), grey_image(pair.curr.rgb))
    level = blurred(images, 1.0)
    rng = np.random.default_rng(0)
    height, width = pair.prev.camera.shape
    rows, columns = rng.integers(8, height - 8, n), rng.integers(8, width - 8, n)
    good = np.isfinite(pair.prev.depth[rows, columns])
    index = np.stack([rows[good], columns[good]], axis=1).astype(np.int32)
    problem = Problem(pair, motion, index, np.eye(6), PhotometricOptions(), 1.0)
    problem.gather(level)
    return problem, level


def test_cubic_reading_is_exact_on_parabolas():
    # Catmull-Rom reproduces polynomials of second degree (Keys 1981)
    v, u = np.mgrid[0:12, 0:14].astype(np.float32)
    image = 3 + 0.5 * u - 0.25 * v + 0.1 * u * v + 0.2 * u * u - 0.3 * v * v
    for x, y in ((5.25, 4.75), (2.0, 3.0), (9.9, 8.1)):
        expected = 3 + 0.5 * x - 0.25 * y + 0.1 * x * y + 0.2 * x * x - 0.3 * y * y
        read = kernels.read_cubic(image, np.float32(x), np.float32(y))
        assert read == pytest.approx(expected, abs=2e-5)  # float32
        twin = batch.read_cubic(
            torch.tensor(image)[None].double(), torch.tensor([[x]]).double(),
            torch.tensor([[y]]).double(),
        )  # fmt: skip
        assert float(twin) == pytest.approx(expected, abs=1e-5)


def test_jacobian_is_that_of_the_residual(light):
    # at the identity, on one picture, the slope of cubic reading is the central difference
    pair, motion, _ = light
    still = replace(pair, curr=replace(pair.prev))
    problem, level = as_problem(still, motion)
    state = State(np.eye(4), 1.0, 0.0, 1.0)
    problem.project(level, state)
    J = problem.J.copy()
    for column in range(6):
        step = np.zeros(6)
        step[column] = 1e-4
        sides = []
        for sign in (1, -1):
            problem.project(level, replace(state, T=se3_exp(sign * step)))
            sides.append(problem.r.copy())
        slope = (sides[0] - sides[1]) / 2e-4
        # the curvature of cubic reading jumps at the pixels, and float32: 2 % of the largest slope
        assert np.nanmax(np.abs(slope - J[column])) < 0.02 * np.abs(J[column]).max()


def test_numba_and_torch_are_one_definition(light):
    pair, motion, T_true = light
    problem, level = as_problem(pair, motion)
    state = State(se3_exp(np.full(6, 1e-3)) @ T_true, 0.9, 3.0, 2.0)
    problem.depth_noise = 0.01
    cost = problem.project(level, state)
    buffer = [torch.tensor(row)[None].double() for row in problem.buffer]
    pixels = batch.PhotometricPixels(
        buffer[kernels.XN], buffer[kernels.YN], buffer[kernels.Z], buffer[kernels.GREY],
        buffer[kernels.GX], buffer[kernels.GY], buffer[kernels.W],
    )  # fmt: skip
    one = torch.ones(1, dtype=torch.float64)
    r, J, gq, seen = batch.photometric_terms(
        pixels, torch.tensor(level.curr)[None].double(), torch.tensor(state.T)[None],
        torch.tensor(pair.prev.camera.K)[None], torch.tensor(pair.curr.camera.K)[None],
        0.9 * one, 3.0 * one,
    )  # fmt: skip
    w, twin_cost = batch.photometric_weights(
        r, gq, seen, pixels.weight, 2.0 * one, 0.01 * one, problem.options.cutoff
    )
    inside = np.isfinite(problem.r)
    assert inside.sum() > 200
    np.testing.assert_array_equal(inside, seen[0].numpy())
    # float32 coordinates are good to 3e-5 px, grey values change by up to 50 a pixel
    np.testing.assert_allclose(problem.r[inside], r[0].numpy()[inside], atol=5e-3)
    for p in range(kernels.COLUMNS):
        largest = np.abs(problem.J[p]).max()
        np.testing.assert_allclose(problem.J[p], J[0, p].numpy(), atol=1e-4 * largest)
    np.testing.assert_allclose(problem.w, w[0].numpy(), atol=2e-3 * problem.w.max())
    assert cost == pytest.approx(float(twin_cost), rel=1e-3)
    H = ((J * w[:, None]) @ J.transpose(1, 2))[0].numpy()
    scale = np.sqrt(np.diag(H))
    c = kernels.COLUMNS
    difference = (problem.H[:c, :c] - H) / np.outer(scale, scale)
    assert np.abs(difference).max() < 1e-3
    g = -((J * w[:, None]) @ r[..., None])[0, :, 0].numpy()
    assert np.abs((problem.g[:c] - g) / scale).max() < 1e-2 * np.sqrt(cost)


def test_small_log_is_the_logarithm():
    rng = np.random.default_rng(1)
    for size in (1e-9, 1e-5, 1e-2, 0.3):
        T = se3_exp(size * rng.standard_normal(6))
        np.testing.assert_allclose(small_log(T), se3_log(T), atol=1e-12)


def test_pixels_are_spread_and_strong():
    rng = np.random.default_rng(2)
    grey = rng.standard_normal((60, 80)).astype(np.float32)
    depth = np.ones((60, 80), np.float32)
    depth[:, 40:] = np.nan
    weights = np.ones((60, 80), np.float32)
    weights[:30] = 0.1
    index = np.empty((2000, 2), np.int32)
    n = kernels.select_pixels(grey, depth, weights, np.float32(0.25), 10, 4, index)
    rows, columns = index[:n].T
    assert rows.min() >= 30  # rows above have too little weight
    assert columns.max() < 40  # no depth to the right
    cells = (rows - kernels.MARGIN) // 10 * 100 + (columns - kernels.MARGIN) // 10
    assert np.unique(cells, return_counts=True)[1].max() == 4
    gx, gy = np.zeros_like(grey), np.zeros_like(grey)
    gx[:, 1:-1] = grey[:, 2:] - grey[:, :-2]
    gy[1:-1] = grey[2:] - grey[:-2]
    strength = (gx**2 + gy**2)[33:43, 13:23]
    inside = (rows >= 33) & (rows < 43) & (columns >= 13) & (columns < 23)
    found = np.sort((gx**2 + gy**2)[rows[inside], columns[inside]])
    np.testing.assert_allclose(found, np.sort(strength.ravel())[-4:])


@pytest.mark.parametrize("kind", ["light", "heavy_rigid", "pair"])
def test_error_is_a_quarter_of_the_flows(kind):
    before, after = [], []
    for seed in MEASURED:
        pair, T, _ = made_pair(kind, seed)
        motion = refine(pair)
        error = error_px(pair, motion.T_curr_prev, T)
        if error > 0.5:
            continue  # the flow found another motion than the world: the judge's matter
        before.append(error)
        after.append(error_px(pair, polish_photometric(pair, motion).T_curr_prev, T))
    assert len(after) >= 3
    # measured on 512x218: 0.06 to 0.09
    assert np.median(after) <= 0.25 * np.median(before)


def test_information_adds_up(light):
    pair, motion, _ = light
    done = polish_photometric(pair, motion)
    assert done.polish.taken
    assert done.terms == (*motion.terms, "images")
    images, flow = done.polish.image_information, done.polish.flow_information
    joint = np.linalg.inv(done.covariance)
    # Student's prior weighs the flow by (6 + 6) / (6 + d^2), at most 2
    weight = 12 / (6 + done.polish.shift_sigma**2)
    scale = np.sqrt(np.diag(joint))
    np.testing.assert_allclose(
        (joint - images - weight * flow) / np.outer(scale, scale), 0, atol=1e-6
    )
    shift = small_log(done.T_curr_prev @ invert(motion.T_curr_prev))
    np.testing.assert_allclose(done.polish.shift, shift, atol=1e-7)


def test_true_flow_is_not_spoilt():
    for seed in MEASURED:
        pair, T, flow = made_pair("pair", seed)
        motion = refine(replace(pair, flow=flow, flow_variance=None, flow_valid=None))
        done = polish_photometric(pair, motion)
        before, after = (error_px(pair, m.T_curr_prev, T) for m in (motion, done))
        # 1e-3 px: what float32 coordinates and rounding of the picture leave
        assert after <= max(1.05 * before, 1e-3)


def dark(rgb):
    return np.clip(np.rint(0.6 * rgb + 20), 0, 255).astype(np.uint8)


def test_exposure_does_not_matter(light):
    pair, motion, T = light
    done = polish_photometric(
        replace(pair, curr=replace(pair.curr, rgb=dark(pair.curr.rgb))), motion
    )
    assert done.polish.taken
    # the clip at 0 never bites; rounding of the darker picture is all that is lost
    assert done.polish.gain == pytest.approx(0.6, abs=0.02)
    assert done.polish.offset == pytest.approx(20, abs=4)
    assert error_px(pair, done.T_curr_prev, T) < 0.3 * error_px(pair, motion.T_curr_prev, T)


def test_a_blurred_picture_is_matched():
    rng = np.random.default_rng(3)
    sharp = cv2.GaussianBlur(255 * rng.random((160, 200), dtype=np.float32), (0, 0), 1.0)
    soft = cv2.GaussianBlur(sharp, (0, 0), 2.0)
    alike = match_blur(Level(sharp, soft))
    assert np.abs(alike.prev - soft).mean() < 0.15 * np.abs(sharp - soft).mean()
    assert alike.curr is soft
    same = Level(sharp, sharp[::-1].copy())
    assert match_blur(same) is same


OTHER = {
    "black": (lambda rgb: np.zeros_like(rgb), lambda rgb: np.zeros_like(rgb), "no_texture"),
    "one black": (None, lambda rgb: np.zeros_like(rgb), "no_match"),
    "unrelated": (None, lambda rgb: np.ascontiguousarray(rgb[::-1, ::-1]), "no_match"),
}


@pytest.mark.parametrize("name", OTHER)
def test_useless_pictures_change_nothing_and_are_named(name, light):
    pair, motion, _ = light
    first, second, reason = OTHER[name]
    prev = pair.prev if first is None else replace(pair.prev, rgb=first(pair.prev.rgb))
    bad = replace(pair, prev=prev, curr=replace(pair.curr, rgb=second(pair.curr.rgb)))
    done = polish_photometric(bad, motion)
    assert done.polish.reason == reason
    assert "images not used" in done.status.message
    assert done.status.state is motion.status.state
    np.testing.assert_array_equal(done.T_curr_prev, motion.T_curr_prev)
    np.testing.assert_array_equal(done.covariance, motion.covariance)
    assert done.terms == motion.terms


def test_no_images_no_estimate_no_weights(light):
    pair, motion, _ = light
    blind = replace(pair, prev=replace(pair.prev, rgb=None))
    assert polish_photometric(blind, motion).polish.reason == "no_images"
    bare = polish_photometric(pair, motion.replace(weights=None))
    assert bare.polish.reason == "no_estimate"
    broken = motion.replace(covariance=np.full((6, 6), np.nan))
    assert polish_photometric(pair, broken).polish.reason == "no_estimate"
    assert polish_photometric(pair, motion, trust=0.0).polish.reason == "no_gain"
    with pytest.raises(InputError, match="weights of shape"):
        polish_photometric(pair, motion.replace(weights=motion.weights[:5]))
    with pytest.raises(InputError, match="trust"):
        polish_photometric(pair, motion, trust=2.0)


def test_a_motion_outside_of_the_flow_is_refused(light):
    pair, motion, T = light
    # the flow is sure of a motion 0.7 px beside the true one
    wrong = motion.replace(
        T_curr_prev=se3_exp(np.array([0, 0, 0, 0, 4e-3, 0])) @ T, covariance=1e-8 * np.eye(6)
    )
    done = polish_photometric(pair, wrong)
    assert done.polish.reason == "outside_flow"
    np.testing.assert_array_equal(done.T_curr_prev, wrong.T_curr_prev)


@pytest.mark.parametrize("noise", [6, 25])
def test_noise_and_holes_leave_finite_motions(noise, light):
    pair, _, T = light
    rng = np.random.default_rng(noise)

    def noisy(rgb):
        return np.clip(rgb + rng.normal(0, noise, rgb.shape), 0, 255).astype(np.uint8)

    depth = pair.prev.depth.copy()
    depth[rng.random(depth.shape) < 0.3] = np.nan
    bad = replace(
        pair, prev=replace(pair.prev, rgb=noisy(pair.prev.rgb), depth=depth),
        curr=replace(pair.curr, rgb=noisy(pair.curr.rgb)),
    )  # fmt: skip
    motion = refine(bad)
    done = polish_photometric(bad, motion)
    assert np.isfinite(done.T_curr_prev).all()
    assert np.linalg.eigvalsh(done.covariance)[0] > 0
    assert error_px(pair, done.T_curr_prev, T) <= 1.05 * error_px(pair, motion.T_curr_prev, T)


def test_the_same_bytes_every_time(light):
    pair, motion, _ = light
    first, second = (polish_photometric(pair, motion) for _ in range(2))
    assert first.T_curr_prev.tobytes() == second.T_curr_prev.tobytes()


@pytest.mark.parametrize("value", [{"blur_px": ()}, {"iterations": 0}, {"freedom": -1.0}])
def test_options_are_checked(value):
    with pytest.raises(InputError, match=next(iter(value))):
        PhotometricOptions(**value)


# the join


def test_estimate_asks_the_pictures_where_it_is_told_to(light):
    pair, _, _ = light
    assert estimate(pair, method="refine").polish is None
    assert estimate(pair, method="refine", polish="off").polish is None
    done = estimate(pair, method="refine", polish="on")
    assert done.polish.taken
    assert done.method == "refine"
    with pytest.raises(InputError, match="polish"):
        estimate(pair, polish="yes")


def test_the_tracker_goes_on_with_the_same_bytes():
    sequence = SyntheticSequence(make_scene("light", 302, height=96, width=160, frames=6))

    def tracker():
        return Odometry(network=None, method="refine", polish="on", prepare=False)

    whole, first, second = tracker(), tracker(), tracker()
    steps = [whole.track(sequence.frame(k)) for k in range(5)]
    assert steps[1].motion.polish is not None
    for k in range(3):
        first.track(sequence.frame(k))
    stored = json.loads(json.dumps(first.anchor.images))
    second.resume(replace(first.anchor, images=stored))
    for k in (3, 4):
        again = second.track(sequence.frame(k))
        assert again.T_world_cam.tobytes() == steps[k].T_world_cam.tobytes()
    assert second.images.state() == whole.images.state()


# registration and monitor


def shifted(pair: FramePair, right: int, down: int) -> FramePair:
    depth = np.full_like(pair.prev.depth, np.nan)
    height, width = depth.shape
    depth[max(down, 0) : height + min(down, 0), max(right, 0) : width + min(right, 0)] = (
        pair.prev.depth[
            max(-down, 0) : height - max(down, 0), max(-right, 0) : width - max(right, 0)
        ]
    )
    return replace(pair, prev=replace(pair.prev, depth=depth))


def test_a_shifted_depth_map_is_told_from_a_registered_one():
    sums = {0: OffsetCost.nothing(), 3: OffsetCost.nothing()}
    for seed in (301, 303, 305):
        pair, _, _ = made_pair("light", seed, height=218, width=512)
        for right in sums:
            moved = shifted(pair, right, 0)
            sums[right] += depth_offset_cost(moved, polish_photometric(moved, refine(moved)))
    assert sums[0].gain < 0.02
    assert sums[3].gain > 0.02
    offset = sums[3].offset_px
    # occlusion hides a part: measured 0.6 to 1 of the shift
    assert 1.5 < offset[0] < 4.0
    assert abs(offset[1]) < 1.0


def test_the_monitor_says_what_disagrees_and_lowers_trust(light):
    pair, motion, _ = light
    cost = np.full((9, 9), 100.0)
    cost[4, 2] = 50.0  # 2 px to the left
    monitor = PhotometricMonitor()
    assert (monitor.trust, monitor.message) == (1.0, "")
    state = monitor.state() | {"counts": [30, 3], "sums": [20.0, 0.0, 0.0]}
    monitor.restore(state | {"offset": cost.ravel().tolist(), "offset_pixels": 100.0})
    assert monitor.message.startswith("the images disagree with depth by 2.0 px to the left:")
    assert monitor.trust == pytest.approx(0.2)
    monitor.restore(None)
    refused = motion.replace(polish=replace(polish_photometric(pair, motion).polish, taken=False,
                                            reason="no_match", gain=0.5))  # fmt: skip
    for _ in range(CHECK_EVERY):
        monitor.update(pair, refused)
    assert "did not confirm the motion in 100 %" in monitor.message
    assert "exposure changed" in monitor.message
    assert monitor.trust < 0.2
    assert json.loads(json.dumps(monitor.state())) == monitor.state()


# torch


def torch_inputs(pairs, dtype=torch.float64):
    motions = [refine(pair) for pair in pairs]

    def stack(values):
        return torch.stack([torch.tensor(np.asarray(v), dtype=dtype) for v in values])

    levels = [blurred(Level(grey_image(p.prev.rgb), grey_image(p.curr.rgb)), 1.0) for p in pairs]
    return {
        "grey_prev": stack([level.prev for level in levels]),
        "grey_curr": stack([level.curr for level in levels]),
        "depth": stack([p.prev.depth for p in pairs]),
        "K_prev": stack([p.prev.camera.K for p in pairs]),
        "K_curr": stack([p.curr.camera.K for p in pairs]),
        "T_flow": stack([m.T_curr_prev for m in motions]),
        "covariance": stack([m.covariance for m in motions]),
        "weights": stack([m.weights for m in motions]),
    }


@pytest.fixture(scope="module")
def torch_batch():
    made = [made_pair("pair", seed, height=96, width=160) for seed in (301, 304)]
    return [m[0] for m in made], [m[1] for m in made], torch_inputs([m[0] for m in made])


def test_batch_is_polished_like_single_pairs(torch_batch):
    pairs, truths, inputs = torch_batch
    options = PhotometricOptions(blur_px=(1.0,))
    out = batch.polish_photometric_batch(**inputs, options=options)
    assert out.taken.all()
    for k, (pair, T) in enumerate(zip(pairs, truths, strict=True)):
        before = error_px(pair, inputs["T_flow"][k].numpy(), T)
        after = error_px(pair, out.T_curr_prev[k].numpy(), T)
        assert after < 0.5 * before


def test_batch_samples_do_not_see_each_other(torch_batch):
    _, _, inputs = torch_batch
    both = batch.polish_photometric_batch(**inputs)
    alone = batch.polish_photometric_batch(**{k: v[:1] for k, v in inputs.items()})
    # steps until all have converged: the last ones are below the tolerance
    np.testing.assert_allclose(both.T_curr_prev[0], alone.T_curr_prev[0], atol=1e-6)
    poisoned = {k: v.clone() for k, v in inputs.items()}
    poisoned["grey_curr"][1] = torch.nan
    out = batch.polish_photometric_batch(**poisoned)
    np.testing.assert_allclose(out.T_curr_prev[0], alone.T_curr_prev[0], atol=1e-6)
    assert not out.taken[1]
    assert torch.equal(out.T_curr_prev[1], inputs["T_flow"][1])


@pytest.mark.parametrize("name", ["depth", "grey_curr", "K_curr"])
def test_batch_gradient_is_that_of_the_solution(name, torch_batch, monkeypatch):
    # the noise scale is held by the derivative: so it is by the differences. Every pixel is used
    # (cells of two by two), so that the choice does not change. The root is found to its last digit
    monkeypatch.setattr(batch, "_noise_scale", lambda r, used: torch.full_like(r[:, 0], 0.6))
    monkeypatch.setattr(batch, "TOLERANCE", 1e-18)
    monkeypatch.setattr(batch, "STEPS", 60)
    _, _, inputs = torch_batch
    inputs = {k: v[1:, ...].clone() for k, v in inputs.items()}
    for key in ("grey_prev", "grey_curr", "depth", "weights"):
        inputs[key] = inputs[key][:, 20:68, 40:104].contiguous()
    for key in ("K_prev", "K_curr"):
        inputs[key][:, 0, 2] -= 40
        inputs[key][:, 1, 2] -= 20
    options = PhotometricOptions(pixels=10**6)
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(inputs[name].shape, generator=generator, dtype=torch.float64)
    if name == "K_curr":
        direction = torch.zeros_like(direction)
        direction[:, 0, 2] = 1.0

    def run(amount, grad=False):
        amount = torch.tensor(amount, dtype=torch.float64, requires_grad=grad)
        moved = inputs | {name: inputs[name] + amount * direction}
        out = batch.polish_photometric_batch(**moved, options=options)
        assert out.taken.all()
        return amount, out.T_curr_prev[0, :3, 3].sum()

    amount, value = run(0.0, grad=True)
    (slope,) = torch.autograd.grad(value, amount)
    h = 1e-4
    numeric = (run(h)[1] - run(-h)[1]) / (2 * h)
    assert torch.isfinite(slope)
    # the curvature of cubic reading jumps where a point crosses a pixel: 1 %
    assert float(slope) == pytest.approx(float(numeric), rel=0.01)


def test_batch_refuses_shapes(torch_batch):
    _, _, inputs = torch_batch
    with pytest.raises(InputError, match="K_curr"):
        batch.polish_photometric_batch(**(inputs | {"K_curr": inputs["K_curr"][:1]}))
