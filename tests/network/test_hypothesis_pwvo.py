"""PWVO: what it reads of each hypothesis, that pairs stay apart, refits, the mirror."""

from __future__ import annotations

from dataclasses import fields, replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from hybridvo.api import refine
from hybridvo.core.geometry import pixel_grid, se3_exp
from hybridvo.core.options import Options
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.network.euler import euler_motion
from hybridvo.network.grid_maps import GridMaps, grid_maps
from hybridvo.network.hypothesis_inputs import (
    RESIDUAL_QUANTILE,
    USUAL_DEPTH_NOISE,
    HypothesisInputs,
    hypothesis_channels,
    hypothesis_inputs,
    with_no_motion,
)
from hybridvo.network.hypothesis_kernels import HypothesisReadings
from hybridvo.network.hypothesis_maps import FirstLook
from hybridvo.network.hypothesis_readings import read_hypotheses
from hybridvo.network.pwvo import MAX_CORRECTION, PWVO, PWVOOptions
from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair

CELL = Scenario(moving=0.6, objects=1, flow_noise_px=0.3, depth_noise=0.01)
SIZE = {"height": 96, "width": 224}


@pytest.fixture(scope="module")
def network() -> PWVO:
    torch.manual_seed(3)
    made = PWVO()
    # the last layers start at zero; a network that says something is wanted here
    for layer in (made.score, made.head_motion, made.head_uncertainty):
        torch.nn.init.normal_(layer.weight, std=0.3)
    return made.eval()


def search(seed: int, **cell: object) -> tuple[HypothesisSet, object, dict]:
    pair, truth = make_pair(replace(CELL, **cell), seed, **SIZE)
    found = generate(pair, np.eye(4)[None], Options())
    assert len(found.motions) > 1
    return found, pair, truth


def look(
    network: PWVO,
    inputs: HypothesisInputs,
    first: FirstLook = None,
    mirror: torch.Tensor | None = None,
) -> SimpleNamespace:
    """The looks at hypotheses and all of their maps in one."""
    looks = network.look(inputs, first, mirror)
    return SimpleNamespace(looks=looks, **(vars(looks) | vars(network.maps(looks))))


def inputs_of(seed: int) -> HypothesisInputs:
    return asked(search(seed)[0])


def asked(found: HypothesisSet) -> HypothesisInputs:
    image = hypothesis_inputs(grid_maps(found), None, torch.device("cpu"))
    noise = np.array([motion.noise for motion in found.motions])
    return image.with_hypotheses(found.poses, noise, np.arange(len(noise)))


def together(parts: list[HypothesisInputs]) -> HypothesisInputs:
    values = {
        f.name: torch.cat([getattr(p, f.name) for p in parts])
        for f in fields(HypothesisInputs)
    }
    counts = [len(p.owner) for p in parts]
    values["owner"] = torch.repeat_interleave(
        torch.arange(len(parts)), torch.tensor(counts)
    )
    values["parent"] = torch.arange(sum(counts))
    return HypothesisInputs(**values)


def test_support_is_that_of_the_solver(network: PWVO) -> None:
    # the same robust weight, from torch formulas of their own and from the solver's kernel
    found, pair, _ = search(1)
    answer = refine(pair)
    seen = look(network, inputs_of(1)).evidence[:, 0].detach().numpy()
    for hypothesis in answer.hypotheses:
        errors = [np.abs(s - hypothesis.inliers).max() for s in seen]
        # float32 residuals of 0.3 px noise: a hundredth of a standard deviation
        assert min(errors) < 0.02
    assert found.grid.count == seen[0].size


def test_holes_and_unknown_depths_give_finite_answers(
    network: PWVO,
) -> None:
    inputs = inputs_of(1)
    usable = inputs.usable.clone()
    usable[:, :20] = False
    nothing = torch.zeros_like(usable)
    unknown = torch.full_like(inputs.log_depth_at_target, torch.nan)
    with torch.no_grad():
        for mask in (usable, nothing):
            out = look(
                network, replace(inputs, usable=mask, log_depth_at_target=unknown)
            )
            for name in ("score", "static", "motion", "log_scale", "unit"):
                assert torch.isfinite(getattr(out, name)).all(), name
            assert (
                out.evidence[:, 0][~mask.expand_as(out.evidence[:, 0])] == 0
            ).all()


