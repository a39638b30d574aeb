"""What the tools that measure write, and the tables that are made of it."""

from __future__ import annotations

import pytest

from hybridvo_lab.evaluation import report
from hybridvo_lab.evaluation.protocols import protocols
from tests.scripts import ROOT, load_script


@pytest.fixture(autouse=True)
def _tools_import_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


def test_the_grid_of_limits_scores_every_limit():
    grid = load_script("tools/bench/thresholds.py")
    from hybridvo_lab.synthetic.noise_scenarios import make_pair

    pair, truth = make_pair("moving30", 1, 109, 256)
    limits = {grid.BY_NOISE: None, "1.5 px": 1.5, "60 px": 60.0}
    records = {"pnp-ransac-tuned": {name: [] for name in limits}}
    grid.answer(records, limits, pair, truth["T_curr_prev"], truth["depth_true"])
    summary = grid.summary(records)["pnp-ransac-tuned"]
    # this flow states no noise: three times half a pixel
    assert summary[grid.BY_NOISE]["epe_px"] == summary["1.5 px"]["epe_px"]
    assert (
        summary["60 px"]["epe_px"]["median"]
        > 3 * summary["1.5 px"]["epe_px"]["median"]
    )


def test_the_benchmark_scores_what_is_known():
    """One scenario, one pair: the refinement is right, and no motion is not."""
    benchmark = load_script("tools/bench/methods.py")
    from hybridvo_lab.synthetic.noise_scenarios import make_pair

    methods, _ = benchmark.estimators(("classical", "identity"))
    records: dict[str, list[dict]] = {method: [] for method in methods}
    pair, truth = make_pair("moving30", 1, 109, 256)
    benchmark.answer(
        records, methods, pair, truth["T_curr_prev"], truth["depth_true"]
    )
    assert records["classical"][0]["error"] < 0.2
    assert records["identity"][0]["failed"]
    row = benchmark.summarise(records["classical"] * 3)
    assert row["pairs"] == 3 and row["failures"]["count"] == 0
    # Wilson's interval of 0 of 3 at 95 %
    assert 0.5 < row["failures"]["high"] < 0.6


def test_the_parts_of_the_seed_are_worth_what_the_pages_say():
    """The parts of which pages say that they matter cost answers when they are left out."""
    sets = load_script("tools/make_docs.py").read(ROOT / "docs/results")
    sets = sets["pwvo_parts"]["sets"]

    def wrong(start: str) -> int:
        (name,) = (name for name in sets["heavy"]["rows"] if name.startswith(start))
        return sum(each["rows"][name]["wrong"]["count"] for each in sets.values())

    parts = ("uncertainty", "the covariance", "a seed")
    costs = {part: wrong(f"without {part}") - wrong("all parts") for part in parts}
    assert min(costs.values()) > 0, costs
    # the page says that the hypothesis is as good inside the region
    assert abs(wrong("without patch poses") - wrong("all parts")) <= 2


def test_the_papers_errors_have_one_unit_in_every_table():
    """The report sets our figures beside the published ones: centimetres beside metres mislead."""
    ours = {
        key: (label.split("[")[-1], factor) for key, label, factor in report.COLUMNS
    }
    published = protocols()["paper"].columns
    assert {key for key, _, _ in published} == {"epe", "r_err_deg", "t_err"}
    for key, label, factor in published:
        assert ours[key] == (label.split("[")[-1], factor), label
