"""The ablation: rows as the paper has them, one budget, nothing trained twice."""

from __future__ import annotations

import dataclasses
import importlib
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from hybridvo.errors import InputError
from hybridvo.geometry import invert, matrix_to_euler_deg
from hybridvo.network.losses import LossOptions, LossTargets, reconstruct, total_loss
from hybridvo.network.options import NetworkOptions
from hybridvo.synthetic.paper import PaperOptions
from hybridvo.synthetic.render import make_scene, write_sintel
from hybridvo.training import ablation
from hybridvo.training.options import TrainingOptions, load_training_options
from hybridvo.training.stream import Mixture, sample_generator

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT.parent / "shared" / "reference" / "pwvo.md"
RECIPE = """
network: {width: 0.1, head_stride: 2, scale_free: true}
loss: {flow_uncertainty: false, depth_uncertainty: false, flow_weight: 2.0, flow_limit_px: 10.0}
loss_stride: 2
data: [data_paper.yaml]
batch_size: 4
ema_decay: 0.9
moving_weight: 0.5
schedule: {by: time}
"""

# As printed in the paper, typed from it: EPE, R_err, T_err.
PRINTED = {
    "Table 1: main": [
        ("VONet", 0.909, 0.110, 0.061),
        ("VONet + self-att.", 0.894, 0.117, 0.076),
        ("PWVO (naive)", 0.829, 0.091, 0.061),
        ("PWVO", 0.626, 0.081, 0.043),
    ],
    "Table 2: components, cumulative": [
        ("VONet", 0.909, 0.110, 0.061),
        ("+ pixel-wise", 1.07, 0.106, 0.055),
        ("+ U^R + U^T (= naive)", 0.829, 0.091, 0.061),
        ("+ U^D + U^F", 0.766, 0.087, 0.062),
        ("+ selection module (= PWVO)", 0.626, 0.081, 0.043),
    ],
    "Table 3: with and without L^F": [
        ("VONet, with", 0.909, 0.110, 0.061),
        ("VONet, without", 1.276, 0.113, 0.069),
        ("VONet + self-att., with", 0.894, 0.117, 0.076),
        ("VONet + self-att., without", 1.312, 0.118, 0.065),
        ('"PWVO" (the naive model), with', 0.829, 0.091, 0.061),
        ('"PWVO" (the naive model), without', 1.241, 0.144, 0.095),
    ],
}


def tool(name: str):
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)


@pytest.fixture(scope="module")
def report():
    return tool("ablation_report")


