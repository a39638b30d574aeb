"""What an attack on tools/compare_methods.py found, one test each.

The list of what was tried is in docs/attack.md; what a resumed comparison reads back has tests in
test_attack_kept.py.
"""

from __future__ import annotations

import csv
import html.parser
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hybridvo.comparison import runner
from hybridvo.comparison.executors import open_workers
from hybridvo.comparison.job import run_segment
from hybridvo.comparison.plan import shown_name, unique_names
from hybridvo.comparison.results import file_stem
from hybridvo.comparison.scores import scale_notice
from hybridvo.evaluation.report_tables import Column, _build, plain_markdown

from hybridvo.errors import InputError, OutputError
from hybridvo.run_folder import PARTIAL, STATE
from tests.scripts import load_script
from tests.sequences import write_folder

NASTY = [
    "<img src=x onerror=alert(1)>",
    "=cmd|' calc'!A1",
    "+1",
    "-1",
    "@SUM(1)",
    "![i](http:evil)",
    "a\rb",
    "a\nb\n# c",
    "\x1b[31mred",
    "a\u2028b",
    "\u202eevil",
    os.fsdecode(b"\xff\xfe"),
    "x" * 240,
    "\u540d" * 80,
]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    return load_script("tools/compare_methods.py")


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A sequence of three frames of 6x10 pixels."""
    return write_folder(tmp_path).path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without plots, which take seconds; what a report says has tests below."""
    monkeypatch.setattr("hybridvo.evaluation.report_page.write_report", _touch_reports)


def _touch_reports(folder: Path) -> None:
    for name in ("report.md", "report.html"):
        (folder / name).write_text("")


