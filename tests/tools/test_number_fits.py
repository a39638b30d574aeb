"""What a number is worth: losses, and the value that other makers would choose."""

from __future__ import annotations

import pytest

from tests.scripts import load_script

fits = load_script("tools/number_fits.py")
Row = fits.Row


def test_a_step_counts_by_how_it_ends():
    steps = [
        (0.08, 1.5, True),  # right
        (0.08, 1.5, False),  # right, and doubted
        (9.0, 1.98, True),  # wrong and ok
        (9.0, 1.98, False),  # wrong and told so
    ]
    row = fits.row_of(steps)
    assert row[:4] == (4, 1, 1, 1)
    # geometric mean of .1, .1, 2, 2: errors beyond the limit are no worse than it
    assert row.error_px == pytest.approx((0.1 * 0.1 * 2 * 2) ** 0.25)
    assert row.loss(row.error_px) == pytest.approx((1 + 0.5 + 0.25) / 4)
    # a tenth for each doubling of the error
    assert row.loss(row.error_px / 4) - row.loss(row.error_px) == pytest.approx(0.2)


def test_the_odds_of_a_fraction_change_and_not_the_fraction():
    assert fits.factor_of_odds(0.3, 3.0) == 3.0
    assert fits.factor_of_odds(12, 3.0) == 3.0
    # odds of .9 are 9; three times that is 27 / 28
    assert 0.9 * fits.factor_of_odds(0.9, 3.0) == pytest.approx(27 / 28)


def test_what_the_others_choose_is_judged_on_the_maker_left_out():
    good = Row(10, 0, 0, 0, 0.1)
    bad = Row(10, 5, 0, 0, 0.1)
    rows = {
        fits.AS_IT_IS: {"a": bad, "b": bad, "c": good},
        "x 3.00": {"a": good, "b": good, "c": bad},
    }
    found = fits.summary(rows)
    assert found["best"] == "x 3.00"
    assert found["moves"] == ["a", "b", "c"]
    # a and b would choose it for c, which pays for it; a and c, b and c are undecided
    assert found["left out, another is chosen"] == {"c": "x 3.00: +0.500"}


def test_a_number_in_a_kernel_is_said_to_be_there():
    row = Row(10, 0, 0, 0, 0.1)
    assert fits.summary({fits.AS_IT_IS: {"a": row}}) == {"frozen": True}