@pytest.fixture(scope="module")
def recipe(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recipe")
    for preset in ("paper", "wide"):
        text = f"preset: {preset}\nheight: 32\nwidth: 64\n"
        (folder / f"data_{preset}.yaml").write_text(text)
    (folder / "base.yaml").write_text(RECIPE)
    return folder / "base.yaml"


@pytest.fixture(scope="module")
def main():
    """The tool in this process, with its own threads left as they were."""
    module = tool("ablation")

    def run(*argv: object) -> int:
        sys.path.insert(0, str(ROOT / "tools"))
        threads = torch.get_num_threads()
        try:
            return module.main([str(arg) for arg in argv])
        finally:
            sys.path.pop(0)
            torch.set_num_threads(threads)

    return run


@pytest.fixture(scope="module")
def finished(main, recipe, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("ablation")
    assert main(*arguments(recipe, out)) == 0
    return out


def arguments(recipe: Path, out: Path, samples: int = 6) -> list[object]:
    return [
        *("--out", out, "--base", recipe, "--samples", samples, "--seeds", 2, "--count", 4),
        *("--dev", "--threads", 1, "--keep-gb", 0.1, "-q"),
    ]


# --- rows ----------------------------------------------------------------------------------------


def test_tables_are_the_papers(report):
    theirs = report.published()
    assert list(report.TABLES) == list(PRINTED)
    for title, lines in PRINTED.items():
        shown = [
            (label, *(theirs[row][key] for key in report.METRICS))
            for label, row in report.TABLES[title]
        ]
        assert shown == lines
    names = [row.name for row in ablation.ROWS]
    assert list(report.LABELS) == names == list(theirs)
    assert {row for table in report.TABLES.values() for _, row in table} == set(names)
    assert report.CLAIM == ablation.DECIDING


@pytest.mark.skipif(not REFERENCE.is_file(), reason="the reference is not beside this copy")
def test_tables_are_those_of_the_reference():
    text = REFERENCE.read_text(encoding="utf-8").partition("### 1.11")[2].partition("\n---")[0]
    lines = [line.replace("*", "") for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    found: dict[str, list[tuple[object, ...]]] = {title: [] for title in PRINTED}
    one, two, three = found.values()
    for row in cells:
        if len(row) == 9 and re.fullmatch(r"[\d.]+", row[6]):
            if row[0]:
                one.append((row[0], *map(float, row[1:4])))
            two.append((row[5], *map(float, row[6:9])))
        elif len(row) == 7 and re.fullmatch(r"[\d.]+", row[1]):
            values = [float(cell) for cell in row[1:]]
            three.append((row[0].partition("(")[0].strip(), *values[0::2]))
            three.append((row[0].partition("(")[0].strip(), *values[1::2]))
    for title, lines in PRINTED.items():
        assert [row[1:] for row in found[title]] == [line[1:] for line in lines]
        for row, line in zip(found[title], lines, strict=True):
            # Table 3 adds a remark on its "PWVO", and which column it is
            assert line[0].startswith(str(row[0]).rstrip("."))


def test_rows_differ_in_their_switches_only(recipe):
    base, _ = load_training_options(recipe)
    made = {row.name: ablation.row_options(base, row, 3, 10) for row in ablation.ROWS}
    switches = {
        name: (
            options.network.kind,
            options.loss.pose_uncertainty,
            options.loss.flow_uncertainty,
            options.loss.depth_uncertainty,
            options.loss.flow,
            options.selection,
        )
        for name, options in made.items()
    }
    assert switches == {
        "vonet": ("vonet", False, False, False, True, "mean"),
        "vonet-attention": ("vonet-attention", False, False, False, True, "mean"),
        "pixelwise": ("pwvo", False, False, False, True, "mean"),
        "naive": ("pwvo", True, False, False, True, "mean"),
        "uncertain": ("pwvo", True, True, True, True, "mean"),
        "pwvo": ("pwvo", True, True, True, True, "softmax"),
        "vonet-without-flow": ("vonet", False, False, False, False, "mean"),
        "vonet-attention-without-flow": ("vonet-attention", False, False, False, False, "mean"),
        "naive-without-flow": ("pwvo", True, False, False, False, "mean"),
    }
    for options in made.values():
        assert (options.seed, options.steps, options.batch_size) == (3, 3, 4)
        assert options.schedule.by == "steps" and options.moving_weight == 0.0
        assert options.loss.pose and options.loss.depth
        for name in ("data", "optimizer", "ema_decay", "translation_loss", "precision"):
            assert getattr(options, name) == getattr(base, name)
        same = dataclasses.replace(
            options.network, kind=base.network.kind, uncertainty=base.network.uncertainty
        )
        assert same == base.network
    assert not made["pixelwise"].network.uncertainty
    with pytest.raises(InputError, match="at least one sample"):
        ablation.row_options(base, ablation.ROWS[0], 0, 0)


def test_two_decoders_stay_where_there_is_uncertainty():
    base = TrainingOptions(network=NetworkOptions(decoders=2))
    made = {row.name: ablation.row_options(base, row, 0, 1) for row in ablation.ROWS}
    assert {n for n, o in made.items() if o.network.decoders == 2} == {
        *("naive", "uncertain", "pwvo", "naive-without-flow")
    }


def test_the_loss_of_all_pixels_weighs_as_that_of_every_second():
    # A shift of K's centre in the target makes the flow error the same at every pixel.
    base = TrainingOptions(
        loss=LossOptions(
            flow_uncertainty=False, depth_uncertainty=False, flow_weight=2.0, flow_limit_px=3.0
        ),
        loss_stride=2,
    )
    K = torch.tensor([[[20.0, 0, 15.5], [0, 20.0, 7.5], [0, 0, 1]]])
    depth = torch.full((1, 16, 32), 4.0)
    eye = torch.eye(4)[None]
    flow, _, _ = reconstruct(depth, eye, K, K)
    for error, counts in ((4.0, True), (8.0, False)):  # px; the limit is 6 px of the whole picture
        shift = torch.tensor([error, 0.0])[None, :, None, None]
        zero = torch.zeros(1, 3)
        targets = LossTargets(zero, zero, flow + shift, depth, depth, K, K)
        weighed = []
        for name in ("pixelwise", "pwvo"):
            row = next(row for row in ablation.ROWS if row.name == name)
            options = ablation.row_options(base, row, 0, 1)
            plain = dataclasses.replace(
                options.loss,
                pose_uncertainty=False,
                flow_uncertainty=False,
                depth_uncertainty=False,
            )
            loss, _ = total_loss((zero, zero), targets.subsample(options.loss_stride), plain, eye)
            weighed.append(float(loss))
        assert weighed[0] == pytest.approx(weighed[1], rel=1e-5)
        assert weighed[0] == pytest.approx(0.5 * error if counts else 0.0, abs=1e-5)


def test_plan_does_first_what_decides():
    plan = [(row.name, seed) for row, seed in ablation.plan(3)]
    assert plan[:3] == [("pwvo", 0), ("naive", 0), ("vonet", 0)]
    assert sorted(plan[:9]) == sorted((row.name, 0) for row in ablation.ROWS)
    assert plan[9:] == [(name, seed) for seed in (1, 2) for name in ("pwvo", "naive", "vonet")]
    assert [(r.name, s) for r, s in ablation.plan(2, ["pixelwise", "naive"])] == [
        *(("naive", 0), ("pixelwise", 0), ("naive", 1))
    ]
    with pytest.raises(InputError, match="naiv; known: vonet"):
        ablation.plan(1, ["naiv"])
    with pytest.raises(InputError, match="at least one seed"):
        ablation.plan(0)


def test_kept_samples_are_those_of_the_preset():
    preset = PaperOptions(height=32, width=64)
    kept = ablation.KeptSamples(preset)
    first = kept.sample(sample_generator(5, 7, True))
    assert kept.sample(sample_generator(5, 7, True)) is first
    assert kept.sample(sample_generator(5, 8, True)) is not first
    assert kept.sample(sample_generator(5, 7)) is not first  # held-out: other keys
    np.testing.assert_array_equal(first.flow, preset.sample(sample_generator(5, 7, True)).flow)
    assert len(kept) == 3
    kept.forget()
    assert len(kept) == 0
    none = ablation.KeptSamples(preset, 1000)
    assert none.sample(sample_generator(5, 7, True)) is not none.sample(
        sample_generator(5, 7, True)
    )
    assert len(none) == 0


# --- training ------------------------------------------------------------------------------------


def test_an_interrupted_row_ends_as_if_it_had_not_been(recipe, tmp_path):
    base, mixture = load_training_options(recipe)
    options = ablation.row_options(base, ablation.ROWS[3], 0, 12)
    whole = ablation.train_row(options, mixture, tmp_path / "whole")
    asked: list[int] = []

    def after_one() -> bool:
        asked.append(1)
        return len(asked) > 1

    part = ablation.train_row(options, mixture, tmp_path / "part", should_stop=after_one)
    assert part.step == 1
    kept = ablation.KeptSamples(mixture)
    resumed = ablation.train_row(options, mixture, tmp_path / "part", kept=kept)
    assert (resumed.step, resumed.samples) == (whole.step, whole.samples) == (3, 12)
    assert len(kept) == 8
    ours, theirs = resumed.exported.state_dict(), whole.exported.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_a_folder_of_another_run_is_refused(recipe, tmp_path):
    base, mixture = load_training_options(recipe)
    options = ablation.row_options(base, ablation.ROWS[0], 0, 4)
    ablation.train_row(options, mixture, tmp_path)
    more = ablation.row_options(base, ablation.ROWS[0], 0, 8)
    with pytest.raises(InputError, match="steps was 1, now 2"):
        ablation.train_row(more, mixture, tmp_path)
    other = Mixture((PaperOptions(height=32, width=64, objects=1),), (1.0,))
    with pytest.raises(InputError, match="the data presets differ"):
        ablation.train_row(options, other, tmp_path)
    (tmp_path / "options.json").unlink()
    with pytest.raises(InputError, match=r"options\.json cannot be read"):
        ablation.train_row(options, mixture, tmp_path)


# --- the tool ------------------------------------------------------------------------------------


def test_every_row_is_trained_and_scored(finished, report):
    result = json.loads((finished / "ablation.json").read_text(encoding="utf-8"))
    assert [(run["row"], run["seed"]) for run in result["runs"]] == [
        (row.name, seed) for row, seed in ablation.plan(2)
    ]
    for run in result["runs"]:
        assert (run["updates"], run["samples"]) == (2, 8)
        assert set(run["scores"]) == {"data_paper", "data_wide"}
        assert all(score["count"] == 4 for score in run["scores"].values())
        assert (finished / f"{run['row']}-seed{run['seed']}" / "checkpoint.pt").is_file()
    # all on the same pairs
    assert len({run["scores"]["data_paper"]["zero_epe"] for run in result["runs"]}) == 1
    rows = {row["key"]: row for row in result["rows"]}
    assert list(rows) == [*report.LABELS, "zero-motion"]
    seeds = [r["scores"]["data_paper"]["epe"] for r in result["runs"] if r["row"] == "pwvo"]
    assert rows["pwvo"]["seeds"] == 2
    assert rows["pwvo"]["epe"] == pytest.approx(sum(seeds) / 2, rel=1e-12)
    assert (rows["pwvo"]["epe_low"], rows["pwvo"]["epe_high"]) == (min(seeds), max(seeds))
    assert rows["pwvo"]["published_epe"] == 0.626
    assert rows["pwvo"]["sintel_epe"] is None
    assert result["unfinished"] == [] and result["held_out"]["seed"] == 0


def test_the_page_says_what_the_json_says(finished):
    result = json.loads((finished / "ablation.json").read_text(encoding="utf-8"))
    page = (finished / "ablation.md").read_text(encoding="utf-8")
    for title, lines in PRINTED.items():
        part = page.partition(f"## {title}\n")[2].partition("\n## ")[0]
        for label, *figures in lines:
            (line,) = [row for row in part.splitlines() if row.startswith(f"| {label} |")]
            assert [cell.strip() for cell in line.split("|")][-4:-1] == [
                f"{figure:.3f}" for figure in figures
            ]
    for row in result["rows"]:
        assert f"{row['epe']:.3f}" in page
    assert "published columns are not the same measurement" in page
    assert (finished / "ablation.png").read_bytes()[:4] == b"\x89PNG"


def copied(finished: Path, target: Path) -> Path:
    """Two rows of the finished ablation, to be changed."""
    for name in ("pwvo-seed0", "vonet-seed0"):
        shutil.copytree(finished / name, target / name)
    return target


TWO = ("--seeds", 1, "--rows", "pwvo,vonet")


def test_what_is_finished_is_not_done_again(finished, main, recipe, tmp_path, monkeypatch):
    def forbidden(*args: object, **kwargs: object) -> None:
        raise AssertionError("done again")

    out = copied(finished, tmp_path / "out")
    before = json.loads((finished / "ablation.json").read_text(encoding="utf-8"))["runs"]
    monkeypatch.setattr(ablation.Trainer, "run", forbidden)
    monkeypatch.setattr(ablation, "evaluate_network", forbidden)
    assert main(*arguments(recipe, out), *TWO) == 0
    after = json.loads((out / "ablation.json").read_text(encoding="utf-8"))["runs"]
    assert after == [run for run in before if run["row"] in ("pwvo", "vonet") and not run["seed"]]
    # other pairs: scored, not trained
    scored: list[int] = []

    def score(network: object, preset: object, seed: int, count: int, **kwargs: object):
        scored.append(count)
        return before[0]["scores"]["data_paper"]

    monkeypatch.setattr(ablation, "evaluate_network", score)
    assert main(*arguments(recipe, out), *TWO, "--count", 2) == 0
    assert scored == [2] * 4


def test_results_are_there_after_every_row(main, recipe, tmp_path, monkeypatch):
    train, trained = ablation.train_row, []

    def until_the_third(*args, **kwargs):
        trained.append(1)
        if len(trained) == 3:
            raise InputError("stopped here")
        return train(*args, **kwargs)

    monkeypatch.setattr(ablation, "train_row", until_the_third)
    assert main(*arguments(recipe, tmp_path)) == 2
    result = json.loads((tmp_path / "ablation.json").read_text(encoding="utf-8"))
    assert [run["row"] for run in result["runs"]] == ["pwvo", "naive"]
    assert "vonet, seed 0" in result["unfinished"] and len(result["unfinished"]) == 10
    steps = {step["worse"]: step["verdict"] for step in result["order"]["data_paper"]["steps"]}
    assert steps["vonet"] == "not measured"
    assert "Not trained (yet): vonet, seed 0" in (tmp_path / "ablation.md").read_text()


@pytest.mark.parametrize(
    ("extra", "code", "words"),
    [
        (["--samples", "0"], 2, "--samples: expected 1 or more"),
        (["--keep-gb", "nan"], 2, "--keep-gb: expected 0 or more"),
        (["--rows", "pwov"], 2, "unknown rows pwov"),
        (["--seeds", "0"], 2, "at least one seed"),
        (["--samples", "400"], 2, "holds a run of other options (steps was 2, now 100)"),
        (["--sintel", "nowhere"], 2, "nowhere"),
    ],
)
def test_bad_usage_is_told_before_training(finished, main, recipe, extra, code, words, capsys):
    assert main(*arguments(recipe, finished), *extra) == code
    assert words in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_ends_with_five(main, recipe, tmp_path):
    (tmp_path / "file").write_text("")
    assert main(*arguments(recipe, tmp_path / "file")) == 5


class Still(torch.nn.Module):
    """Predicts no motion."""

    def __init__(self) -> None:
        super().__init__()
        self.nothing = torch.nn.Parameter(torch.zeros(1))

    def forward(self, inputs):
        zero = torch.zeros(len(inputs), 3)
        return zero, zero


def test_sintel_is_scored_by_the_papers_protocol(
    finished, main, recipe, tmp_path, monkeypatch, capsys
):
    scene = make_scene("static", 1, height=48, width=96, frames=3)
    write_sintel(scene, tmp_path, "alley_1")
    monkeypatch.setattr(tool("ablation_sintel"), "_network", lambda *_: (Still(), "mean"))
    out = copied(finished, tmp_path / "out")
    assert main(*arguments(recipe, out), *TWO, "--sintel", tmp_path) == 0
    result = json.loads((out / "ablation.json").read_text(encoding="utf-8"))
    T = scene.T_world_cam
    motions = [invert(T[i + 1]) @ T[i] for i in range(2)]
    rows = {row["key"]: row for row in result["rows"]}
    # no motion: the errors are the motions themselves; .cam files hold doubles
    angles = np.mean([np.abs(matrix_to_euler_deg(M[:3, :3])).mean() for M in motions])
    lengths = np.mean([np.abs(M[:3, 3]).mean() for M in motions])
    assert rows["pwvo"]["sintel_r_err_deg"] == pytest.approx(angles, rel=1e-6)
    assert rows["pwvo"]["sintel_t_err"] == pytest.approx(lengths, rel=1e-6)
    assert rows["vonet"]["sintel_epe"] > 0
    assert result["sintel"] == {
        "pairs": 2,
        "note": "2 of the paper's 992 pairs; 22 sequences are missing",
    }
    assert result["order"]["sintel"]["steps"][0]["verdict"] == "not measured"
    assert "EPE, Sintel, here" in (out / "ablation.md").read_text(encoding="utf-8")
    write_sintel(scene, tmp_path / "other", "nowhere_1")
    assert main(*arguments(recipe, out), *TWO, "--sintel", tmp_path / "other") == 2
    assert "none of the 23" in capsys.readouterr().err


# --- the order -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pwvo", "naive", "vonet", "reproduced", "verdicts"),
    [
        ([1.0, 1.1], [1.5, 1.6], [2.0, 2.1], True, ["reproduced", "reproduced"]),
        ([1.0], [1.5], [2.0], True, ["reproduced, one seed", "reproduced, one seed"]),
        ([1.6, 1.1], [1.5, 1.6], [2.0, 2.1], None, ["undecided", "reproduced"]),
        ([1.0, 1.1], [2.5, 2.6], [2.0, 2.1], False, ["reproduced", "not reproduced"]),
        ([1.6, 1.1], [1.5, 1.6], [1.0, 1.1], False, ["undecided", "not reproduced"]),
        ([1.5], [1.5], [2.0], False, ["not reproduced", "reproduced, one seed"]),
        ([1.0], [], [2.0], None, ["not measured", "not measured"]),
        ([1.0, 1.0], [1.5], [2.0], True, ["reproduced, one seed", "reproduced, one seed"]),
    ],
)
def test_verdict_on_the_order(report, pwvo, naive, vonet, reproduced, verdicts):
    runs = [
        {"row": row, "seed": seed, "scores": {"data_paper": {"epe": epe}}}
        for row, values in (("pwvo", pwvo), ("naive", naive), ("vonet", vonet))
        for seed, epe in enumerate(values)
    ]
    found = report.order(runs, "data_paper")
    assert found["reproduced"] is reproduced
    assert [step["verdict"] for step in found["steps"]] == verdicts
    if naive:
        difference = np.mean([p - n for p, n in zip(pwvo, naive, strict=False)])
        assert found["steps"][0]["difference"] == pytest.approx(difference)


def test_the_committed_recipe_fits_every_row():
    for name in ("ablation.yaml", "train_paper.yaml"):
        base, _ = load_training_options(ROOT / "configs" / name)
        for row in ablation.ROWS:
            assert ablation.row_options(base, row, 0, 1000).loss.reconstructs
    base, _ = load_training_options(ROOT / "configs" / "ablation.yaml")
    whole = ablation.row_options(base, ablation.ROWS[5], 0, 1000).loss
    published = LossOptions()
    assert (whole.flow_weight, whole.flow_limit_px) == (
        published.flow_weight,
        published.flow_limit_px,
    )