def test_what_was_expected_is_weighed_by_its_covariance() -> None:
    inputs = inputs_of(1)
    sigma = torch.tensor([0.1, 0.2, 0.4, 0.01, 0.02, 0.04])
    # one standard deviation on three axes
    delta = np.array([0.1, 0.0, 0.4, 0.0, 0.02, 0.0])
    pose = torch.as_tensor(se3_exp(delta)[None, :3], dtype=torch.float32)
    told = replace(
        inputs,
        T_prior=torch.eye(4)[None, :3],
        has_prior=torch.tensor([True]),
        prior_information=torch.diag(1 / sigma**2)[None],
        pose=pose.expand(len(inputs.owner), 3, 4),
    )
    scalars = hypothesis_channels(told, None).scalars
    # three of six: 1 / (1 + 3 / 6). First order leaves half of 0.02 rad x 0.4 m, 0.04 of 0.1 m:
    # 0.08 in the square, 0.006 here
    torch.testing.assert_close(
        scalars[0, 4], torch.tensor(2 / 3), atol=7e-3, rtol=0
    )
    assert scalars[0, 5] == 1
    far = replace(told, prior_information=1e12 * told.prior_information)
    scalars = hypothesis_channels(far, None).scalars
    # a prior that is sure of itself says a bounded amount
    assert torch.isfinite(scalars).all() and scalars.abs().max() < 5
    unknown = hypothesis_channels(inputs, None).scalars
    assert (unknown[:, 4:7] == 0).all()


def textured_pair(T: np.ndarray, depth_m: float = 2.0) -> FramePair:
    """A textured wall seen from two places, without any flow to speak of."""
    rng = np.random.default_rng(0)
    camera = Camera(120.0, 120.0, 79.5, 59.5, height=120, width=160)
    wall = cv2.GaussianBlur(
        rng.uniform(0, 255, (360, 480)).astype(np.float32), (0, 0), 4
    )
    wall = 128 + 8 * (wall - wall.mean())
    depth = np.full(camera.shape, depth_m, np.float32)
    uv = pixel_grid(*camera.shape)
    frames = []
    for pose in (np.eye(4), T):
        # the wall moves by ``pose``: a shift of a fronto-parallel plane
        shift = 120.0 * pose[:2, 3] / depth_m
        u, v = (uv[..., 0] - shift[0] + 160), (uv[..., 1] - shift[1] + 120)
        grey = cv2.remap(
            wall, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR
        )
        rgb = np.clip(grey, 0, 255).astype(np.uint8)[..., None].repeat(3, 2)
        frames.append(Frame(rgb, depth, camera))
    flow = np.zeros((*camera.shape, 2), np.float32)
    return FramePair(*frames, flow, None, np.ones(camera.shape, np.bool_))


def test_images_and_depth_tell_motions_apart_where_there_is_no_flow() -> None:
    T = np.eye(4)
    T[0, 3] = 0.2  # 12 px
    pair = textured_pair(T)
    found = generate(pair, np.eye(4)[None], Options())
    maps = replace(
        grid_maps(found), usable=np.zeros(found.grid.shape[:2], np.bool_)
    )
    image = hypothesis_inputs(maps, None, torch.device("cpu"))
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[2, 3] = -0.6, 0.6
    poses = np.stack([T, np.eye(4), near, far])[:, :3]
    inputs = image.with_hypotheses(poses, np.ones((4, 2)), np.arange(4))
    read = hypothesis_channels(inputs, None)
    channels = read.maps
    middle = (slice(None), slice(10, -10), slice(20, -20))
    seen = read.evidence[:, 1][middle].mean((1, 2))
    assert seen[0] > 0.6 and seen[1] < 0.5 * seen[0]
    assert (channels[:, :8] == 0).all()
    gap, known = channels[:, 13][middle], channels[:, 12][middle]
    assert (known[0] == 1).all() and gap[0].abs().max() < 1e-3
    # a point that comes nearer should hide the wall; one that goes away is hidden by it
    assert (gap[2] > 0.1).all() and (gap[3][known[3] > 0] < -0.1).all()
    blank = replace(image, image_prev=torch.full_like(image.image_prev, 90.0))
    nothing = hypothesis_channels(
        blank.with_hypotheses(poses, np.ones((4, 2)), np.arange(4)), None
    )
    assert nothing.evidence[:, 1].abs().max() < 1e-3


