"""Pairs by who made them, the weights of makers in a fit, and the parts of a start."""

from __future__ import annotations

import numpy as np
import pytest

from hybridvo import PWVO
from hybridvo.core.geometry import ego_flow
from hybridvo.lab.synthetic.noise_scenarios import make_pair
from hybridvo.lab.synthetic.paper_samples import KnownPair
from hybridvo.network.pair_maps import look_at_pair
from tests.scripts import load_script

makers = load_script("tools/maker_pairs.py")
calibrate = load_script("tools/calibrate.py")
sentence = load_script("tools/bench/pwvo_parts.py")
wide = load_script("tools/bench/wide_steps.py")


@pytest.mark.parametrize("flow", ["true", "dis"])
def test_pairs_of_an_escalator_have_their_truth(flow: str) -> None:
    known = next(iter(makers.scene_pairs("escalator", range(3, 4), flow)))
    pair = known.pair
    assert pair.flow is not None and pair.flow_is_true == (flow == "true")
    assert 0.3 < known.moving.mean() < 0.7
    cameras = (pair.prev.camera, pair.curr.camera)
    truth = ego_flow(known.depth, known.T_curr_prev, *cameras)
    error = np.linalg.norm(pair.flow - truth, axis=2)
    static = ~known.moving & np.isfinite(error)
    assert np.median(error[static]) < (1e-3 if flow == "true" else 0.3)
    assert np.nanmedian(error[known.moving]) > 1


def test_no_maker_serves_twice() -> None:
    """Names of those for calibration and for tests may be alike, their pairs are not."""
    assert set(makers.CALIBRATION) - set(makers.TEST)
    names = [*makers.CALIBRATION, *makers.TEST]
    assert all(name for name in names)
    first, second = (
        next(iter(chosen["heavy"](None, 1)))
        for chosen in (makers.CALIBRATION, makers.TEST)
    )
    assert np.abs(first.T_curr_prev - second.T_curr_prev).max() > 1e-6


def test_every_maker_counts_alike() -> None:
    shares = calibrate.maker_weights(["a"] * 8 + ["b"] * 2)
    assert shares.mean() == pytest.approx(1)
    assert shares[:8].sum() == pytest.approx(shares[8:].sum())


def test_shares_move_a_fit_to_the_rare_maker() -> None:
    evidence = np.linspace(-2, 2, 40)[:, None]
    right = evidence[:, 0] > 0.5
    right[:3] = True
    is_rare = np.arange(40) < 3
    plain = calibrate.fit(evidence, right)
    shared = calibrate.fit(evidence, right, np.where(is_rare, 8.0, 0.5))
    assert shared[0] < plain[0]


def test_figures_of_a_wide_step() -> None:
    answers = [
        wide.Answer(True, True, 1.0),
        wide.Answer(False, True, 2.0),
        wide.Answer(True, False, 3.0),
        wide.Answer(False, False, 4.0),
    ]
    row = wide.figures(answers)
    assert row["right"]["count"] == 2 and row["right"]["of"] == 4
    assert row["wrong_ok"] == 1 and row["right_not_ok"] == 1


def test_every_part_of_the_seed_has_a_row(seeds_of_a_pair) -> None:
    summary = sentence.summary_of([seeds_of_a_pair, seeds_of_a_pair])
    assert set(summary["rows"]) == set(sentence.ROWS)
    rows = summary["rows"]
    assert rows["all parts"]["wrong"]["of"] == 2
    # what the patches know is worth more than their mean
    mean = rows["without uncertainty: mean of the patch poses"]
    assert rows["all parts"]["start_px"] < mean["start_px"]
    assert rows["all parts"]["median_px"] < 0.3
    assert -1 <= summary["rank_correlation"] <= 1
    assert summary["fused_nearer"]["of"] == 2


@pytest.fixture
def seeds_of_a_pair() -> dict:
    pair, truth = make_pair("moving30", 3, 120, 160)
    T = np.asarray(truth["T_curr_prev"], float)
    known = KnownPair(pair, T, truth["depth_true"], truth["moving"])
    look = look_at_pair(PWVO.from_pretrained(), pair)
    assert look is not None
    return sentence.errors_of(known, sentence.static_part(known), look)
