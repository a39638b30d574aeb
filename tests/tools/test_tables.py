"""What the tools that measure write, and the tables that are made of it."""

from __future__ import annotations

import re

import pytest

from hybridvo.lab.evaluation import report
from hybridvo.lab.evaluation.protocols import protocols
from tests.scripts import ROOT, load_script


@pytest.fixture(autouse=True)
def _tools_import_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


def test_a_table_that_varies_the_limit_names_the_best_of_the_grid():
    made = load_script("tools/make_docs.py")
    results = made.read(ROOT / "docs/results")

    def row(failures: int, median: float, ate_cm: float) -> dict:
        return {
            "pairs": 4,
            "failures": {"count": failures},
            "epe_px": {"median": median},
            "ate_cm": ate_cm,
        }

    # by its truth 1 px is the best of the grid; 0.1 px is better, and is not of the grid
    limits = {
        "0.1 px": row(0, 0.01, 0.1),
        "0.5 px": row(2, 0.02, 0.6),
        "1 px": row(1, 0.04, 0.5),
        "2 px": row(1, 0.05, 0.7),
    }
    results["benchmark"]["thresholds"] = results["benchmark"]["heavy"] | {
        "grid_px": [0.5, 1.0, 2.0],
        "heavy": {"poselib": limits},
        "demo": {"poselib": limits},
    }
    tables = made.tables(results)
    assert "`poselib` 0.04 px, 25 % wrong (1 px)." in made.table(tables, "peers")
    assert "`poselib` 0.5 cm (1 px)." in made.table(tables, "demo")


def test_the_grid_of_limits_scores_every_limit():
    grid = load_script("tools/bench/thresholds.py")
    from hybridvo.lab.synthetic.noise_scenarios import make_pair

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
    from hybridvo.lab.synthetic.noise_scenarios import make_pair

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


def test_every_table_of_the_papers_errors_has_a_row_of_zero_motion():
    """Standing still is the floor: at a small budget translation is hardly learned."""
    made = load_script("tools/make_docs.py")
    paper = (ROOT / "docs/paper.md").read_text(encoding="utf-8")
    without_errors = ("paper_claims", "paper_uncertainty", "paper_saliency")
    tables = {m[2]: m[3] for m in made.PART.finditer(paper)}
    for name, text in tables.items():
        if not name.startswith(without_errors):
            assert re.search(r"^\| zero motion.*\d", text, re.MULTILINE), name
    # of the same pairs, as the scoring of the rows wrote them
    full = tables["paper_rows ablation_full"]
    assert "| zero motion | - | - | - | 3.34 | 0.485 | 0.0796 |" in full


def test_the_papers_errors_have_one_unit_in_every_table():
    """The report sets our figures beside the published ones: centimetres beside metres mislead."""
    ours = {
        key: (label.split("[")[-1], factor) for key, label, factor in report.COLUMNS
    }
    published = protocols()["paper"].columns
    assert {key for key, _, _ in published} == {"epe", "r_err_deg", "t_err"}
    for key, label, factor in published:
        assert ours[key] == (label.split("[")[-1], factor), label


def test_the_maker_with_the_largest_share_of_sure_errors_comes_first() -> None:
    made = load_script("tools/make_docs.py")

    def pairs(wrong: int, wrong_ok: int, count: int) -> dict:
        nothing = {"count": 0, "of": 0}
        row = {
            "wrong": {"count": wrong, "of": count},
            "wrong_static": nothing,
            "wrong_ok": {"count": wrong_ok, "of": wrong},
            "right_not_ok": {"count": 3, "of": count - wrong},
            "right_not_ok_static": nothing,
        }
        return {"hybrid": row}

    step = {"steps": 10, "wrong": 2, "wrong_ok": 1, "right_not_ok": 1}
    results = {
        "makers": {"makers": {"easy": pairs(5, 0, 60), "hard": pairs(9, 9, 60)}},
        "semi_real": {"summary": pairs(4, 4, 400)},
        "memory": {"clips": [step | {"recording": "film", "memory": "auto"}]},
        "memory_unseen": {"rows": [step | {"recording": "film", "memory": "off"}]},
    }
    rows = made.sureness(results)
    assert [row.maker for row in rows] == [
        "hard, pairs",
        "film, tracked",
        "pieces of other recordings, pairs",
        "easy, pairs",
    ]
    assert rows[0][1:] == (60, 9, 9, 3)
