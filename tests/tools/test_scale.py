"""The benchmark of long comparisons writes the files of a real one."""

from __future__ import annotations

import pytest

from tests.scripts import load_script

pytest.importorskip("plotly")
scale = load_script("tools/bench/scale.py")


@pytest.mark.slow
def test_the_report_grows_with_the_table() -> None:
    small = scale.write_tables(600)
    assert 0 < small < scale.write_tables(1800)
