from __future__ import annotations

import csv
import html
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from hybridvo.evaluation.plots_comparison import Series, duration_svg, timing_svg
from hybridvo.evaluation.report_data import Path3D, shown_box
from hybridvo.evaluation.report_page import write_report
from hybridvo.evaluation.report_tables import number
from hybridvo.evaluation.report_view3d import project, view_svg

from hybridvo.errors import FormatError, InputError
from hybridvo.evaluation.breakdown import FACTORS, PairTable, breakdown, worst_pairs
from hybridvo.evaluation.protocols import PROTOCOLS, protocol_summary
from hybridvo.geometry import se3_exp
from hybridvo.trajectory import Trajectory, write_tum

METHODS = ("refine", "pnp-ransac", "identity")
FLOWS = ("file (true)", "dis")
HOSTILE = "a<b>&\"c'</script>"
COLUMNS = ("epe_l2_px", "rot_err_deg", "trans_err")


def make_folder(folder: Path, sequences: tuple[str, ...] = ("alley_1", HOSTILE)) -> dict:
    """A results folder of three methods on 24 pairs of each sequence, two flows."""
    rng = np.random.default_rng(0)
    (folder / "trajectories").mkdir(parents=True)
    (folder / "worst").mkdir()
    picture = np.full((40, 80, 3), 90, np.uint8)
    (folder / "worst" / "one.jpg").write_bytes(cv2.imencode(".jpg", picture)[1].tobytes())
    table, rows, pairs, trajectories = PairTable(), [], [], []
    for s, name in enumerate(sequences):
        steps = [se3_exp(np.array([0.02, 0.0, 0.1, 0.0, 0.01, 0.0])) for _ in range(24)]
        stamps = np.arange(25) / 24
        named = {"sequence": name, "method": None, "flow_source": None}
        path = f"trajectories/{s}_truth.tum"
        write_tum(Trajectory.from_relative(steps, stamps), folder / path)
        trajectories.append(named | {"path": path})
        for m, method in enumerate(METHODS):
            for f, flow in enumerate(FLOWS):
                noisy = [se3_exp(0.01 * m * rng.standard_normal(6)) @ step for step in steps]
                path = f"trajectories/{s}_{m}_{f}.tum"
                write_tum(Trajectory.from_relative(noisy, stamps), folder / path)
                named = {"sequence": name, "method": method, "flow_source": flow}
                trajectories.append(named | {"path": path})
                for index in range(24):
                    failed = method == "pnp-ransac" and index == 3
                    pair = named | {
                        "index": index,
                        "status": "failed(low_inliers)" if failed else "ok",
                        "ms": 5.0 + m + rng.uniform(),
                        **dict(zip(COLUMNS, (10.0**m) * rng.uniform(0.1, 0.2, 3), strict=True)),
                        **{key: value.edges[2] * 1.1 for key, value in FACTORS.items()},
                        "dynamic_fraction": None if index == 5 else 0.3,
                    }
                    table.add(pair)
                    pairs.append(pair)
                row = named | {"depth_source": "true", "pairs": 24, "failed": 0, "alignment": "se3"}
                row |= {"epe_l2_px": rng.uniform(), "ate_rmse": rng.uniform(), "epe": rng.uniform()}
                row |= {"rot_err_deg_median": rng.uniform(), "reasons": {"kitti": "x"}}
                if method == "identity":
                    row |= {"ate_rmse": None, "reasons": {"ate_rmse": "the camera stands still"}}
                rows.append(row)
    worst = worst_pairs(table, 2)
    for k, pair in enumerate(worst):
        pair |= {"status": "ok", "message": "", "picture": "worst/one.jpg" if k % 2 else None}
        pair |= {"picture_reason": None if k % 2 else "the frame cannot be read"}
    totals = [
        {
            **{"sequence": "all", "method": method, "flow_source": flow, "depth_source": "true"},
            **{"pairs": 48, "failed": 0, "pairs_scored": 48, "sequences": 2, "reasons": {}},
            **{key: float(rng.uniform()) for key in ("epe_l2_px_median", "rot_err_deg_median")},
            **{key: float(rng.uniform()) for key in ("epe", "r_err_deg", "t_err", "ate_rmse")},
        }
        for method in METHODS
        for flow in FLOWS
    ]
    result = {
        "command": ["tools/compare_methods.py", "--sequence", "a b"],
        "versions": {"hybridvo": "0.1.0", "numpy": "2"},
        "machine": {"platform": "test", "cpus": 2},
        "missing": {"hybrid": "method 'hybrid' needs weights"},
        "rows": rows,
        "totals": totals,
        "trajectories": trajectories,
        "breakdown": breakdown(table),
        "worst_pairs": worst,
        "protocol": protocol_summary(
            PROTOCOLS["paper"], totals, [{"name": name, "pairs": 24} for name in sequences]
        ),
    }
    (folder / "results.json").write_text(json.dumps(result))
    with (folder / "pairs.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(pairs[0]))
        writer.writeheader()
        writer.writerows(pairs)
    return result


class Reader(HTMLParser):
    """Checks that elements are closed in order, and collects attributes, ids and table cells."""

    VOID = frozenset(("meta", "img", "br", "link", "input", "hr"))

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.rows: dict[str, list[list[dict[str, str]]]] = {}
        self.table = ""

    def handle_starttag(self, tag: str, attrs: list) -> None:
        attributes = {key: value or "" for key, value in attrs}
        self.tags.append((tag, attributes))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "table":
            self.table = attributes["id"]
            self.rows[self.table] = []
        if tag == "tr":
            self.rows[self.table].append([])
        if tag == "td":
            self.rows[self.table][-1].append(attributes | {"text": ""})

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> at {self.getpos()}, {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "td":
            self.rows[self.table][-1][-1]["text"] += data


def read(path: Path) -> tuple[str, Reader]:
    text = path.read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    return text, reader


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "results"
    make_folder(path)
    assert write_report(path) == [path / "report.html", path / "report.md"]
    return path


def test_the_page_stands_alone(folder: Path) -> None:
    text, reader = read(folder / "report.html")
    assert "default-src 'none'" in text
    for tag, attributes in reader.tags:
        assert tag not in ("link", "iframe", "object", "base")
        for name in ("src", "href", "data", "srcset"):
            target = attributes.get(name, "#")
            assert target.startswith(("#", "data:image/")), (tag, target[:60])
    outside = set(re.findall(r"https?://[^\s\"'<>]+", text))
    assert all(address.startswith("http://www.w3.org/") for address in outside), outside
    assert "@import" not in text
    ids = [attributes["id"] for _, attributes in reader.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    referenced = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    assert referenced and referenced <= set(ids)
    assert os.path.getsize(folder / "report.html") < 3_000_000


def test_every_part_is_there(folder: Path) -> None:
    text, reader = read(folder / "report.html")
    for anchor in ("headline", "protocol", "sequences", "breakdown", "timing", "worst"):
        assert f'id="{anchor}"' in text and f'href="#{anchor}"' in text
    plots = [a for tag, a in reader.tags if tag == "svg"]
    # 2 sequences x 4, failures, differences, 5 factors, 2 of time
    assert len(plots) == 2 * 4 + 2 + len(FACTORS) + 2
    assert all(plot["aria-label"] for plot in plots)
    pictures = [a for tag, a in reader.tags if tag == "img"]
    assert len(pictures) == 6 and all(picture["alt"] for picture in pictures)
    assert "the frame cannot be read" in text
    assert "true flow and true depth" in text  # the oracle is named
    assert "tools/compare_methods.py --sequence &#39;a b&#39;" in text
    assert "nothing in them was measured here" in text


def test_tables_hold_the_numbers_of_the_json(folder: Path) -> None:
    result = json.loads((folder / "results.json").read_text())
    _, reader = read(folder / "report.html")
    rows = [row for row in reader.rows["headline-table"] if row]
    assert len(rows) == len(result["totals"])
    rates = {(r["method"], r["flow_source"]): r for r in result["breakdown"]["failure_rates"]}
    for row, total in zip(rows, result["totals"], strict=True):
        assert [cell["text"] for cell in row[:2]] == [total["method"], total["flow_source"]]
        assert float(row[2]["data-v"]) == total["epe_l2_px_median"]
        assert row[2]["text"] == number(total["epe_l2_px_median"])
        assert float(row[6]["data-v"]) == pytest.approx(100 * total["ate_rmse"], rel=1e-12)
        rate = rates[total["method"], total["flow_source"]]["failure_rate"]
        assert float(row[3]["data-v"]) == pytest.approx(100 * rate, rel=1e-12)
    for flow in FLOWS:  # one best method for each flow
        best = [r for r in rows if r[1]["text"] == flow and "best" in r[2].get("class", "")]
        values = [float(r[2]["data-v"]) for r in rows if r[1]["text"] == flow]
        assert [float(r[2]["data-v"]) for r in best] == [min(values)]
    assert "best" not in rows[4][9]["class"]  # doing nothing is no fast method
    measured = [row for row in reader.rows["protocol-table"] if row]
    theirs = {line["name"]: line for line in result["protocol"]["published"]}
    assert float(measured[0][4]["data-v"]) == result["totals"][0]["epe"]
    published = [row for row in reader.rows["published-table"] if row]
    for row in published:
        assert float(row[1]["data-v"]) == theirs[row[0]["text"]]["epe"]


def test_what_is_not_known_is_a_dash_with_its_reason(folder: Path) -> None:
    _, reader = read(folder / "report.html")
    rows = [row for row in reader.rows["sequence-table"] if row]
    cell = next(row for row in rows if row[1]["text"] == "identity")[11]
    assert cell["text"] == "-" and cell["data-v"] == ""
    assert cell["title"] == "the camera stands still"
    assert "- `-`: the camera stands still" in (folder / "report.md").read_text()


def test_names_cannot_become_markup(folder: Path) -> None:
    text, reader = read(folder / "report.html")
    assert html.escape(HOSTILE) in text.replace("&#34;", "&quot;").replace("&#39;", "&#x27;")
    assert HOSTILE not in text
    assert sum(tag == "script" for tag, _ in reader.tags) == 1


def test_every_colour_is_defined_in_both_themes(folder: Path) -> None:
    text, _ = read(folder / "report.html")
    used = set(re.findall(r"var\(--([\w-]+)\)", text))
    assert {"ink", "grid", "s0", "s1", "s2"} <= used
    for start in (":root {", ':root[data-theme="dark"] {', ':root:not([data-theme="light"]) {'):
        blocks = [
            text[i.end() : text.index("}", i.end())] for i in re.finditer(re.escape(start), text)
        ]
        defined = set(re.findall(r"--([\w-]+):", " ".join(blocks)))
        assert used <= defined, (start, used - defined)
    assert "#0a0b" not in text and "#0a0c" not in text  # no stand-in for a colour is left


def test_labels_of_axes_keep_their_digits(folder: Path) -> None:
    text, _ = read(folder / "report.html")
    labels = re.findall(r"<text[^>]*>([^<]+)</text>", text)
    powers = {float(label) for label in labels if re.fullmatch(r"[\d.]+(e-?\d+)?", label)}
    assert {1e-5, 0.001, 0.01, 0.1, 1.0, 10.0} <= powers
    assert all(label.strip("0.") or label in ("0", "0.0", "0.00") for label in labels)


def test_the_same_folder_gives_the_same_bytes(folder: Path) -> None:
    before = [(folder / name).read_bytes() for name in ("report.html", "report.md")]
    write_report(folder)
    assert [(folder / name).read_bytes() for name in ("report.html", "report.md")] == before


def test_markdown_has_the_same_numbers(folder: Path) -> None:
    text = (folder / "report.md").read_text()
    result = json.loads((folder / "results.json").read_text())
    for total in result["totals"]:
        start = f"| {total['method']} | {total['flow_source']} |"
        line = next(line for line in text.splitlines() if line.startswith(start))
        assert number(total["epe_l2_px_median"]) in line
    tables = re.findall(r"((?:^\|.*\n)+)", text, re.MULTILINE)
    for table in tables:
        counts = {re.sub(r"\\\|", "", line).count("|") for line in table.splitlines()}
        assert len(counts) == 1


def test_only_results_json_is_needed(tmp_path: Path) -> None:
    row = {"sequence": "x", "method": "refine", "flow_source": None, "pairs": 0, "failed": 0}
    (tmp_path / "results.json").write_text(json.dumps({"rows": [row]}))
    write_report(tmp_path)
    text, reader = read(tmp_path / "report.html")
    assert not [tag for tag, _ in reader.tags if tag == "svg"]
    assert "Worst pairs" not in text
    assert [row[1]["text"] for row in reader.rows["headline-table"] if row] == ["none"]


@pytest.mark.parametrize(
    ("content", "kind", "message"),
    [
        (None, InputError, "no such file"),
        ("{", FormatError, "expected JSON"),
        ("[]", FormatError, "expected a JSON object"),
        ('{"rows": []}', FormatError, "a list 'rows'"),
        ('{"rows": [{"method": "x"}]}', FormatError, "a list 'rows'"),
    ],
)
def test_bad_folders(tmp_path: Path, content: str | None, kind: type, message: str) -> None:
    if content is not None:
        (tmp_path / "results.json").write_text(content)
    with pytest.raises(kind, match=message):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_files_outside_of_the_folder_are_not_read(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    result = make_folder(folder, ("x",))
    (tmp_path / "secret.tum").write_text("0 0 0 0 0 0 0 1\n")
    result["trajectories"][0]["path"] = "../secret.tum"
    (folder / "results.json").write_text(json.dumps(result))
    with pytest.raises(FormatError, match="leads out of the folder"):
        write_report(folder)
    result["trajectories"] = []
    result["worst_pairs"][0]["picture"] = "../secret.jpg"
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (folder / "results.json").write_text(json.dumps(result))
    with pytest.raises(FormatError, match="leads out of the folder"):
        write_report(folder)


def test_broken_parts_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    result = make_folder(folder, ("x",))
    (folder / "results.json").write_text(json.dumps(result | {"breakdown": {"cells": 3}}))
    with pytest.raises(FormatError, match=r"results\.json: not as"):
        write_report(folder)
    (folder / "results.json").write_text(json.dumps(result))
    (folder / "pairs.csv").write_text("sequence,method\n1,2\n")
    with pytest.raises(FormatError, match=r"pairs\.csv: not as"):
        write_report(folder)


# -- the 3-D view ---------------------------------------------------------------------------------


def test_projection_by_hand() -> None:
    point = np.array([[1.0, 2.0, 3.0]])
    # from straight above: x to the right, z upwards, height plays no part
    np.testing.assert_allclose(project(point, 0.0, np.pi / 2), [[1.0, -3.0]], atol=1e-12)
    # along z at ground level: y points down in the camera and in the picture
    np.testing.assert_allclose(project(point, 0.0, 0.0), [[1.0, 2.0]], atol=1e-12)
    # a quarter turn: the viewer looks along x
    np.testing.assert_allclose(project(point, np.pi / 2, 0.0), [[-3.0, 2.0]], atol=1e-12)


def test_a_runaway_does_not_squash_the_others() -> None:
    line = np.linspace(0, 1, 20)[:, None] * np.array([1.0, 0.0, 1.0])
    truth = Path3D(None, line, None, np.arange(20.0))
    away = Path3D(None, 1e6 * line, None, np.arange(20.0))
    object.__setattr__(away, "series", object())
    low, high = shown_box([truth, away])
    assert np.ptp([low, high], axis=0).max() < 4.0
    still = Path3D(None, np.zeros((3, 3)), None, np.arange(3.0))
    low, high = shown_box([still])
    assert (high > low).all() and (high - low).max() < 0.1
    assert "NaN" not in view_svg([still], "still") and "nan" not in view_svg([still], "still")


# -- in a browser ---------------------------------------------------------------------------------

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
PROBE = """
<script>
addEventListener("load", () => {
  const all = (selector, from) => [...(from ?? document).querySelectorAll(selector)];
  const root = document.documentElement;
  const found = {ready: root.dataset.ready, wider: root.scrollWidth - innerWidth};
  const visible = e => Math.min(e.getBoundingClientRect().width, e.getBoundingClientRect().height);
  found.tables = all("table").filter(e => visible(e) > 50).length;
  found.plots = all("svg.plot").filter(e => visible(e) > 50).length;
  found.drawn = all("svg.plot path").filter(e => e.getTotalLength() > 5).length;
  found.pictures = all("img").filter(e => e.complete && e.naturalWidth > 1).length;
  const table = document.getElementById("headline-table");
  const head = all("th", table).find(h => h.textContent.startsWith("EPE"));
  const values = () => all("tbody tr", table).map(r => r.cells[head.cellIndex].dataset.v);
  head.firstElementChild.click(); found.up = values();
  head.firstElementChild.click(); found.down = values();
  found.sorted = head.getAttribute("aria-sort");
  const view = document.querySelector(".view3d"), line = view.querySelector(".m1");
  const points = () => line.getAttribute("points").split(/[ ,]/).map(Number);
  found.written = points();
  turn(view); found.same = points();
  move(view, 0.5, 0.1); found.turned = points();
  const method = document.querySelector('#legend button[data-hide="m1"]');
  const shown = () => all(".m1").filter(e => getComputedStyle(e).display !== "none").length;
  found.before = shown(); method.click(); found.hidden = shown();
  found.pressed = method.getAttribute("aria-pressed");
  const paper = () => getComputedStyle(document.body).backgroundColor;
  found.themes = [paper()];
  document.getElementById("theme").click(); found.themes.push(paper());
  document.title = JSON.stringify(found);
});
</script>
"""


def probe(folder: Path, tmp_path: Path, width: int) -> dict:
    """What the page's own elements look like in a browser of this width."""
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = tmp_path / "probed.html"
    page.write_text(text.replace("</body>", PROBE + "</body>"), encoding="utf-8")
    assert BROWSER is not None
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--no-first-run", f"--user-data-dir={tmp_path / 'profile'}"]
    command += [f"--window-size={width},2000", f"--screenshot={tmp_path / 'shot.png'}"]
    done = subprocess.run(
        [*command, "--virtual-time-budget=5000", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title, done.stderr[-2000:]
    return json.loads(html.unescape(title[1]))


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed (Debian: chromium)")
@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
def test_the_page_in_a_browser(folder: Path, tmp_path: Path, width: int) -> None:
    found = probe(folder, tmp_path, width)
    assert found["ready"] == "yes"
    assert found["wider"] <= 0  # nothing sticks out sideways
    assert found["tables"] >= 3
    assert found["plots"] == 2 * 4 + 2 + len(FACTORS) + 2
    assert found["drawn"] > 100
    assert found["pictures"] >= 1
    up = [float(value) for value in found["up"]]
    assert up == sorted(up) and len(set(up)) > 1
    assert [float(value) for value in found["down"]] == up[::-1]
    assert found["sorted"] == "descending"
    # the script projects as the page was written; both round to a tenth of a unit of some 400
    written, same, turned = (np.array(found[key]) for key in ("written", "same", "turned"))
    np.testing.assert_allclose(same, written, atol=0.25)
    assert np.abs(turned - written).max() > 5.0
    assert found["before"] > 10 and found["hidden"] == 0 and found["pressed"] == "false"
    assert found["themes"][0] != found["themes"][1]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("ms", [168.1676930936777, 0.022931544755345156, 1.0, 47.332029160100475])
@pytest.mark.parametrize("count", [1, 2])
def test_one_time_alone_has_room_on_its_axis(ms: float, count: int) -> None:
    """Of a logarithmic axis about one value matplotlib's rounding leaves nothing, at times."""
    lines = [
        {"series": Series(f"m{k}", "dis", k, 0)}
        | dict.fromkeys(("ms_median", "ms_q25", "ms_q75"), ms)
        | dict.fromkeys(("epe_l2_px_median", "epe_l2_px_q25", "epe_l2_px_q75"), 1.0)
        for k in range(count)
    ]
    assert "<svg" in duration_svg(lines, "title", "one")
    assert "<svg" in timing_svg(lines, "title", "two")
