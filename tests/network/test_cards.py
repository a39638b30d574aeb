"""Cards of the weights in the package: the commit and the figures that they state."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest
from safetensors import safe_open

from hybridvo.network.weights import pretrained, weights_file

ROOT = Path(__file__).resolve().parents[2]
NAMES = sorted(pretrained())


def card_of(name: str) -> dict:
    return json.loads(weights_file(name).with_suffix(".json").read_text("utf-8"))


def source_at(commit: str) -> str:
    """The sources of the networks at a commit; skip without the history."""
    command = ["git", "-C", str(ROOT), "grep", "-h", "", commit, "--"]
    try:
        known = subprocess.run(
            ["git", "-C", str(ROOT), "cat-file", "-e", f"{commit}^{{commit}}"],
            capture_output=True,
        )
    except OSError:
        pytest.skip("git is not installed")
    if known.returncode:
        shallow = subprocess.run(
            ["git", "-C", str(ROOT), "rev-parse", "--is-shallow-repository"],
            capture_output=True,
            text=True,
        )
        if shallow.stdout.strip() != "false":
            pytest.skip("the history is not here, or not whole")
        pytest.fail(f"{commit}: no such commit")
    return subprocess.run(
        [*command, "hybridvo/network/*.py"], capture_output=True, text=True
    ).stdout


@pytest.mark.parametrize("name", NAMES)
def test_the_commit_of_a_card_contains_its_network(name: str) -> None:
    with safe_open(weights_file(name), framework="pt") as file:
        kind = json.loads(file.metadata()["options"])["kind"]
        modules = {key.split(".")[0] for key in file.keys()}
    source = source_at(card_of(name)["commit"])
    assert f'"{kind}"' in source
    absent = [m for m in modules if not re.search(rf"\bself\.{m}\b", source)]
    assert not absent


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
