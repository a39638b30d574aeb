"""Samples of an inertial sensor, until a motion uses them."""

from __future__ import annotations

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.imu import with_earlier
from hybridvo.tracking.gyroscope import Gyroscope


def between(start: float, end: float) -> hvo.ImuSamples:
    """Samples of a sensor of 100 Hz that turns by 0.1 rad/s about x."""
    stamps = np.arange(round(100 * start), round(100 * end)) / 100
    return hvo.ImuSamples(stamps, np.tile([0.1, 0, 0], (len(stamps), 1)))


def test_samples_that_no_motion_has_used_are_those_of_the_last_minute() -> None:
    waiting = None
    for k in range(100):
        waiting = with_earlier(waiting, between(k, k + 1))
    assert waiting is not None
    assert 38 <= waiting.stamps[0] <= 40
    assert waiting.stamps[-1] == 99.99


def test_what_comes_late_or_twice_is_left_out() -> None:
    joined = with_earlier(between(5, 6), between(5.9, 6.5))
    assert joined is not None
    np.testing.assert_array_equal(joined.stamps, between(5, 6.5).stamps)


def test_a_clock_that_jumps_back_leaves_the_later_samples_alone() -> None:
    again = with_earlier(between(50, 51), between(5, 6))
    assert again is not None
    assert (again.stamps[0], again.stamps[-1]) == (5, 5.99)


def test_frames_without_samples_leave_what_there_is() -> None:
    some = between(5, 6)
    none = between(6, 6)
    assert with_earlier(None, None) is None
    assert with_earlier(some, None) is some
    assert with_earlier(None, some) is some
    assert with_earlier(some, none) is some
    assert with_earlier(none, some) is some


def test_a_gyroscope_goes_on_where_its_clock_starts_anew() -> None:
    gyroscope = Gyroscope().after(between(50, 51)).after(between(5, 6))
    prior = gyroscope.prior(5.0, 5.5, None)
    assert prior is not None
    assert prior.T_curr_prev[1, 2] == pytest.approx(0.05, abs=1e-3)
