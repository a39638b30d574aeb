"""What the benchmark of two recordings in one view counts."""

from __future__ import annotations

from typing import Any

from tests.scripts import load_script

benchmark = load_script("tools/bench/two_recordings.py")


def row(
    clip: int, role: int, moving: float, of: str, p: float, *, known: bool = True
) -> dict[str, Any]:
    answer = {
        "px": 0.1,
        "wrong": of != "world",
        "status": "ok" if p > 0.9 else "degraded",
        "probability": p,
        "of": of,
        "ms": 20.0,
    }
    return {
        "clip": clip,
        "role": role,
        "step": 1,
        "moving": moving,
        "known": known,
        "method": answer,
    }


def test_steps_are_counted_by_how_much_of_the_view_moves() -> None:
    rows = [
        row(0, 0, 0.3, "world", 0.95),
        row(0, 1, 0.6, "thing", 0.95, known=False),
        row(1, 0, 0.4, "neither", 0.5),
        row(1, 1, 0.01, "thing", 0.95),
    ]
    summary = benchmark.summarise(rows, "method")
    below, above = summary["below half"], summary["above half"]
    assert (below["wrong"]["count"], below["wrong"]["of"]) == (1, 2)
    assert (below["wrong_ok"]["count"], above["wrong_ok"]["count"]) == (0, 1)
    assert (below["of_the_thing"]["count"], above["of_the_thing"]["count"]) == (
        0,
        1,
    )
    assert below["clips_with_wrong"]["count"] == 1
    assert summary["scene along the border"]["wrong"]["of"] == 2


def test_probabilities_of_a_recording_in_both_roles_sum_to_one() -> None:
    """Fair where the judge says the same of the world, whichever recording that is."""
    rows = [
        row(0, 0, 0.5, "world", 0.9),
        row(0, 1, 0.5, "thing", 0.2),
        row(1, 0, 0.5, "world", 0.9),
        row(1, 1, 0.5, "thing", 0.9),
        row(2, 0, 0.5, "world", 0.9),
        row(2, 1, 0.5, "neither", 0.9),
    ]
    found = benchmark.role_figures(rows, "method")["sum_to_one"]
    assert (found["count"], found["of"]) == (1, 2)
