"""What the tool says of scores that read the role, the appearance, or one cue alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hybridvo import PWVO
from hybridvo.lab.synthetic.exchanged_roles import (
    TwoParts,
    draw_frames,
    draw_two_parts,
)
from tests.scripts import load_script

tool = load_script("tools/bench/exchanged_roles.py")


@pytest.fixture(scope="module")
def view() -> TwoParts:
    return draw_two_parts(np.random.default_rng(3), ())


def summary(view: TwoParts, score: Callable[[TwoParts, int], float]) -> dict:
    """The summary of a view whose parts are scored so."""
    row = {
        name: score(each, view.world) - score(each, 1 - view.world)
        for name, each in tool.variants_of(view).items()
    }
    return tool.summary_of([row, row])


def test_a_score_that_reads_one_cue(view):
    found = summary(view, lambda each, part: 3.0 * (each.surrounding == part))
    assert found["cues"]["border"]["share"] == 1
    assert found["stays_with_appearance"] == 0
    assert found["sign_changes"]["count"] == 2


def test_a_score_that_reads_the_appearance(view):
    found = summary(view, lambda each, part: each.parts[part].sensor.noise)
    assert found["cues"]["sensor"]["share"] == 1
    assert found["stays_with_appearance"] == 1
    assert found["sign_changes"]["count"] == 0


def test_a_score_that_reads_both(view):
    """Three nats by the place, one by the picture: a quarter stays with the picture."""
    picture = view.parts[0].picture

    def score(each: TwoParts, part: int) -> float:
        is_behind = each.front != part
        return 3.0 * is_behind + 1.0 * (each.parts[part].picture is picture)

    found = summary(view, score)
    assert found["stays_with_appearance"] == pytest.approx(0.25)
    assert found["cues"]["order"]["share"] == pytest.approx(0.75)
    assert found["cues"]["picture"]["share"] == pytest.approx(0.25)
    assert found["cues"]["size"]["share"] == 0


def test_a_missing_motion_leaves_out_its_cue_alone(view):
    row = {name: 1.0 for name in tool.variants_of(view)}
    without = {name: value for name, value in row.items() if name != "size"}
    found = tool.summary_of([row, without])
    assert found["cues"]["size"]["views"] == 1
    assert found["cues"]["order"]["views"] == 2
    assert tool.summary_of([])["views"] == 0


def test_the_difference_of_a_pair_changes_its_sign_with_the_part(view):
    sensor = view.parts[0].sensor._replace(noise=1.0, blur_px=0.0, contrast=1.0)
    parts = tuple(replace(part, sensor=sensor) for part in view.parts)
    drawn = draw_frames(replace(view, parts=parts, share=0.5))
    network = PWVO.from_pretrained()
    first, second = (tool.score_difference(network, drawn, part) for part in (0, 1))
    assert first is not None
    assert first == pytest.approx(-second)
