"""The README tells the truth: its code runs, its paths exist, its numbers are those of the JSON."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest

import hybridvo
from hybridvo.cli import build_parser
from hybridvo.data.sequence import open_sequence
from hybridvo.errors import InputError
from hybridvo.pipeline import METHODS
from hybridvo.synthetic.scenes import SCENE_KINDS
from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
RESULTS = ROOT / "docs" / "results"
TOP = ("hybridvo/", "tools/", "tests/", "configs/", "docs/", ".ci/")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.DOTALL | re.MULTILINE)


def prose() -> str:
    return re.sub(r"^```.*?^```$", "", TEXT, flags=re.DOTALL | re.MULTILINE)


def spans() -> list[str]:
    """What stands in backquotes."""
    return re.findall(r"`([^`\n]+)`", prose())


def commands() -> list[str]:
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    inline = [span for span in spans() if span.split()[0] in ("make", "hybridvo", "python")]
    found = [line.split("#")[0].strip() for line in [*lines, *inline]]
    return [line for line in found if " " in line]


def tool(path: str) -> ModuleType:
    return load_script(path)


def sensor(count: int = 3):
    """640x480 RGB-D frames whose content moves by 2 px to the left at 3 and 4 m."""
    texture = np.random.default_rng(0).uniform(0, 255, (480, 700)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(texture, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
    for i in range(count):
        grey = texture[:, 2 * i : 2 * i + 640].astype(np.uint8)
        yield np.repeat(grey[..., None], 3, axis=2), np.full((480, 640), 3.0, np.float32), 0.1 * i


def test_the_loop_runs(capsys):
    (code,) = blocks("python")
    factors = []
    graph = SimpleNamespace(add_between=lambda T, covariance: factors.append((T, covariance)))
    scope = {"sensor": sensor(), "graph": graph}
    exec(compile(code, "README.md", "exec"), scope)
    assert len(factors) == 3
    for T, covariance in factors:
        assert T.shape == (4, 4)
        assert covariance.shape == (6, 6)
        assert np.isfinite(T).all()
    # 2 px at f = 525 and 3 m: the scene goes 11.4 mm to the left, or the camera turns by 2 / 525
    T = factors[1][0]
    sideways = T[0, 3] - 3.0 * np.arcsin(T[2, 0])
    assert sideways == pytest.approx(2 / 525 * 3, rel=0.05)


def test_the_loop_has_twelve_lines():
    (code,) = blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 12


def test_first_screen():
    head = TEXT.split("\n## ")[0]
    lines = [line for line in head.splitlines() if line]
    assert lines[0] == "# hybridvo"
    assert lines[1].count(".") == 1  # one sentence
    assert lines[2].startswith("![")  # one picture
    assert head.count("![") == 1
    assert len([line for line in lines if line.startswith("- ")]) == 3
    assert len(blocks("sh")[0].splitlines()) == 2
    assert head.count("```") == 4


def test_pictures_are_there_and_small():
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", TEXT)
    assert pictures
    for name in pictures:
        path = ROOT / name
        assert path.stat().st_size < 400_000
        height, width = cv2.imread(str(path)).shape[:2]
        assert width > 2 * height


def test_every_path_exists():
    named = {span.split()[0] for span in spans() if span.startswith(TOP)}
    named |= {span for span in spans() if re.fullmatch(r"[A-Z]+(\.md)?|[a-z]+\.(toml|txt)", span)}
    named |= {word for span in spans() for word in span.split() if word.startswith("tools/")}
    named |= {link for link in re.findall(r"\]\(([^)]+)\)", TEXT) if "://" not in link}
    named.discard("NAME")
    assert len(named) > 10
    for name in named:
        # files that a run writes, and those of a data set, are not ours
        if name not in ("rgb.txt", "depth.txt", "calib.txt", "times.txt", "groundtruth.txt"):
            assert (ROOT / name).exists(), name


@pytest.mark.parametrize("command", commands())
def test_every_command_is_understood(command):
    program, *arguments = shlex.split(command)
    if program == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        assert re.search(rf"^{arguments[0]}:", makefile, re.MULTILINE)
    elif program == "hybridvo":
        if arguments in (["run"], ["run", "--sequence"]):  # named in passing
            return
        build_parser().parse_args(arguments)
    else:
        assert program == "python"
        script = tool(arguments[0])
        parse = script._parse if hasattr(script, "_parse") else script.build_parser().parse_args
        parsed = parse(arguments[1:])
        config = getattr(parsed, "config", None)
        assert config is None or (ROOT / config).is_file()


def test_python_names_exist():
    for name in re.findall(r"`(?:hvo|hybridvo)\.([A-Za-z_.]+)(?:\(\))?`", prose()):
        value = hybridvo
        for part in name.split("."):
            if value is hybridvo and part not in hybridvo.__all__:
                value = importlib.import_module(f"hybridvo.{part}")
            else:
                value = getattr(value, part)


def test_from_pretrained_gives_a_tracker_that_asks_the_judge():
    # the README says so, and that the weights are of one megabyte
    from hybridvo.network.weights import pretrained

    assert hybridvo.Odometry.from_pretrained(prepare=False).method == "hybrid"
    assert hybridvo.Odometry(network=None, prepare=False).method == "refine"
    assert 0.5e6 < pretrained("judge").stat().st_size < 1.5e6


def test_kinds_of_data_and_scenes_are_all_named(tmp_path):
    section = TEXT.split("## Data preparation")[1].split("\n## ")[0]
    kinds = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    with pytest.raises(InputError) as error:
        open_sequence(tmp_path, "nonsense")
    for kind in kinds:
        assert kind in str(error.value)
    assert len(kinds) == 6
    for kind in SCENE_KINDS:
        assert f"`{kind}`" in section


def test_methods_in_tables_exist():
    for part in re.findall(r"<!-- table:\w+ -->(.*?)<!-- end", TEXT, re.DOTALL):
        for method in re.findall(r"\| `([\w-]+)` \|", part):
            assert method in METHODS or method == "poselib-2k", method


# Tables


def parts() -> dict[str, str]:
    return {
        m[0]: m[1] for m in re.findall(r"<!-- table:(\w+) -->(.*?)<!-- end:\1", TEXT, re.DOTALL)
    }


def test_tables_are_those_of_the_tool():
    made = tool("tools/make_readme_tables.py")
    assert set(parts()) == set(made.TABLES)
    assert made.fill(TEXT, RESULTS) == TEXT, "run python tools/make_readme_tables.py"


def test_a_table_without_its_json_is_left_out(tmp_path):
    made = tool("tools/make_readme_tables.py")
    bare = made.fill(TEXT, tmp_path)
    assert "<!-- table:real_samples -->\n<!-- end:real_samples -->" in bare
    assert made.fill(bare, RESULTS) == TEXT
    (tmp_path / "demo.json").write_text("{}")
    with pytest.raises(ValueError, match=r"demo\.json: not as its tool writes it"):
        made.fill(TEXT, tmp_path)
    with pytest.raises(ValueError, match="table:other is unknown"):
        made.fill("<!-- table:other -->\n<!-- end:other -->", tmp_path)


def leaves(value: object) -> list[float]:
    """All numbers of a JSON document."""
    if isinstance(value, dict):
        return [leaf for child in value.values() for leaf in leaves(child)]
    if isinstance(value, list):
        return [leaf for child in value for leaf in leaves(child)]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return [float(value)] if is_number else []


@pytest.mark.parametrize("name", sorted(parts()))
def test_every_number_of_a_table_is_in_its_json(name):
    """Without the tool that made the table: each cell is some number of the file, rounded."""
    rows = [line for line in parts()[name].splitlines() if line.startswith("|")]
    if name == "demo":
        rows = re.findall(r"^(?:hybridvo|OpenCV|identity).*$", parts()[name], re.MULTILINE)
    path = RESULTS / f"{name}.json"
    if not path.exists():
        assert not rows
        pytest.skip(f"{path.name} is not committed: the table is left out")
    known = np.array(leaves(json.loads(path.read_text(encoding="utf-8"))))
    cells = re.findall(r"(?<=[ \[])-?\d+\.?\d*(?:e-?\d+)?(?=[ \]]|$)", "\n".join(rows))
    assert len(cells) > 10
    for cell in cells:
        decimals = len(cell.split("e")[0].partition(".")[2])
        exponent = int(cell.partition("e")[2] or 0)
        half = 0.5000001 * 10.0 ** (exponent - decimals)
        close = np.abs(known - float(cell)) <= half
        assert close.any(), cell


def test_real_samples_cell_by_cell():
    rows = json.loads((RESULTS / "real_samples.json").read_text(encoding="utf-8"))["rows"]
    lines = [line for line in parts()["real_samples"].splitlines() if "| `" in line]
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[0] in ("", row["sequence"])
        assert cells[1] in ("", row["flow_source"])
        assert cells[2] == f"`{row['method']}`"
        for cell, key in zip(cells[3:6], ("rot_err_deg", "trans_err_cm", "epe_l2_px"), strict=True):
            # the median is made again from the pairs; two digits at least are shown
            median = float(np.median([pair[key] for pair in row["per_pair"]]))
            assert row[f"{key}_median"] == pytest.approx(median, rel=1e-6)
            assert float(cell) == pytest.approx(median, rel=0.051)


def test_results_say_how_they_were_made():
    for path in RESULTS.glob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        # campaigns that can be run one by one say so one by one
        parts = (
            [content]
            if "command" in content
            else [part for name, part in content.items() if name != "machine"]
        )
        assert parts and all(part["command"] for part in parts), path.name


# Other pages


def test_changelog_has_this_version_on_top():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+)", text, re.MULTILINE)[0] == hybridvo.__version__


def test_contributing_is_one_page_of_true_things():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 70
    for span in re.findall(r"`([^`\n]+)`", text):
        if span.startswith(TOP):
            assert (ROOT / span.split()[0]).exists(), span
        if span.startswith("make "):
            makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
            assert re.search(rf"^{span.split()[1]}:", makefile, re.MULTILINE), span


@pytest.mark.parametrize(
    "name", ["make_readme_tables.py", "make_readme_figure.py", "measure_samples.py"]
)
def test_tools_say_what_they_do_and_refuse_what_they_cannot(name, tmp_path):
    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(ROOT / "tools" / name), *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True)

    assert call("--help").returncode == 0
    if name == "make_readme_tables.py":
        assert call("--check").returncode == 0
        refused = call("--readme", tmp_path / "none.md")
    else:
        there = tmp_path / "there"
        there.write_text("kept")
        refused = call("--out", there)
        assert there.read_text() == "kept"
    assert refused.returncode == 2
    assert refused.stderr.startswith(name)
    assert "Traceback" not in refused.stderr