# --- what it predicts -------------------------------------------------------------


def test_a_new_network_predicts_the_hypotheses_themselves() -> None:
    inputs = inputs_of(1)
    network = PWVO(PWVOOptions(width=0.25)).eval()
    for head in (network.head_motion, network.head_uncertainty):
        torch.nn.init.zeros_(head.bias)
    with torch.no_grad():
        maps = look(network, inputs)
        start = euler_motion(inputs.pose)[:, :, None, None]
        torch.testing.assert_close(maps.motion, start.expand_as(maps.motion))
        # degrees and metres are those of what a hypothesis leaves unexplained, and a
        # pixel that moves is the more uncertain
        expected = maps.unit.log()[:, :, None, None]
        expected = expected - F.logsigmoid(maps.static)[:, None]
        torch.testing.assert_close(maps.log_scale, expected)
        network.head_motion.bias.fill_(1e3)
        correction = look(network, inputs).motion - start
        limit = MAX_CORRECTION * maps.unit[:, :, None, None]
    torch.testing.assert_close(correction, limit.expand_as(correction))


def test_the_shipped_maps_are_what_the_pages_say() -> None:
    """how-it-works.md and training.md: if this fails, they have to change."""
    shipped = PWVO.from_pretrained()
    for seed in (1, 2):
        with torch.no_grad():
            maps = look(shipped, inputs_of(seed))
        # log U is one number for each hypothesis - log P(static)
        one_number = maps.log_scale + F.logsigmoid(maps.static)[:, None]
        variation = one_number.flatten(2).amax(2) - one_number.flatten(2).amin(2)
        # the rounding of float32 numbers of about ten
        assert float(variation.max()) < 1e-4
        # the pose repeats the hypothesis: wrong ones would need corrections of 1 to 3
        correction = (maps.motion - maps.start[:, :, None, None]) / maps.unit[
            :, :, None, None
        ]
        assert float(correction.abs().flatten(2).median(2).values.max()) < 0.1
        assert float(correction.flatten(2).std(2).max()) < 0.1


# --- the mirror -------------------------------------------------------------------

SIGN = torch.tensor([1.0, -1.0, -1.0, -1.0, 1.0, 1.0])[:, None, None]
"""Of rx, ry, rz, tx, ty, tz in a mirror."""


def mirrored(inputs: HypothesisInputs) -> HypothesisInputs:
    """The same pairs and hypotheses as in a mirror, on the same grid."""
    w = inputs.depth.shape[2]
    stride = int(inputs.stride[0])
    # sum of the columns of two pixels that are mirrored
    total = (w - 1) * stride + 2 * (stride // 2)
    values = {}
    for name in ("depth", "flow_variance", "depth_variance", "usable", "has_depth"):
        values[name] = getattr(inputs, name).flip(-1)
    for name in ("log_depth_at_target", "image_prev", "image_curr"):
        values[name] = getattr(inputs, name).flip(-1)
    target = inputs.target.flip(-1)
    K = inputs.K.clone()
    K[:, 2] = total - K[:, 2]
    M = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    M4 = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))
    return replace(
        inputs,
        **values,
        log_depth_curr=inputs.log_depth_curr.flip(-1),
        ray=inputs.ray.flip(-1) * torch.tensor([-1.0, 1.0])[:, None, None],
        target=torch.stack([total - target[:, 0], target[:, 1]], 1),
        K=K,
        pose=M @ inputs.pose @ M4,
    )


