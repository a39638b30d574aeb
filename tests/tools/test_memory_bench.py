"""What the benchmarks of the memory take for wrong, and what they count."""

from __future__ import annotations

from tests.scripts import load_script

memory = load_script("tools/bench/memory.py")


def test_steps_are_counted_by_whether_they_are_right_and_ok() -> None:
    steps = [
        memory.Judged(is_wrong=True, is_ok=True, has_flow=False, probability=0.95),
        memory.Judged(is_wrong=False, is_ok=False, has_flow=True, probability=0.5),
        memory.Judged(is_wrong=False, is_ok=True, has_flow=True, probability=0.99),
    ]
    assert memory.counted(steps) == {
        "steps": 3,
        "wrong": 1,
        "wrong_ok": 1,
        "right_not_ok": 1,
        "with_flow": 2,
        "auroc": 0.5,
    }
