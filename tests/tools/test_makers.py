"""Pairs by who made them, the weights of makers in a fit, and the parts of a start."""

from __future__ import annotations

import numpy as np
import pytest

from hybridvo import PWVO
from hybridvo.core.geometry import ego_flow
from hybridvo.network.pair_maps import look_at_pair
from hybridvo_lab.synthetic.noise_scenarios import make_pair
from hybridvo_lab.synthetic.paper_samples import KnownPair
from tests.scripts import load_script

makers = load_script("tools/maker_pairs.py")
sentence = load_script("tools/bench/pwvo_parts.py")


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
    return sentence.errors_of(known, sentence.static_part(known), look)