def mirror_case() -> HypothesisInputs:
    """Hypotheses of a pair with images, on a grid of an odd number of columns.

    Scales are quantiles of every second column: those of a mirrored even grid differ.
    """
    inputs = inputs_of(1)
    generator = torch.Generator().manual_seed(0)
    grey = 255 * torch.rand(inputs.depth.shape, generator=generator)
    inputs = replace(inputs, image_prev=grey, image_curr=0.9 * grey)
    width = inputs.depth.shape[2] // 2 * 2 - 1
    values = {
        f.name: getattr(inputs, f.name)[..., :width]
        for f in fields(GridMaps)
        if f.name not in ("K", "width", "stride")
    }
    return replace(inputs, **values)


def test_a_look_into_a_mirror_gives_unmirrored_maps(network: PWVO) -> None:
    inputs = mirror_case()
    other = mirrored(inputs)
    mirror = torch.tensor([True])
    with torch.no_grad():
        plain = look(network, inputs)
        first = look(network, inputs, mirror=mirror)
        expected = look(network, other)
        second = look(network, inputs, (inputs, first.looks), mirror)
        expected_second = look(network, other, (other, expected.looks))
        unmirrored = look(network, inputs, mirror=torch.tensor([False]))
    torch.testing.assert_close(unmirrored.motion, plain.motion)
    torch.testing.assert_close(unmirrored.score, plain.score)
    for got, right in ((first, expected), (second, expected_second)):
        near = {"atol": 5e-3, "rtol": 5e-3}
        torch.testing.assert_close(got.score, right.score, **near)
        torch.testing.assert_close(got.static, right.static.flip(-1), **near)
        torch.testing.assert_close(got.log_scale, right.log_scale.flip(-1), **near)
        motion = SIGN * right.motion.flip(-1)
        torch.testing.assert_close(got.motion, motion, **near)
    # a network that is not symmetric predicts something else in a mirror
    assert (first.static - plain.static).abs().max() > 1e-2


# --- the hypothesis "no motion" ---------------------------------------------------


def test_no_motion_is_one_hypothesis_more_of_some_pairs() -> None:
    inputs = together([inputs_of(seed) for seed in (1, 2)])
    count = len(inputs.owner)
    more = with_no_motion(inputs, torch.tensor([False, True]))
    assert more.owner.tolist() == [*inputs.owner.tolist(), 1]
    assert more.parent.tolist() == [*inputs.parent.tolist(), count]
    assert torch.equal(more.pose[:-1], inputs.pose)
    assert torch.equal(more.pose[-1], torch.eye(3, 4))
    length = inputs.flow.norm(dim=1)[1]
    usual = length[inputs.usable[1]].quantile(RESIDUAL_QUANTILE)
    torch.testing.assert_close(more.flow_noise[-1], usual, atol=0.05, rtol=0.02)
    assert float(more.depth_noise[-1]) == pytest.approx(USUAL_DEPTH_NOISE)
    # what it leaves unexplained is the flow itself
    read = hypothesis_channels(more, None)
    wide = 1024 / float(inputs.width[1])
    size = 0.3 * torch.log1p(length * wide) * inputs.usable[1]
    torch.testing.assert_close(read.maps[-1, 2], size, atol=1e-3, rtol=1e-3)
    nobody = with_no_motion(inputs, torch.tensor([False, False]))
    assert len(nobody.owner) == count


def test_compiled_readings_are_those_of_torch() -> None:
    inputs = inputs_of(1)
    # holes of flow and depth, and a hypothesis that leads behind the camera
    inputs.usable[:, 3:6, 4:9] = False
    inputs.log_depth_at_target[:, 8:11] = torch.nan
    inputs.log_depth_curr[:, :, 5:7] = torch.nan
    inputs.pose[-1, 2, 3] = -1e3
    in_torch = read_hypotheses(inputs)
    with torch.no_grad():
        compiled = read_hypotheses(inputs)
    assert in_torch.is_compared.any()
    assert not in_torch.in_front[-1].any()
    visible = in_torch.in_front & inputs.usable[inputs.owner]
    for name in HypothesisReadings._fields:
        expected = getattr(in_torch, name).float()
        got = getattr(compiled, name).float()
        if name in ("u", "v", "log_z", "length"):
            expected = expected[visible]
            got = got[visible]
        # variances are small differences of large sums
        torch.testing.assert_close(got, expected, atol=2e-3, rtol=1e-4, msg=name)
