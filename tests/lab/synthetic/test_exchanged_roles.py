"""Views of two parts: the truth is that of the images, and an exchange changes one cue alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow
from hybridvo.lab.synthetic import exchanged_roles
from hybridvo.lab.synthetic.exchanged_roles import (
    CUES,
    DrawnParts,
    TwoParts,
    draw_exchanged_roles,
    draw_frames,
    draw_two_parts,
    exchanged,
    known_pair,
    with_roles_exchanged,
)
from hybridvo.lab.training.hypothesis_samples import Makers, Shares, draw_samples


@pytest.fixture(scope="module")
def view() -> TwoParts:
    return draw_two_parts(np.random.default_rng(3), ())


def error_of_part(drawn: DrawnParts, motion: int, part: int) -> float:
    """Median difference of the flow over a part from that of a motion, px."""
    depth = np.where(drawn.depth > 0, drawn.depth, np.nan)
    camera = drawn.pair.prev.camera
    flow = ego_flow(depth, drawn.motions[motion], camera, camera)
    error = np.linalg.norm(drawn.pair.flow - flow, axis=2)
    mine = (drawn.part == part) & drawn.pair.flow_valid
    return float(np.nanmedian(error[mine]))


def test_each_part_moves_as_stated(view):
    for each in (view, with_roles_exchanged(view)):
        drawn = draw_frames(each)
        for part in (0, 1):
            own = error_of_part(drawn, part, part)
            assert own < 1.0  # DIS, and what bends
            assert error_of_part(drawn, 1 - part, part) > 2 * own


def test_exchanges_change_one_cue_alone(view):
    first, second = view.parts
    drawn = draw_frames(view)
    share = (drawn.part == 0).mean()
    assert share == pytest.approx(view.share, abs=0.03)

    smaller = draw_frames(exchanged(view, "size"))
    assert (smaller.part == 0).mean() == pytest.approx(1 - share, abs=0.05)

    at_border = draw_frames(exchanged(view, "border")).part
    assert drawn.part[0].mean() == pytest.approx(view.surrounding, abs=0.05)
    assert at_border[0].mean() == pytest.approx(1 - view.surrounding, abs=0.05)
    assert (at_border == 0).mean() == pytest.approx(share, abs=0.05)

    for each in (view, exchanged(view, "order")):
        here = draw_frames(each)
        edge = np.diff(here.part.astype(int), axis=1) != 0
        depth = np.where(here.depth > 0, here.depth, np.nan)
        # over the outline, the part in front is nearer
        rows, columns = np.nonzero(edge)
        left = (here.part[rows, columns], depth[rows, columns - 2])
        right = (here.part[rows, columns + 1], depth[rows, columns + 3])
        is_left = left[0] == each.front
        near = np.where(is_left, left[1], right[1])
        far = np.where(is_left, right[1], left[1])
        known = np.isfinite(near) & np.isfinite(far)
        assert np.mean(near[known] < far[known]) > 0.9

    for cue in ("picture", "sensor", "motion"):
        a, b = exchanged(view, cue).parts
        assert getattr(a, cue) is getattr(second, cue)
        assert getattr(b, cue) is getattr(first, cue)
        others = {"picture", "sensor", "motion"} - {cue}
        assert all(getattr(a, name) is getattr(first, name) for name in others)


def test_every_exchange_is_undone_by_a_second_one(view):
    for cue in CUES:
        twice = exchanged(exchanged(view, cue), cue)
        assert twice.share == pytest.approx(view.share)
        for name in ("surrounding", "front", "world"):
            assert getattr(twice, name) == getattr(view, name)
        assert all(
            getattr(a, name) is getattr(b, name)
            for a, b in zip(twice.parts, view.parts, strict=True)
            for name in ("picture", "sensor", "motion")
        )
    with pytest.raises(InputError, match="colour"):
        exchanged(view, "colour")


def test_with_the_roles_exchanged_the_thing_stands_still(view):
    """Each part keeps its picture and sensor, and the other one is the world."""
    other = with_roles_exchanged(view)
    assert other.world == 1 - view.world
    assert all(
        a.picture is b.picture and a.sensor is b.sensor
        for a, b in zip(view.parts, other.parts, strict=True)
    )
    assert other.parts[other.world].motion is view.parts[view.world].motion
    drawn = draw_frames(other)
    known = known_pair(other)
    np.testing.assert_array_equal(known.moving, drawn.part != other.world)
    np.testing.assert_array_equal(known.T_curr_prev, drawn.motions[other.world])


def test_each_part_has_its_own_sensor(view):
    quiet = view.parts[0].sensor._replace(noise=0.0, blur_px=0.0)
    loud = quiet._replace(noise=40.0)
    first, second = view.parts
    parts = (replace(first, sensor=quiet), replace(second, sensor=loud))
    calm = (parts[0], replace(second, sensor=quiet))
    noisy, plain = (
        draw_frames(replace(view, parts=some)) for some in (parts, calm)
    )
    change = np.abs(
        noisy.pair.prev.rgb.astype(float) - plain.pair.prev.rgb.astype(float)
    ).mean(axis=2)
    assert change[noisy.part == 1].mean() > 10
    assert change[noisy.part == 0].max() <= 1


def test_what_says_nothing_of_the_role_is_drawn_independently_of_it(monkeypatch):
    """The world has no habit in its sensor; in its place it has one."""
    monkeypatch.setattr(exchanged_roles, "_draw_picture", lambda *args: None)
    views = [draw_two_parts(np.random.default_rng(k), ()) for k in range(600)]
    louder = [
        v.parts[v.world].sensor.noise > v.parts[1 - v.world].sensor.noise
        for v in views
    ]
    assert np.mean(louder) == pytest.approx(0.5, abs=0.07)  # 3 sigma of 600
    assert np.mean([v.world for v in views]) == pytest.approx(0.5, abs=0.07)
    behind = np.mean([v.front != v.world for v in views])
    assert behind == pytest.approx(1 - exchanged_roles.BEHIND_FRACTION, abs=0.06)
    shares = [v.share if v.world else 1 - v.share for v in views]
    assert np.mean(np.array(shares) > 0.55) > 0.4


def test_a_share_of_the_samples_has_exchanged_roles(monkeypatch):
    module = "hybridvo.lab.training.hypothesis_samples"
    drawn = []

    def counted(rng, recordings, flow):
        drawn.append(len(recordings))
        return draw_exchanged_roles(rng, recordings, flow)

    monkeypatch.setattr(f"{module}.draw_exchanged_roles", counted)
    shares = Shares(tripod=0.0, semi_real=0.0, exchanged=1.0)
    samples = draw_samples(1, Makers(shares=shares))
    assert drawn == [0]
    assert len(samples) <= 2
    labels = [sample["label"] for sample in samples]
    assert all((label == 0).any() and (label == 1).any() for label in labels)
