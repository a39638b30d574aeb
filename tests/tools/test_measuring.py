"""A measurement that was stopped goes on where it was, unless something decisive changed."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.scripts import load_script

measured = load_script("tools/measuring.py").measured
ITEMS = {"one": 1, "two": 2, "three": 3}


def doubled(log: list[int], refused: int, number: int) -> int:
    if number == refused:
        raise OSError("interrupted")
    log.append(number)
    return 2 * number


@pytest.mark.parametrize(("seed", "again"), [(0, [3]), (1, [1, 2, 3])])
def test_results_are_not_measured_again(
    seed: int, again: list[int], tmp_path: Path, capsys: Any
) -> None:
    args = Namespace(out=tmp_path / "found.json", jobs=1, cluster=None, seed=0)
    log: list[int] = []
    with pytest.raises(OSError, match="interrupted"):
        measured(args, "part", partial(doubled, log, 3), ITEMS)
    assert log == [1, 2]
    log.clear()
    args.seed = seed
    found = measured(args, "part", partial(doubled, log, 0), ITEMS)
    assert found == {"one": 2, "two": 4, "three": 6}
    assert log == again
    assert ("begun anew" in capsys.readouterr().err) == bool(seed)
    assert not list(tmp_path.iterdir())
