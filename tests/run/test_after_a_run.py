"""What a run says at its end: colours, the least sure step, and what to do next."""

from __future__ import annotations

import io
import shlex
from pathlib import Path
from typing import Any, ClassVar

import pytest

from hybridvo.run import cli
from hybridvo.run.cli import main
from hybridvo.run.commands import live as live_command
from hybridvo.run.commands import run as run_command
from hybridvo.run.commands import terminal
from hybridvo.run.commands.arguments import build_parser
from hybridvo.run.commands.next_step import command_that_shows
from hybridvo.run.commands.run import _least_sure
from hybridvo_lab.commands import show
from tests.io.live.scripted import ScriptedCamera, reading


class Terminal(io.StringIO):
    """A stdout that is a terminal."""

    def isatty(self) -> bool:
        return True


SUMMARY = "status             failed 2 of 19 motions, 3 degraded"


def shown(monkeypatch: pytest.MonkeyPatch, out: io.StringIO, text: str) -> str:
    monkeypatch.setattr(terminal.sys, "stdout", out)
    terminal.show(text)
    return out.getvalue()


@pytest.fixture
def colours(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NO_COLOR", "FORCE_COLOR", "COLORTERM"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")


def test_states_are_coloured_on_a_terminal(monkeypatch: Any, colours: None) -> None:
    found = shown(monkeypatch, Terminal(), SUMMARY)
    assert "\x1b[31mfailed 2 of 19 motions\x1b[0m" in found
    assert "\x1b[33m3 degraded\x1b[0m" in found


def test_elsewhere_there_are_no_colours(monkeypatch: Any, colours: None) -> None:
    assert shown(monkeypatch, io.StringIO(), SUMMARY) == f"{SUMMARY}\n"
    monkeypatch.setenv("NO_COLOR", "1")
    assert shown(monkeypatch, Terminal(), SUMMARY) == f"{SUMMARY}\n"


def motions(*rows: tuple[int, str, float]) -> list[dict]:
    names = ("index", "status", "probability")
    return [dict(zip(names, row, strict=True), reason="") for row in rows]


def test_the_least_sure_step_is_a_failed_one_before_an_improbable_one() -> None:
    found = _least_sure(
        motions((1, "ok", 0.9), (2, "degraded", 0.1), (3, "failed", 0.0))
    )
    assert found is not None and found["frame"] == 3
    found = _least_sure(motions((1, "ok", 0.9), (2, "ok", 0.8), (3, "ok", 0.99)))
    assert found is not None and found["frame"] == 2
    # what no probability is known of is the least sure
    found = _least_sure(motions((1, "ok", 0.1), (2, "ok", float("nan"))))
    assert found is not None and (found["frame"], found["probability"]) == (2, 0.0)
    assert _least_sure(motions()) is None


def test_the_next_command_takes_what_the_run_took() -> None:
    words = ["my walk", "--camera", "1,2,3,4", "--depth-scale", "1000", "--trust"]
    more = ["--flow", "dis", "--method", "classical", "--stereo", "--out", "x"]
    args = build_parser().parse_args(["run", *words, *more])
    program, *found = shlex.split(command_that_shows(args, 7))
    assert program == "hybridvo"
    show = build_parser().parse_args(found)
    assert (show.sequence, show.pair, show.method) == ("my walk", 6, "classical")
    for name in ("camera", "depth_scale", "trust", "flow", "stereo"):
        assert getattr(show, name) == getattr(args, name), name


def test_the_last_line_is_a_command_that_works(
    dataset: Path, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    drawn: list[tuple[str, int]] = []

    def draw_pair(sequence: Any, pair: int, out: Path, **_: Any) -> Path:
        drawn.append((sequence.name, pair))
        return Path(out)

    monkeypatch.setattr(show, "draw_pair", draw_pair)
    options = ["--flow", "dis", "--stop", "3", "--method", "classical"]
    assert main(["run", str(dataset), "--out", str(tmp_path / "o"), *options]) == 0
    label, command = capsys.readouterr().out.splitlines()[-1].split(maxsplit=1)
    assert label == "next"
    words = shlex.split(command)[1:]
    frame = int(words[words.index("--frame") + 1])
    assert frame in (1, 2)
    assert main(words) == 0
    # a pair is named by its first frame
    assert drawn == [("static", frame - 1)]


class Watcher:
    """In place of a viewer: counts what it is shown."""

    made: ClassVar[list[Watcher]] = []

    def __init__(self, view: str, name: str, *_: Any, **__: Any) -> None:
        self.view = view
        self.seen: list[Any] = []
        self.is_closed = False
        self.made.append(self)

    def add(self, seen: Any) -> None:
        self.seen.append(seen)

    def close(self) -> None:
        self.is_closed = True

    def served(self) -> str:
        return "http://127.0.0.1:1/"


@pytest.fixture
def watchers(monkeypatch: pytest.MonkeyPatch) -> list[Watcher]:
    monkeypatch.setattr(Watcher, "made", [])
    monkeypatch.setattr(run_command, "Viewer", Watcher)
    monkeypatch.setattr(live_command, "Viewer", Watcher)
    return Watcher.made


def test_a_run_is_shown(
    dataset: Path, tmp_path: Path, watchers: list[Watcher]
) -> None:
    options = ["--flow", "dis", "--stop", "3", "--method", "classical", "-q"]
    words = ["run", str(dataset), "--out", str(tmp_path / "o"), *options]
    assert main([*words, "--view", "serve"]) == 0
    (watcher,) = watchers
    assert watcher.view == "serve" and watcher.is_closed
    steps = watcher.seen
    assert [seen.step.index for seen in steps] == [0, 1, 2]
    assert steps[0].start is None and steps[0].rate is None
    assert steps[1].start.index == 0 and steps[1].rate > 0
    assert steps[2].flow.shape == (96, 160, 2)


def test_a_live_run_is_shown(tmp_path: Path, watchers: list[Watcher]) -> None:
    camera = ScriptedCamera(*(reading(0.1 * i) for i in range(3)), hasty=True)
    summary, _ = live_command.live(camera, tmp_path, view="spawn", quiet=True)
    (watcher,) = watchers
    assert watcher.is_closed
    assert len(watcher.seen) == summary["tracked"]


def test_a_page_stays_until_it_is_left(
    dataset: Path,
    tmp_path: Path,
    watchers: list[Watcher],
    monkeypatch: Any,
    capsys: Any,
) -> None:
    def leave() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.signal, "pause", leave)
    monkeypatch.setattr(cli.sys, "stdin", Terminal())
    options = ["--stop", "2", "--method", "identity", "-q", "--view", "serve"]
    assert main(["run", str(dataset), "--out", str(tmp_path), *options]) == 0
    assert "http://127.0.0.1:1/ is there until" in capsys.readouterr().err
