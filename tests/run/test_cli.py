from __future__ import annotations

import dataclasses
import errno
import io
import json
import logging
import os
import shutil
from importlib import import_module
from inspect import signature
from pathlib import Path

import filelock
import numpy as np
import pytest

from hybridvo.core import laboratory
from hybridvo.core.errors import printable
from hybridvo.core.files import LOCK
from hybridvo.core.options import RunOptions, option_defaults
from hybridvo.core.results import Reason
from hybridvo.run.cli import main
from hybridvo.run.commands.advice import advice_on
from hybridvo.run.commands.arguments import COMMANDS, TRAINING_COMMANDS
from hybridvo.run.commands.terminal import printable_content, table
from hybridvo.run.commands.text import text_of


def write_tum(path: Path, noise: float = 0.0) -> str:
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(size=(5, 3)), axis=0) + noise * rng.normal(size=(5, 3))
    lines = [
        f"{0.5 * i} {a:.17g} {b:.17g} {c:.17g} 0 0 0 1"
        for i, (a, b, c) in enumerate(x)
    ]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_set_help_needs_no_folder_and_says_what_each_key_means(capsys):
    for command in (["run"], ["run", "x"], ["compare"]):
        assert main([*command, "--set", "help"]) == 0
        lines = capsys.readouterr().out.splitlines()
        keys = {line.split("=")[0] for line in lines if "=" in line.split(" ")[0]}
        assert keys == set(option_defaults())
        (line,) = (line for line in lines if line.startswith("refine.cutoff=3.0 "))
        assert "Geman-McClure" in line


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "required"),
        (["walk"], "walk"),
        (["run"], "--sequence"),
        (["run", "x", "--resume", "--overwrite"], "not allowed with"),
        (["run", "x", "-q", "-v"], "not allowed with"),
        (["run", "x", "--start", "a"], "--start"),
        (["evaluate", "a"], "GT"),
        (["run", "/nowhere"], "/nowhere"),
        (["doctor", "/nowhere"], "/nowhere"),
        (["run", "{sequence}", "--method", "refin"], "classical"),
        (["run", "{sequence}", "--flow", "raft"], "raft"),
        (["run", "{sequence}", "--flow", "file", "--stride", "2"], "--flow dis"),
        (["run", "{sequence}", "--start", "7"], "7"),
        (["run", "{sequence}", "--start", "-1"], "-1"),
        (["run", "{sequence}", "--max-failed", "2"], "2"),
        (["run", "{sequence}", "--device", "tpu"], "tpu"),
        (["run", "{sequence}", "--dataset", "sintell"], "sintel"),
        (["run", "{sequence}", "--config", "none.yaml"], "none.yaml"),
        (["run", "{sequence}", "--set", "refine.cutof=1"], "cutof: unknown"),
        (["run", "{sequence}", "--rrd", "recording.txt"], ".rrd"),
        (["run", "{sequence}", "--weights", "pwvo=none.file"], "none.file"),
        (["run", "{sequence}", "--weights", "mine"], "got mine."),
        (["run", "{sequence}", "--weights", "mine=none"], "got mine=none."),
        (["generate", "--preset", "nosuch", "--out", "runs"], "paper, diverse"),
        (["train", "paper", "--config", "nosuch.yaml", "--out", "runs"], "source"),
        (["doctor", "nul\0"], "NUL"),
    ],
)
def test_wrong_usage_is_exit_code_2_and_no_traceback(
    arguments, expected, dataset, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main([text.format(sequence=dataset) for text in arguments]) == 2
    captured = capsys.readouterr()
    assert (
        expected in captured.err
        and captured.out == ""
        and "Traceback" not in captured.err
    )
    assert not (tmp_path / "runs").exists()


def test_verbose_shows_where_an_error_came_from(tmp_path, capsys):
    assert main(["run", str(tmp_path / "absent"), "-v"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_exit_codes_1_4_5_and_130(dataset, tmp_path, monkeypatch, capsys):
    arguments = ["run", str(dataset), "--method", "identity", "-q", "--out"]
    (tmp_path / "file").write_text("")
    assert main([*arguments, str(tmp_path / "file" / "out")]) == 5
    # can neither be written nor deleted
    for name in ("metrics.json", "trajectory.tum"):
        (tmp_path / name / name).mkdir(parents=True)
        assert main([*arguments, str(tmp_path / name), "--overwrite"]) == 5
    (tmp_path / "held").mkdir()
    with filelock.FileLock(tmp_path / "held" / LOCK):
        assert main([*arguments, str(tmp_path / "held")]) == 4
    for error, code in (
        (RuntimeError("unforeseen"), 1),
        (KeyboardInterrupt(), 130),
    ):

        def broken(*_, error=error, **__):
            raise error

        monkeypatch.setattr("hybridvo.io.data.open.open_sequence", broken)
        assert main([*arguments, str(tmp_path / "out")]) == code
    assert "this is a bug" in capsys.readouterr().err


def test_quiet_prints_errors_only(dataset, tmp_path, capsys):
    truth = write_tum(tmp_path / "gt")
    folder = ["--out", str(tmp_path / "out"), "--method", "identity"]
    for arguments in (
        ["run", str(dataset), *folder],
        ["evaluate", truth, truth],
        ["init", str(tmp_path / "mine")],
        [
            "compare",
            str(dataset),
            "--methods=identity",
            f"--out={tmp_path}/compare",
        ],
    ):
        assert main([*arguments, "-q"]) == 0
        assert capsys.readouterr() == ("", "")
    # asked for by name
    assert main(["evaluate", truth, truth, "-q", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["matched"] == 5


@pytest.mark.slow
def test_names_do_not_steer_the_terminal(dataset, tmp_path, monkeypatch, capsys):
    """A title is set by ESC ] 0 ; and BEL, an eight-bit terminal takes U+009D for ESC ]."""
    hostile = tmp_path / "\x1b]0;owned\x07\x9d0;owned\x9c"
    shutil.copytree(dataset.parents[2], hostile / "\x1b[2J")
    training = hostile / "\x1b[2J" / "training"
    for part in ("clean", "final", "flow", "depth", "camdata_left"):
        if (training / part).is_dir():
            (training / part / "static").rename(training / part / "\x1b[31mstatic")
    sequence = training / "clean" / "\x1b[31mstatic"
    truth = write_tum(tmp_path / "gt")
    (tmp_path / "bad").write_text("0 1 2 3 4 5 6\n\x1b[31m 1\n")
    given = ["--methods", "identity", "--out", str(tmp_path / "\x1b[32m")]
    out = ["--out", str(tmp_path / "\x1b[33m")]
    for arguments, code in (
        (["run", str(sequence), "--method", "identity", *out], 0),
        (["run", str(hostile)], 2),
        (["run", str(hostile), "-v"], 2),
        (["compare", str(sequence), *given], 0),
        (["doctor", str(sequence), "--pairs", "1"], 0),
        (["evaluate", str(tmp_path / "bad"), truth], 2),
        (["evaluate", truth, truth, "\x1b[31m"], 2),
    ):
        assert main(arguments) == code
        said = "".join(capsys.readouterr())
        assert "\\x1b" in said
        assert not {c for c in said if c not in "\n\t" and not c.isprintable()}, (
            arguments
        )
    logging.getLogger("hybridvo.flow.providers").warning("flow of \x1b[31m")
    assert capsys.readouterr().err == "flow of \\x1b[31m\n"


def test_what_is_written_out_and_what_stays():
    harmless = "a\tb\né \N{GREEK SMALL LETTER SIGMA}"
    assert printable(harmless, keep="\t\n") == harmless
    assert (
        printable("\x00\x07\x1b\x7f\x9b\udcff\u202e")
        == r"\x00\x07\x1b\x7f\x9b\udcff\u202e"
    )
    content = {"a\n": ["\r", {"b": ("\x1b",)}, 1, None]}
    assert printable_content(content) == {
        r"a\n": [r"\r", {"b": [r"\x1b"]}, 1, None]
    }


def test_doubts_are_counted_and_every_reason_has_a_remedy():
    assert advice_on([("ok", "")] * 3) == []
    outcomes = [("ok", ""), ("degraded", "ambiguous_motion"), ("failed", "no_flow")]
    outcomes += [("degraded", "ambiguous_motion"), ("degraded", "low_inliers")]
    degraded, failed = advice_on(outcomes)
    assert degraded.startswith("3 of 5 motions degraded")
    assert degraded.index("2 ambiguous") < degraded.index("1 low_inliers")
    assert failed.startswith("1 of 5 motions failed")
    for reason in Reason:
        assert advice_on([("failed", reason.value)])


def test_a_full_disk_under_stdout_is_no_bug(tmp_path, monkeypatch, capsys):
    class Full(io.StringIO):
        def flush(self) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        def fileno(self) -> int:
            return os.open(os.devnull, os.O_WRONLY)

    truth = write_tum(tmp_path / "gt")
    monkeypatch.setattr("sys.stdout", Full())
    assert main(["evaluate", truth, truth]) == 5
    assert "No space left" in capsys.readouterr().err


def test_data_on_stdout_and_progress_on_stderr(dataset, tmp_path, capsys):
    arguments = ["run", "--sequence", str(dataset), "--method", "identity"]
    arguments += ["--out", str(tmp_path)]
    assert main([*arguments, "--json"]) == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert summary["frames"] == 6 and summary["state"] == "done"
    assert {Path(name).name for name in summary["files"]} >= {
        "metrics.json",
        "run.json",
    }
    assert "6/6 frames" in captured.err
    assert main([*arguments, "--overwrite", "-q"]) == 0
    assert capsys.readouterr().err == ""


def test_default_folder_is_runs_and_the_name(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(dataset), "--method", "identity", "-q"]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "trajectory.tum").is_file()


def test_evaluate(tmp_path, capsys):
    est, gt = write_tum(tmp_path / "est", noise=0.1), write_tum(tmp_path / "gt")
    assert main(["evaluate", gt, gt, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (
        report["ate_rmse"] == pytest.approx(0, abs=1e-9) and report["matched"] == 5
    )
    assert (
        main(["evaluate", est, gt, "--alignment", "origin", "--delta-unit", "s"])
        == 0
    )
    text = capsys.readouterr().out
    assert "5 of 5 poses" in text
    (tmp_path / "bad").write_text("0 1 2 3 4 5 6\n0 1\n")
    assert main(["evaluate", str(tmp_path / "bad"), gt]) == 2
    assert "bad:2" in capsys.readouterr().err
    (tmp_path / "later").write_text("900 0 0 0 0 0 0 1\n901 1 0 0 0 0 0 1\n")
    assert main(["evaluate", str(tmp_path / "later"), gt]) == 2
    assert "nothing could be compared" in capsys.readouterr().err


def test_a_path_that_no_camera_took_is_refused(tmp_path, capsys):
    truth = write_tum(tmp_path / "gt")
    (tmp_path / "far").write_text("0 1e200 0 0 0 0 0 1\n0.5 2e200 0 0 0 0 0 1\n")
    for arguments in (
        [str(tmp_path / "far"), truth],
        [truth, str(tmp_path / "far")],
    ):
        for json_too in ([], ["--json"]):
            assert main(["evaluate", *arguments, *json_too]) == 2
            assert "2e+200" in capsys.readouterr().err
    assert main(["evaluate", truth, truth, "--delta", "9" * 20]) == 0
    assert "not enough poses" in capsys.readouterr().out


def test_init_writes_a_camera_file(tmp_path):
    assert main(["init", str(tmp_path / "mine")]) == 0
    assert (tmp_path / "mine" / "camera.yaml").is_file()
    assert main(["init", str(tmp_path / "mine")]) == 2


def test_a_demo_replaces_nothing_but_a_demo(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("")
    for more in ([], ["--overwrite"]):
        assert main(["demo", "--out", str(tmp_path), *more]) == 2
        said = capsys.readouterr().err
        assert (
            str(tmp_path) in said and "mine.txt" in said and "--overwrite" in said
        )
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.long
def test_demo(tmp_path, capsys):
    assert (
        main(["demo", "--out", str(tmp_path), "--frames", "3", "-q", "--json"]) == 0
    )
    content = json.loads(capsys.readouterr().out)
    by_name = {row["method"]: row for row in content["rows"]}
    best = min(by_name.values(), key=lambda row: row["ate_cm"])
    assert best["method"] == "hybridvo (hybrid)"
    assert Path(content["report"]).stat().st_size > 10_000
    assert content["report"] in text_of("demo", content)
    assert main(["demo", "--out", str(tmp_path), "--frames", "3", "-q"]) == 2


def test_a_table_keeps_every_digit(monkeypatch):
    """Narrow columns are folded: an ellipsis would hide the numbers."""
    row = {"method": "classical", "flow": "file (true)"}
    row |= {f"translation {k} [cm]": "1.23e-05" for k in range(8)}
    monkeypatch.setenv("COLUMNS", "80")
    for terminal in ("0", "1"):
        monkeypatch.setenv("FORCE_COLOR", terminal if terminal == "1" else "")
        text = table([row])
        assert "\N{HORIZONTAL ELLIPSIS}" not in text
        assert "classical" in text


CALLED = {
    "run": ["hybridvo.run.commands.run:run"],
    "live": [
        "hybridvo.run.commands.live:live",
        "hybridvo.io.cameras.choose:choose_camera",
    ],
    "evaluate": [
        "hybridvo_lab.evaluation.metrics:evaluate",
        "hybridvo_lab.evaluation.path_scores:evaluate_path",
    ],
    "doctor": [
        "hybridvo.run.commands.doctor:diagnose",
        "hybridvo.run.commands.doctor:diagnose_camera",
    ],
    "pwvo": ["hybridvo_lab.commands.train:train_network"],
    "paper": ["hybridvo_lab.commands.train:train_network"],
}
"""What the commands call that are more than a call."""
PREPARED = {"weights", "jobs", "cluster", "config", "assignments", "flow", "speed"}
"""Arguments from which models, workers and options are made, or that choose what is called."""


@pytest.mark.parametrize(
    "command", [*COMMANDS, *TRAINING_COMMANDS], ids=lambda command: command.name
)
def test_every_argument_is_taken(command):
    """Arguments are passed by name: one with a name that nothing takes would do nothing."""
    taken = PREPARED | {option.name for option in dataclasses.fields(RunOptions)}
    places = CALLED.get(command.name) or command.call.args
    for place in (*places, "hybridvo.io.data.open:open_sequence"):
        module, _, name = place.partition(":")
        function = (
            getattr(import_module(module), name)
            if name
            else laboratory.find(laboratory.COMMANDS, place)
        )
        taken |= set(signature(function).parameters)
    for part in command.arguments:
        for names, settings in getattr(part, "arguments", [part]):
            name = settings.get("dest", names[0].lstrip("-").replace("-", "_"))
            assert name in taken, names
