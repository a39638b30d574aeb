"""PWVO's selection seeds and weighs the differentiable refinement: the lines of the README."""

from __future__ import annotations

import math
from dataclasses import replace

import kornia
import numpy as np
import pypose as pp
import pytest
import torch

import hybridvo as hvo
from hybridvo.core import torch_geometry
from hybridvo.core.results import Reason
from hybridvo_lab.synthetic.noise_scenarios import make_pair
from tests import worlds

SIZE = (120, 160)


@pytest.fixture(scope="module")
def pairs():
    return [make_pair("moving50", seed, *SIZE) for seed in (510, 511)]


def four_lines(pairs, device="cpu", dtype=torch.float32):
    batch = hvo.PairBatch.from_pairs(pairs, device, dtype)
    maps = hvo.PWVO.from_pretrained().to(device)(batch)
    seed = hvo.select(maps)
    return hvo.refine(batch, seed)


def check(motion, pairs) -> None:
    errors = [
        np.abs(
            motion.T_curr_prev[k].detach().cpu().numpy() - truth["T_curr_prev"]
        ).max()
        for k, (_, truth) in enumerate(pairs)
    ]
    # most of each image moves by itself, by ten times as much
    assert max(errors) < 0.05, errors
    assert isinstance(motion.SE3, pp.LieTensor) and not motion.failed.any()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_as_they_stand(pairs, dtype) -> None:
    motion = four_lines([p for p, _ in pairs], dtype=dtype)
    check(motion, pairs)
    assert motion.T_curr_prev.dtype == dtype
    alone = four_lines([pairs[0][0]], dtype=dtype)
    torch.testing.assert_close(alone.T_curr_prev, motion.T_curr_prev[:1])
    torch.testing.assert_close(alone.evidence, motion.evidence[:1])
    alone.T_curr_prev.sum().backward()


@pytest.mark.gpu
def test_on_a_gpu(pairs) -> None:
    check(four_lines([p for p, _ in pairs], "cuda"), pairs)


