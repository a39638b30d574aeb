"""PWVO on whole pairs and batches: the same maps, missing data, priors, gradients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import logit

from hybridvo.api import refine
from hybridvo.core.errors import InputError
from hybridvo.core.options import Options, SelectOptions
from hybridvo.core.results import MotionPrior, StageFailed
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.select import ChoiceEvidence
from hybridvo.judge.probability import choice_probability
from hybridvo.network.pair_maps import look_at_pair, predict_pairs
from hybridvo.network.pwvo import PWVO
from hybridvo.network.selection import INVALID_LOG_SCALE, select
from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair
from tests import worlds

SCENARIO = Scenario(moving=0.6, objects=1, flow_noise_px=0.3, depth_noise=0.01)
SIZE = (96, 224)
SIGMA = np.diag([0.02**2] * 3 + [0.004**2] * 3)
MAPS = ("motion", "log_scale", "evidence")


@pytest.fixture(scope="module")
def network() -> PWVO:
    return PWVO.from_pretrained()


@pytest.fixture(scope="module")
def known() -> list[tuple[FramePair, dict]]:
    return [make_pair(SCENARIO, seed, *SIZE) for seed in (1, 4)]


@pytest.fixture(scope="module")
def pairs(known) -> list[FramePair]:
    return [pair for pair, _ in known]


def without(pair: FramePair, frame: str, name: str) -> FramePair:
    """A pair of which a frame lacks something."""
    changed = replace(getattr(pair, frame), **{name: None})
    return replace(pair, **{frame: changed})


def test_a_pair_and_a_batch_of_it_give_the_same(network, pairs) -> None:
    batch = PairBatch.from_pairs(pairs, dtype=torch.float64)
    with torch.no_grad():
        together = network(batch)
        for k, pair in enumerate(pairs):
            alone = network(pair)
            for name in MAPS:
                some = getattr(together, name)[k : k + 1]
                torch.testing.assert_close(some, getattr(alone, name))
            assert alone.image_size == together.image_size == SIZE
    count, channels, h, w = together.motion.shape
    assert (count, channels) == (2, 6) and together.evidence.shape == (2, 4)
    # the grid of the search
    stride = round(SIZE[0] / h)
    assert (h, w) == (SIZE[0] // stride, SIZE[1] // stride)


def test_the_maps_are_those_of_the_surest_hypothesis(network, pairs) -> None:
    with torch.no_grad():
        look = look_at_pair(network, pairs[0])
        maps = network(pairs[0])
        again = network.maps(network.look(look.inputs))
    assert len(look.inputs.owner) == 1
    torch.testing.assert_close(look.prediction.motion, maps.motion)
    torch.testing.assert_close(look.prediction.evidence, maps.evidence)
    # the hypothesis alone has no rivals: its maps are near, not the same
    assert again.motion.shape == maps.motion.shape
    # a pixel without flow or depth says nothing
    uncertain = maps.log_scale[0][:, ~look.inputs.usable[0]]
    assert (uncertain >= INVALID_LOG_SCALE).all()


@pytest.mark.parametrize("missing", ["depth", "flow", "everything"])
def test_a_pair_without_data_is_uncertain_and_changes_no_other(
    network, pairs, missing
) -> None:
    broken = pairs[1]
    if missing in ("depth", "everything"):
        broken = without(broken, "prev", "depth")
        broken = without(broken, "curr", "depth")
    if missing in ("flow", "everything"):
        broken = replace(broken, flow=np.full((*SIZE, 2), np.nan, np.float32))
    batch = PairBatch.from_pairs([pairs[0], broken], dtype=torch.float64)
    with torch.no_grad():
        maps = network(batch)
        alone = network(pairs[0])
    for name in MAPS:
        if name != "evidence":
            assert torch.isfinite(getattr(maps, name)).all(), name
        torch.testing.assert_close(getattr(maps, name)[:1], getattr(alone, name))
    assert (maps.motion[1] == 0).all() and maps.evidence[1].isnan().all()
    assert (maps.log_scale[1] >= INVALID_LOG_SCALE).all()
    seed = select(maps)
    assert torch.isfinite(seed.T_curr_prev).all()
    torch.testing.assert_close(seed.T_curr_prev[1].float(), torch.eye(4))
    motion = refine(batch, seed)
    assert not motion.status[1].usable


def test_pwvo_looks_at_the_images_of_a_batch(network) -> None:
    pair, _ = worlds.world(noise=(0.3, 0.01), movers=2)
    batch = PairBatch.from_pairs([pair], dtype=torch.float64)
    assert batch.rgb_prev is not None and batch.rgb_curr is not None
    with torch.no_grad():
        seen = network(batch)
        alone = network(pair)
        blind = network(replace(batch, rgb_prev=None, rgb_curr=None))
    torch.testing.assert_close(seen.log_scale, alone.log_scale)
    assert not torch.equal(seen.log_scale, blind.log_scale)


def test_a_prior_is_looked_at(network, known) -> None:
    pair, truth = known[0]
    prior = MotionPrior(truth["T_curr_prev"], SIGMA)
    with torch.no_grad():
        plain = predict_pairs(network, [pair, pair])
        both = predict_pairs(network, [pair, pair], [None, prior])
        look = look_at_pair(network, pair, prior)
    assert look.inputs.has_prior.all()
    expected = torch.as_tensor(truth["T_curr_prev"][:3], dtype=torch.float32)
    torch.testing.assert_close(look.inputs.T_prior[0], expected)
    torch.testing.assert_close(plain.motion[0], plain.motion[1])
    torch.testing.assert_close(both.motion[0], plain.motion[0])
    torch.testing.assert_close(both.log_scale[1:], look.prediction.log_scale)
    assert not torch.equal(both.log_scale[1], plain.log_scale[1])
    # what is expected to be true makes no other motion surer
    without, beside = (
        choice_probability(ChoiceEvidence(*maps.evidence[1].tolist()))
        for maps in (plain, both)
    )
    assert logit(beside) > logit(without) - 0.5


def test_options_and_seed_are_those_of_the_search(network, pairs) -> None:
    options = Options(select=SelectOptions(refits=0))
    with torch.no_grad():
        one, two = (
            predict_pairs(network, pairs[:1], options=options, seed=3)
            for _ in range(2)
        )
        refitted = predict_pairs(network, pairs[:1], seed=3)
    torch.testing.assert_close(one.motion, two.motion)
    assert not torch.equal(one.motion, refitted.motion)


def test_the_gradient_reaches_the_network_through_select_and_refine(pairs) -> None:
    network = PWVO.from_pretrained()
    maps = network(PairBatch.from_pairs(pairs))
    seed = select(maps)
    seed.T_curr_prev.square().sum().backward(retain_graph=True)
    for layer in (network.head_static, network.merge1, network.hypothesis):
        assert torch.isfinite(layer.weight.grad).all()
        assert layer.weight.grad.abs().max() > 0
    network.zero_grad()
    select(maps, "softmax").T_curr_prev.square().sum().backward(retain_graph=True)
    for head in (network.head_motion, network.head_uncertainty):
        assert torch.isfinite(head.weight.grad).all()
        assert head.weight.grad.abs().max() > 0
    network.zero_grad()
    motion = refine(PairBatch.from_pairs(pairs), seed.T_curr_prev, seed.weights)
    motion.T_curr_prev.square().sum().backward()
    # the scales of a hypothesis are a factor on all weights, which moves no motion
    for layer in (
        network.head_static,
        network.merge1,
        network.hypothesis,
        network.shared,
    ):
        assert torch.isfinite(layer.weight.grad).all()
        assert layer.weight.grad.abs().max() > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_pairs_of_a_batch_are_those_that_made_it(dtype) -> None:
    made = [worlds.world(seed=seed, noise=(0.2, 0.01))[0] for seed in (0, 1)]
    rng = np.random.default_rng(0)
    shape = made[0].prev.camera.shape
    for k, pair in enumerate(made):
        variance = rng.uniform(0.5, 2, shape).astype(np.float32)
        prev = replace(pair.prev, depth_variance=0.1 * variance)
        valid = rng.random(shape) < 0.9
        made[k] = replace(pair, prev=prev, flow_variance=variance, flow_valid=valid)
    batch = PairBatch.from_pairs(made, dtype=dtype)
    for pair, again in zip(made, batch.pairs(), strict=True):
        np.testing.assert_array_equal(again.flow, pair.flow)
        np.testing.assert_array_equal(again.flow_variance, pair.flow_variance)
        np.testing.assert_array_equal(again.flow_valid, pair.flow_valid)
        for name in ("prev", "curr"):
            one = getattr(pair, name)
            other = getattr(again, name)
            np.testing.assert_array_equal(other.rgb, one.rgb)
            np.testing.assert_array_equal(other.depth, one.depth)
            np.testing.assert_allclose(other.camera.K, one.camera.K, rtol=1e-6)
            assert other.camera.shape == one.camera.shape
        np.testing.assert_array_equal(
            again.prev.depth_variance, pair.prev.depth_variance
        )


# --- the images of a batch --------------------------------------------------------


def test_a_pair_keeps_its_images_beside_one_that_has_none() -> None:
    pair, _ = worlds.world()
    bare, _ = worlds.world(texture=False)
    half = without(pair, "curr", "rgb")
    for other in (pair, bare, half):
        batch = PairBatch.from_pairs([other, pair])
        assert batch.rgb_prev.dtype == batch.rgb_curr.dtype == torch.uint8
        assert batch.rgb_prev.shape == (2, *worlds.SIZE, 3)
        assert batch.has_images.tolist() == [other is pair, True]
        again = batch.pairs()
        assert again[0].has_images == (other is pair)
        np.testing.assert_array_equal(again[1].prev.rgb, pair.prev.rgb)
        np.testing.assert_array_equal(again[1].curr.rgb, pair.curr.rgb)
    for other in (bare, half):
        without_any = PairBatch.from_pairs([other, bare])
        assert without_any.rgb_prev is None and without_any.rgb_curr is None
        assert without_any.has_images is None


def test_images_of_another_shape_or_type_are_refused(network) -> None:
    pair, _ = worlds.world()
    batch = PairBatch.from_pairs([pair])
    for name in ("rgb_prev", "rgb_curr"):
        image = getattr(batch, name)
        for wrong in (image.float(), image[:, ::2], image[..., 0], image.bool()):
            bad = replace(batch, **{name: wrong})
            for use in (network, refine):
                with pytest.raises(InputError, match=f"{name} of shape.*uint8"):
                    use(bad)
        with pytest.raises(InputError, match=f"PairBatch.{name}.*tensor"):
            replace(batch, **{name: image.numpy()})
    for wrong in (torch.ones(2, dtype=torch.bool), torch.ones(1)):
        with pytest.raises(InputError, match=r"has_images of shape.*bool"):
            refine(replace(batch, has_images=wrong))


# --- the others of a batch --------------------------------------------------------


# of sums over pixels, and of what follows from them
ROUNDING = {torch.float32: 1e-4, torch.float64: 1e-9}


@pytest.fixture(scope="module")
def unlike() -> dict[str, FramePair]:
    """Pairs with few and with many motions, each of which has or lacks something else."""
    rng = np.random.default_rng(0)
    shape = worlds.SIZE
    seen, _ = worlds.world(noise=(0.3, 0.01), movers=2)
    noisy, _ = worlds.world(noise=(0.5, 0.03), seed=5)
    still, _ = worlds.world(seed=3, texture=False)
    moving, _ = make_pair("moving50", 510, *shape)
    few = seen.flow.copy()
    few[:, 14:] = np.nan
    uneven = rng.uniform(0.5, 2, shape).astype(np.float32)
    prev = replace(seen.prev, depth_variance=0.1 * uneven)
    no_depth = without(without(seen, "prev", "depth"), "curr", "depth")
    return {
        "images": seen,
        "no images, one motion": still,
        "no images, many motions": moving,
        "one image": without(seen, "curr", "rgb"),
        "no second depth": without(noisy, "curr", "depth"),
        "variances of the flow": replace(seen, flow_variance=uneven),
        "variances of depth": replace(seen, prev=prev),
        "a mask": replace(seen, flow_valid=rng.random(shape) < 0.9),
        "few pixels": replace(seen, flow=few),
        "no flow": replace(seen, flow=np.full_like(few, np.nan)),
        "no depth": no_depth,
    }


def motions_of(pair: FramePair) -> int:
    """How many motions the search finds."""
    try:
        found = generate(pair, np.eye(4)[None], Options())
    except StageFailed:
        return 0
    return len(found.motions)


def answer(
    network: PWVO, pairs: list[FramePair], dtype: torch.dtype
) -> dict[str, torch.Tensor]:
    """Everything that the maps, the selection and the refinement say of pairs."""
    batch = PairBatch.from_pairs(pairs, dtype=dtype)
    with torch.no_grad():
        maps = network(batch)
        seed = select(maps)
        motion = refine(batch, seed)
    said = {name: getattr(maps, name) for name in MAPS}
    for name in ("xi", "information", "share", "agreement"):
        said[f"patches, {name}"] = getattr(maps.patches, name)
    said["seed"] = seed.T_curr_prev
    said["seed, weights"] = seed.weights
    said["seed, covariance"] = seed.covariance
    for name in ("T_curr_prev", "covariance", "probability", "evidence", "noise"):
        said[name] = getattr(motion, name)
    return said


def assert_same(
    said: dict[str, torch.Tensor],
    k: int,
    alone: dict[str, torch.Tensor],
    rounding: float,
    kind: str,
) -> None:
    """Hold what is said of the pair k of a batch against what is said of it alone.

    Small numbers of a matrix are rounded with its largest.
    """
    for name, expected in alone.items():
        size = float(expected.abs().max()) + 1e-6
        away = float((said[name][k] - expected[0]).abs().max())
        assert away <= rounding * size, f"{kind}: {name}"


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_pair_says_the_same_whatever_is_beside_it(network, unlike, dtype) -> None:
    pairs = list(unlike.values())
    counts = [motions_of(pair) for pair in pairs]
    assert {0, 1, 2, 4} <= set(counts)
    together = answer(network, pairs, dtype)
    for k, (kind, pair) in enumerate(unlike.items()):
        assert_same(
            together, k, answer(network, [pair], dtype), ROUNDING[dtype], kind
        )