@pytest.fixture
def compare(
    tool: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Exit code and stderr of the tool, with results in ``out``."""

    def run(*sequences: Path | str, more: tuple[str, ...] = ()) -> tuple[int, str]:
        given = ["--sequence", *map(str, sequences), "--out", str(tmp_path / "out")]
        code = tool.main([*given, "--methods", "identity", "--flow", "file", "--maps", "0", *more])
        return code, capsys.readouterr().err

    return run


# names


@pytest.mark.parametrize("name", NASTY)
def test_a_name_is_one_printable_line_and_no_formula(name: str) -> None:
    shown = shown_name(name)
    assert shown.isprintable() and shown.encode() and shown[0] not in "=+-@\t\r"
    stem = file_stem(0, shown)
    assert len(f"{stem}_000000_pnp-ransac-tuned_file.jpg".encode()) < 255 and "/" not in stem


def test_ordinary_names_stay_as_they_are() -> None:
    for name in ("heavy_two_0000", "P000", "market 5", "na\u00efve", "a<b", "rgbd-1.2"):
        assert shown_name(name) == name


def test_names_that_are_shown_alike_are_told_apart() -> None:
    names = unique_names([Path("x/a\n"), Path("y/a\\n")], ["a\n", "a\\n"])
    assert len(set(names)) == 2 and all(name.isprintable() for name in names)


class _Tags(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, list[tuple[str, str | None]]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, attrs))


def test_results_of_sequences_with_hostile_names(
    compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path
) -> None:
    paths = []
    for k, name in enumerate(NASTY):  # another picture in each: none is another's copy
        paths.append(tmp_path / name)
        shutil.copytree(mine, paths[-1])
        (paths[-1] / "timestamps.txt").write_text(f"{k}\n{k + 1}\n{k + 2}\n")
        (paths[-1] / "poses.txt").unlink()
    code, err = compare(*paths, more=("--worst", "0"))
    assert code == 0 and "Traceback" not in err and "\x1b" not in err
    out = tmp_path / "out"
    result = json.loads((out / "results.json").read_text())
    names = [row["sequence"] for row in result["rows"]]
    assert len(set(names)) == len(NASTY)
    for file in ("pairs.csv", "results.csv"):
        with (out / file).open(newline="", encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines))
        assert [*dict.fromkeys(row["sequence"] for row in rows)] == names  # joined by it
        assert not any(cell[:1] in tuple("=+-@") for row in rows for cell in row.values() if cell)
    tags = _Tags()
    tags.feed((out / "report.html").read_text(encoding="utf-8"))
    for tag, attributes in tags.found:
        assert tag != "img" and not any(key.startswith("on") for key, _ in attributes)
    lines_of = (out / "report.md").read_text(encoding="utf-8").splitlines()
    text = "\n".join(line for line in lines_of if not line.startswith("    "))  # code: as it is
    assert "\x1b" not in "".join(lines_of) and "<img" not in text.replace("\\<img", "")
    assert "](http" not in text.replace("\\](http", "")
    assert {p.parent.resolve() for p in out.rglob("*.tum")} == {(out / "trajectories").resolve()}


def test_markdown_shows_a_name_as_it_stands() -> None:
    assert plain_markdown("heavy_two [px] (3)") == "heavy_two [px] (3)"
    assert plain_markdown("![i](http:e)") == "![i\\](http:e)"
    assert plain_markdown("[a]: b\n<b>|`$&") == "[a\\]: b \\<b>\\|\\`\\$\\&"


# which sequences, which folder


@pytest.mark.parametrize("other", ["mine/rgb", "../{}/mine", "link"])
def test_one_sequence_under_two_names_does_not_count_twice(
    compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path, other: str
) -> None:
    (tmp_path / "link").symlink_to(mine)
    code, err = compare(mine, f"{tmp_path}/" + other.format(tmp_path.name))
    assert code == 2 and ("the same frames as" in err or "given twice" in err)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--sequence", "--out"])
def test_an_empty_path_is_not_the_working_folder(
    tool: ModuleType, mine: Path, monkeypatch: pytest.MonkeyPatch, option: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(mine)
    before = sorted(mine.rglob("*"))
    given = {"--sequence": str(mine), "--out": "out", "--methods": "identity", option: ""}
    assert tool.main([word for pair in given.items() for word in pair]) == 2
    assert f"{option}: expected a folder, got an empty path" in capsys.readouterr().err
    assert sorted(mine.rglob("*")) == before


def test_results_are_not_written_among_the_frames(
    tool: ModuleType, mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(mine.rglob("*"))
    for folder in ("rgb", "depth", "flow"):
        given = ["--sequence", str(mine), "--out", str(mine / folder), "--methods", "identity"]
        assert tool.main(given) == 2
        assert "holds frames of the sequence" in capsys.readouterr().err
    assert sorted(mine.rglob("*")) == before


def test_a_name_that_no_file_system_takes_is_refused_in_words(
    tool: ModuleType, mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / ("x" * 300))
    assert tool.main(["--sequence", str(mine), "--out", out, "--methods", "identity"]) == 5
    assert "File name too long" in capsys.readouterr().err


@pytest.mark.parametrize("mode", [(), ("--overwrite",), ("--resume",)])
@pytest.mark.parametrize("name", ["trajectories", "worst", "figures"])
def test_folders_of_results_that_lead_elsewhere_are_refused(
    compare: Callable[..., tuple[int, str]],
    mine: Path,
    tmp_path: Path,
    name: str,
    mode: tuple[str, ...],
) -> None:
    out, outside = tmp_path / "out", tmp_path / "outside"
    out.mkdir()
    outside.mkdir()
    (outside / "000_mine_identity_file.tum").write_text("not yours")
    (out / name).symlink_to(outside)
    code, err = compare(mine, more=mode)
    assert code == 2 and "a link, where results go" in err
    (out / name).unlink()
    (out / name).write_text("a file")
    code, err = compare(mine, more=mode)
    assert code == 2 and "a file, where results go" in err
    assert [path.read_text() for path in outside.iterdir()] == ["not yours"]


def test_a_new_comparison_leaves_files_that_it_has_not_written(
    compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path
) -> None:
    path = tmp_path / "out" / "trajectories" / "000_mine_identity_file.tum"
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    code, err = compare(mine)
    assert code == 2 and "holds files already" in err and path.read_text() == "mine"


def test_overwrite_leaves_no_figure_of_the_comparison_before(
    quick: None, compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path
) -> None:
    assert compare(mine)[0] == 0
    old = tmp_path / "out" / "figures"
    old.mkdir()
    for name in ("other_000003.png", "other_000003.json"):
        (old / name).write_text("{}")
    (old / "notes.txt").write_text("mine")
    assert compare(mine, more=("--overwrite",))[0] == 0
    assert [path.name for path in old.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    "address", ["", "x", "tcp://", "tcp://a:b", "tcp://h:0", "tcp://h:99999", "inproc://x",
                "file:///etc/passwd", "http://h:1", "tcp://h:1/x", "tcp://h:1\n"],
)  # fmt: skip
def test_what_is_no_address_of_a_scheduler_is_refused_at_once(
    compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path, address: str
) -> None:
    code, err = compare(mine, more=("--scheduler", address))
    assert code == 2 and "expected an address such as tcp://host:8786" in err
    assert not (tmp_path / "out").exists()  # the next try finds a clean place


def test_addresses_of_schedulers_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    for address in ("tcp://host:8786", "tls://10.0.0.1:8786", "host-2.x:1", "tcp://[::1]:65535"):
        with (
            pytest.raises(InputError, match="Dask is not installed"),
            open_workers(scheduler=address),
        ):
            pass


def test_no_control_character_reaches_the_terminal(
    compare: Callable[..., tuple[int, str]],
) -> None:
    code, err = compare("\x1b]0;title\x07")
    assert code == 2 and "\x1b" not in err and "\x07" not in err


def test_no_more_processes_than_sequences(
    quick: None,
    compare: Callable[..., tuple[int, str]],
    mine: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []

    def opened(jobs: int, scheduler: str | None) -> Any:
        asked.append(jobs)
        return open_workers(1)

    monkeypatch.setattr(runner, "open_workers", opened)
    assert compare(mine, more=("--jobs", "1000000"))[0] == 0 and asked == [1]


# what is kept and what is missing


def test_a_damaged_comparison_is_not_resumed(
    quick: None,
    compare: Callable[..., tuple[int, str]],
    mine: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*args: Any) -> None:
        raise OutputError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(runner, "_write", full)
        assert compare(mine)[0] == 5
    path = tmp_path / "out" / PARTIAL
    good = path.read_text()
    path.write_text(good.replace('"done":2', '"done":-1'))
    code, err = compare(mine, more=("--resume",))
    assert code == 2 and "done: expected 1 to 2, got -1" in err and "--overwrite" in err
    path.write_text(good)  # nothing was lost by the refusal
    assert compare(mine, more=("--resume",))[0] == 0


def test_a_finished_comparison_without_its_results_says_so(
    quick: None, compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path
) -> None:
    assert compare(mine)[0] == 0
    (tmp_path / "out" / "report.md").unlink()
    assert compare(mine, more=("--resume",))[0] == 0  # made again from the others
    assert (tmp_path / "out" / "report.md").exists()
    (tmp_path / "out" / "results.json").unlink()
    code, err = compare(mine, more=("--resume",))
    assert code == 2 and "is done, but results.json is missing" in err


def test_maps_of_results_that_cannot_be_read_are_one_line(
    tool: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for content in ("", "[]", '{"sequences": 5}', "[" * 100_000):
        (tmp_path / "results.json").write_text(content)
        assert tool.draw_maps(tmp_path, 1, True) == []
        assert capsys.readouterr().err.startswith("compare_methods.py: no maps: results.json")


def test_maps_of_sequences_of_one_name_do_not_replace_each_other(tmp_path: Path) -> None:
    from hybridvo.visualization import PictureOptions, target

    (tmp_path / "results.json").write_text("{}")
    places = {
        target(PictureOptions(f"{name}/s", 0, into=tmp_path, name=f"{name}/s")) for name in "xy"
    }
    assert len(places) == 2


# input and output that change on the way


def test_an_output_folder_that_is_removed_ends_in_words(
    compare: Callable[..., tuple[int, str]],
    mine: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def removes(*args: Any) -> dict[str, Any]:
        shutil.rmtree(tmp_path / "out")
        return run_segment(*args)

    monkeypatch.setattr(runner, "run_segment", removes)
    code, err = compare(mine)
    assert code == 5 and "is gone" in err


def test_input_that_changes_on_the_way_is_remarked_on(
    quick: None,
    compare: Callable[..., tuple[int, str]],
    mine: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def changes(*args: Any) -> dict[str, Any]:
        (mine / "poses.txt").unlink()
        return run_segment(*args)

    monkeypatch.setattr(runner, "run_segment", changes)
    code, err = compare(mine)
    result = json.loads((tmp_path / "out" / "results.json").read_text())
    notices = result["sequences"][0]["notices"]
    assert code == 0 and "changed while the comparison ran" in err
    assert any("changed while the comparison ran" in notice for notice in notices)


def test_input_that_vanishes_on_the_way_keeps_what_was_done(
    compare: Callable[..., tuple[int, str]],
    mine: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def vanished(*args: Any) -> dict[str, Any]:
        raise InputError("mine: no such folder.")

    monkeypatch.setattr(runner, "run_segment", vanished)
    code, err = compare(mine)
    assert code == 2 and "What was finished is kept" in err and "--resume" in err
    assert (tmp_path / "out" / STATE).exists()


# figures that need a remark


def test_notices_and_pairs_left_out_stand_before_the_figures(
    compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path
) -> None:
    (mine / "rgb" / "f10.png").write_bytes(b"")
    shutil.copy(mine / "depth" / "f8.png", mine / "depth" / "f99.png")
    code, err = compare(mine)
    assert code == 0 and "note: mine: " in err and "f99" in err
    for name in ("report.md", "report.html"):
        text = (tmp_path / "out" / name).read_text(encoding="utf-8")
        head = text.index("What to know of these figures")
        assert head < text.index("Sequences", head) < text.index("Provenance", head)
        assert "mine: 1 of 2 pairs left out; first, frame 2: frame cannot be read" in text[head:]
        assert "f99" in text[head:]


def test_a_range_of_one_frame_says_that_it_has_no_pair(
    compare: Callable[..., tuple[int, str]], mine: Path, tmp_path: Path
) -> None:
    assert compare(mine, more=("--stop", "1"))[0] == 0
    assert "mine: no pair of frames" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize(
    ("scales", "told"),
    [
        ([10.0, 11.0], True),
        ([0.001, 0.0012], True),
        ([1000.0, 900.0, 1100.0], True),
        ([1.0, 10.0], False),  # one method is wrong, not the truth
        ([10.0, 0.1], False),
        ([2.0, 1.9], False),
        ([10.0], False),
        ([0.01, 0.2], False),  # noise agrees on nothing
        ([0.0, 0.0], False),
        ([], False),
        ([None, 10.0], False),
    ],
)
def test_a_truth_in_another_unit_is_remarked_on(scales: list[float | None], told: bool) -> None:
    rows = [
        {"method": f"m{k}", "scale_sim3": scale, "failed": 0, "pairs": 9}
        for k, scale in enumerate(scales)
    ]
    rows.append({"method": "identity", "scale_sim3": 1.0, "failed": 0, "pairs": 9})
    rows.append({"method": "gave up", "scale_sim3": 1.0, "failed": 9, "pairs": 9})
    assert bool(scale_notice(rows)) == told


@pytest.mark.parametrize("key", ["ms_median", "rot_err_deg_median"])
def test_giving_up_on_every_pair_is_not_the_best(key: str) -> None:
    columns = (Column("method", "method", text=True), Column(key, "time", better=-1))
    rows = [
        {"method": "gave up", key: 0.1, "pairs": 3, "failed": 3},
        {"method": "works", key: 5.0, "pairs": 3, "failed": 1},
        {"method": "slower", key: 9.0, "pairs": 3, "failed": 0},
    ]
    table = _build(columns, rows, [None] * 3, ["all"] * 3)
    assert [cells[1].best for _, cells in table.rows] == [False, True, False]
