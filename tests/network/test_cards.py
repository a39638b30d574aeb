"""Cards of the weights in the package: the commit and the figures that they state."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hybridvo.network.weights import pretrained, weights_file

ROOT = Path(__file__).resolve().parents[2]
NAMES = sorted(pretrained())


def card_of(name: str) -> dict:
    return json.loads(weights_file(name).with_suffix(".json").read_text("utf-8"))


def test_cards_have_the_figures_of_the_page() -> None:
    """On the paper's data alone; the scenes of the diverse data change with the package."""
    results = ROOT / "docs" / "results" / "ablation.json"
    content = json.loads(results.read_text(encoding="utf-8"))
    zero = content["zero"]["data_paper"]
    rows = {run["row"]: run for run in content["runs"] if run["seed"] == 0}
    for name in set(NAMES) - {"pwvo"}:
        held_out = card_of(name)["held_out"]
        assert set(held_out) == {"data_paper"}, name
        figures = held_out["data_paper"]
        page = rows[name]["curve"][str(content["samples"])]["data_paper"]
        for key in ("epe", "r_err_deg", "t_err"):
            # the page has four digits
            assert figures[f"zero_{key}"] == pytest.approx(zero[key], rel=1e-3)
            # the card is of the rounded weights; 8 bits change a figure by up to 1.1 %
            assert figures[key] == pytest.approx(page[key], rel=2e-2), (name, key)