@pytest.mark.slow
def test_gradients_reach_flow_depth_weights_and_maps(pairs) -> None:
    batch = hvo.PairBatch.from_pairs([pairs[0][0]], dtype=torch.float64)
    with torch.no_grad():
        maps = hvo.PWVO.from_pretrained()(batch)
    maps = replace(
        maps,
        motion=maps.motion.double(),
        log_scale=maps.log_scale.double(),
        evidence=maps.evidence.double(),
    )
    C = torch.randn(
        4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    values = {
        "flow": batch.flow,
        "depth_prev": torch.nan_to_num(batch.depth_prev, 0.0),
        "log_scale": maps.log_scale,
    }

    def loss(flow, depth_prev, log_scale):
        changed = hvo.PairBatch(flow, depth_prev, batch.K_prev, batch.K_curr)
        seed = hvo.select(replace(maps, log_scale=log_scale))
        motion = hvo.refine(changed, seed, noise=(0.3, 0.02))
        return (C * motion.T_curr_prev[0]).sum()

    leaves = {k: v.clone().requires_grad_() for k, v in values.items()}
    gradients = torch.autograd.grad(loss(**leaves), list(leaves.values()))
    generator = torch.Generator().manual_seed(1)
    for name, gradient in zip(values, gradients, strict=True):
        d = torch.randn(gradient.shape, dtype=torch.float64, generator=generator)
        sides = [
            loss(**(leaves | {name: values[name] + e * d})).item()
            for e in (1e-5, -1e-5)
        ]
        slope = (sides[0] - sides[1]) / 2e-5
        assert float((gradient * d).sum()) == pytest.approx(slope, rel=1e-3), name


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of torch's compiler
def test_compiled_programs_may_call_them(pairs) -> None:
    batch = hvo.PairBatch.from_pairs([pairs[0][0]])
    network = hvo.PWVO.from_pretrained().requires_grad_(False)

    def lines(batch: hvo.PairBatch):
        seed = hvo.select(network(batch))
        return hvo.refine(batch, seed)

    found = torch.compile(lines, backend="eager")(batch)
    expected = lines(batch)
    assert torch.equal(found.T_curr_prev, expected.T_curr_prev)
    assert torch.equal(found.probability, expected.probability)


# --- the probability ------------------------------------------------------------------------------


def bonnet(fraction: float) -> hvo.FramePair:
    """A hall whose lower part is covered by what stands still before the camera, at 1.5 m.

    Its flow errs by 0.05 px: agreement is measured in standard deviations, which
    exact flow would leave at nothing but rounding.
    """
    pair, _ = worlds.world(SIZE)
    noise = 0.05 * np.random.default_rng(0).standard_normal((*SIZE, 2))
    covered = np.zeros(SIZE, bool)
    covered[int((1 - fraction) * SIZE[0]) :] = True
    prev, curr = (
        replace(frame, depth=np.where(covered, np.float32(1.5), frame.depth))
        for frame in (pair.prev, pair.curr)
    )
    still = np.where(covered[..., None], np.float32(0), pair.flow)
    flow = (still + noise).astype(np.float32)
    return hvo.FramePair(prev, curr, flow)


@pytest.mark.slow
def test_the_four_lines_state_the_probability_of_the_method(pairs) -> None:
    several = [pairs[0][0], pairs[1][0], bonnet(0.5)]
    motion = four_lines(several)
    for k, pair in enumerate(several):
        alone = hvo.estimate(pair, method="pwvo-refine")
        if alone.status.reason is Reason.CONTRADICTED:
            # a single pair alone is held against its images and depth maps
            assert alone.probability < motion.probability[k]
            continue
        assert float(motion.probability[k]) == pytest.approx(
            alone.probability, abs=1e-4
        )
        assert motion.status[k] == alone.status
        # what the lines leave of a step is a hundredth of a standard deviation
        assert motion.one(k).evidence == pytest.approx(alone.evidence, abs=1e-3)


def test_the_probability_is_calibrated_by_what_calibration_says(pairs) -> None:
    """1 / (1 + exp(-w . evidence)) by hand, and not the share of the rival's weight."""
    motion = hvo.estimate(pairs[0][0], method="pwvo-refine")
    lead, agreed = motion.evidence
    z = lead + 0.25 * agreed
    assert motion.probability == pytest.approx(1 / (1 + math.exp(-z)), abs=1e-9)
    # nothing agrees with a motion so little that the network is no surer of it than of another
    batch = hvo.PairBatch.from_pairs([pairs[0][0]])
    seed = hvo.select(hvo.PWVO.from_pretrained()(batch))
    unsure = hvo.refine(
        batch, seed._replace(evidence=torch.full((1, 4), torch.nan))
    )
    assert float(unsure.probability[0]) < 0.75
    assert unsure.status[0].reason is hvo.Reason.AMBIGUOUS_MOTION


@pytest.fixture
def calls(monkeypatch) -> dict[str, int]:
    """Counts calls of kornia's projection and pypose's exponential."""
    counts, name = {"project": 0, "Exp": 0}, "denormalize_points_with_intrinsics"
    project, exp = getattr(torch_geometry, name), pp.LieTensor.Exp

    def counted(name, function):
        def call(*arguments, **named):
            counts[name] += 1
            return function(*arguments, **named)

        return call

    assert project is getattr(kornia.geometry.conversions, name)
    monkeypatch.setattr(torch_geometry, name, counted("project", project))
    monkeypatch.setattr(pp.LieTensor, "Exp", counted("Exp", exp))
    return counts


def test_kornia_and_pypose_carry_the_method(pairs, calls) -> None:
    motion = hvo.estimate(pairs[0][0], method="pwvo-refine")
    assert motion.usable and motion.method == "pwvo-refine"
    assert calls["project"] > motion.iterations
    # poses are pypose's, and so is the step that carries their gradient
    batch = hvo.PairBatch.from_pairs([pairs[0][0]])
    batch.flow.requires_grad_()
    before = calls["Exp"]
    found = hvo.refine(batch)
    assert isinstance(found.SE3, pp.LieTensor)
    assert calls["Exp"] == before + 1


def test_one_training_step_of_a_narrow_network_in_channels_last() -> None:
    """At the paper's size, where oneDNN wrote past its memory under strided 1x1 convolutions."""
    from hybridvo_lab.paper.inputs import assemble_inputs
    from hybridvo_lab.paper.networks import NetworkOptions, build_network

    torch.manual_seed(0)
    network = build_network(NetworkOptions(width=0.25)).to(
        memory_format=torch.channels_last
    )
    optimizer = torch.optim.SGD(network.parameters(), 1e-3)
    inputs = assemble_inputs(
        hvo.PairBatch.from_pairs(
            [make_pair("moving30", k, 128, 256)[0] for k in (0, 1)]
        )
    )
    before = [p.detach().clone() for p in network.parameters()]
    network(inputs).rotation.square().mean().backward()
    optimizer.step()
    assert all(torch.isfinite(p).all() for p in network.parameters())
    assert any(
        not torch.equal(a, b)
        for a, b in zip(before, network.parameters(), strict=True)
    )
