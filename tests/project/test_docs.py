"""README and pages are true: commands parse, paths exist, tables are those of the tool."""

from __future__ import annotations

import re
import shlex

import pytest

import hybridvo
from hybridvo.lab.evaluation import report
from hybridvo.lab.evaluation.protocols import protocols
from hybridvo.run.commands.arguments import build_parser
from tests.scripts import ROOT, load_script

PAGES = sorted(
    [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
        *(ROOT / "docs").rglob("*.md"),
        ROOT / "examples" / "README.md",
    ]
)
TOP = ("hybridvo/", "tools/", "tests/", "configs/", "docs/", "examples/", ".ci/")


def spans(text: str) -> list[str]:
    """What stands in backquotes, outside of code blocks."""
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"`([^`\n]+)`", prose)


def commands(text: str) -> list[str]:
    """Command lines of shell blocks and of the prose."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()]
    lines = [line.split(" #")[0].strip() for line in [*lines, *spans(text)]]
    lines = [
        line for line in lines if re.match(r"(make|hybridvo|python) [^<\[]*$", line)
    ]
    # a command that is named in passing has no arguments
    return [
        line
        for line in lines
        if re.match(r"make |\w+ \S+ \S", line)
        and line.split()[2:] != ["--sequence"]
    ]


def written() -> list[tuple[str, str]]:
    found = [
        (page.relative_to(ROOT).as_posix(), command)
        for page in PAGES
        if page.name != "results.md"  # its commands ran at the commit that is named
        for command in commands(page.read_text(encoding="utf-8"))
    ]
    return sorted(set(found))


@pytest.fixture(autouse=True)
def _tools_import_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


@pytest.mark.parametrize(("page", "command"), written())
def test_every_command_is_understood(page, command):
    program, first, *rest = shlex.split(command)
    if program == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        assert re.search(rf"^{first}:", makefile, re.MULTILINE)
    elif program == "hybridvo":
        if rest[-2:] == ["--set", "help"]:  # prints the options and ends
            with pytest.raises(SystemExit, match="0"):
                build_parser().parse_args([first, *rest])
        elif first != "train" or len(rest) > 1:  # else only the name of the command
            build_parser().parse_args([first, *rest])
    elif first.endswith(".py"):
        assert (ROOT / first).is_file()
        if first.startswith("examples/"):  # tests/unit/test_examples.py runs them
            return
        script = load_script(first)
        if hasattr(script, "build_parser"):  # a thin door parses elsewhere
            script.build_parser().parse_args(rest)


def test_doctests_of_the_reference_are_shown_as_code():
    pytest.importorskip("griffe")
    pytest.importorskip("mkdocs")
    hooks = load_script("configs/docs_hooks.py")
    text = """Add.

Example:
    >>> add(1, 2)  # doctest: +SKIP
    3

Returns:
    The sum.

>>> add(
...     2, 2
... )
4"""
    assert (
        hooks.fenced(text)
        == """Add.

Example:
    ```pycon
    >>> add(1, 2)
    3
    ```

Returns:
    The sum.

```pycon
>>> add(
...     2, 2
... )
4
```"""
    )


def test_references_of_the_reference_are_shown_as_names():
    pytest.importorskip("griffe")
    pytest.importorskip("mkdocs")
    hooks = load_script("configs/docs_hooks.py")
    text = "See :class:`RelativePose`, :func:`~hybridvo.api.estimate`: ``a:b``."
    expected = "See `RelativePose`, `estimate`: ``a:b``."
    assert hooks.without_roles(text) == expected


def test_there_are_commands_to_check():
    assert len(written()) > 10


@pytest.mark.parametrize(
    "page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix()
)
def test_every_path_exists(page):
    text = page.read_text(encoding="utf-8")
    for span in spans(text):
        word = span.split()[0]
        if (
            word.startswith(TOP)
            and not set("*<>{}") & set(word)
            and word.upper() != word
        ):
            assert (ROOT / word).exists(), word
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        if "://" not in link:
            assert (page.parent / link).exists(), link


def test_every_tool_is_named_by_something_else():
    """A script that no page, test or other tool names is a door that nobody finds."""
    texts = [
        path.read_text(encoding="utf-8") for path in [*PAGES, ROOT / "Makefile"]
    ]
    for folder in ("tools", "tests", "hybridvo"):
        for path in (ROOT / folder).rglob("*.py"):
            # a tool that names itself in its own docstring does not count
            text = path.read_text(encoding="utf-8")
            texts.append(text.replace(f"tools/{path.name}", ""))
    everything = "\n".join(texts)
    unnamed = [
        path.name
        for path in (ROOT / "tools").glob("*.py")
        if f"tools/{path.name}" not in everything
        and f"from {path.stem} import" not in everything
        and f"import {path.stem}\n" not in everything
    ]
    assert not unnamed


def test_no_two_files_of_options_are_the_same():
    files = [
        *(ROOT / "configs").rglob("*.yaml"),
        *(ROOT / "hybridvo").rglob("*.yaml"),
    ]
    contents = [path.read_bytes() for path in files]
    twins = [
        path.relative_to(ROOT).as_posix()
        for path, content in zip(files, contents, strict=True)
        if contents.count(content) > 1
    ]
    assert not twins


def test_every_reason_that_is_explained_can_occur():
    produced = "\n".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "hybridvo").rglob("*.py")
        if path.name != "advice.py"
    )
    reasons = [reason for reason in hybridvo.Reason if reason.value]
    assert [r.name for r in reasons if f"Reason.{r.name}" not in produced] == []
    outputs = (ROOT / "docs/outputs.md").read_text(encoding="utf-8")
    assert [r.value for r in reasons if f"| `{r.value}` |" not in outputs] == []


def test_a_caption_speaks_of_rows_that_its_table_has():
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    for table, caption in re.findall(
        r"((?:^\|.*\n)+)\n(.*`without` a part.*)", page, re.MULTILINE
    ):
        assert "| `without" in table, caption


def test_the_parts_of_the_seed_are_worth_what_the_pages_say():
    """The parts of which pages say that they matter cost answers when they are left out."""
    sets = load_script("tools/make_docs.py").read(ROOT / "docs/results")
    sets = sets["sentence"]["sets"]

    def wrong(start: str) -> int:
        (name,) = (name for name in sets["heavy"]["rows"] if name.startswith(start))
        return sum(each["rows"][name]["wrong"]["count"] for each in sets.values())

    parts = ("uncertainty", "the covariance", "a seed")
    costs = {part: wrong(f"without {part}") - wrong("all parts") for part in parts}
    assert min(costs.values()) > 0, costs
    # the page says that the hypothesis is as good inside the region
    assert abs(wrong("without patch poses") - wrong("all parts")) <= 2


def test_the_layout_names_every_room():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    layout = text.partition("## Layout")[2].partition("\n## ")[0]
    rooms = [
        f"hybridvo/{path.name}" + "/" * path.is_dir()
        for path in (ROOT / "hybridvo").iterdir()
        if path.name not in ("__pycache__", "py.typed")
    ]
    assert not [room for room in rooms if f"`{room}`" not in layout]


def test_the_layout_says_what_every_folder_of_tests_is_for():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| `tests/` \|.*$", text, re.MULTILINE)
    package = {path.name for path in (ROOT / "hybridvo").iterdir()}
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir()}
    others = folders - package - {"__pycache__"}
    assert sorted(name for name in others if f"`{name}/`" not in row) == []


NOT_TRUE_OF_OUR_PWVO = (
    "it predicts the camera's pose and how uncertain",
    "A pose and its uncertainty at every pixel**, as in the paper",
    "The paper's idea is kept",
    "predicts a pose with uncertainty at every pixel",
    "selector is gone",
)
"""Sentences about the network that ships, which its maps refute."""
WHAT_PWVO_IS = {
    "README.md": (
        "pose repeats the hypothesis",
        "come from geometry",
        "score decides",
        "earlier network",
    ),
    "CHANGELOG.md": ("pose repeats the hypothesis", "score decides", "earlier"),
    "docs/how-it-works.md": (
        "repeats the hypothesis",
        "The score decides",
        "earlier",
    ),
    "docs/training.md": (
        "repeats the hypothesis",
        "score decides",
        "earlier network",
    ),
    "docs/methods.md": (
        "pose repeats the hypothesis",
        "score decides",
        "log P(static)",
    ),
}
"""What each page must say, as tests/network/test_hypothesis_pwvo.py measures it."""


def test_pages_say_what_the_network_called_pwvo_is():
    pages = [*PAGES, ROOT / "CHANGELOG.md"]
    for page in pages:
        text = " ".join(page.read_text(encoding="utf-8").split())
        assert [said for said in NOT_TRUE_OF_OUR_PWVO if said in text] == [], (
            page.name
        )
    for name, needed in WHAT_PWVO_IS.items():
        text = " ".join((ROOT / name).read_text(encoding="utf-8").split())
        assert [part for part in needed if part not in text] == [], name
        assert "uncertainty is the static mask" in text.replace("U is", "is"), name


def test_public_names_that_are_written_exist():
    for page in PAGES:
        for name in re.findall(r"\bhvo\.(\w+)", page.read_text(encoding="utf-8")):
            assert hasattr(hybridvo, name), f"{page.name}: hvo.{name}"


def test_generated_tables_are_those_of_the_tool():
    made = load_script("tools/make_docs.py")
    results = made.read(ROOT / "docs/results")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert made.fill(readme, results) == readme, "run python tools/make_docs.py"
    for name in ("paper.md", "scale.md", "moving-people.md", "uncertainty.md"):
        filled = (ROOT / "docs" / name).read_text(encoding="utf-8")
        assert made.fill(filled, results) == filled, "run python tools/make_docs.py"
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    assert made.page(results) == page, "run python tools/make_docs.py"
    assert page.count("\n## ") <= 6


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
    grid = load_script("tools/benchmark_thresholds.py")
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


def test_results_say_how_they_were_made_and_stay_small():
    files = list((ROOT / "docs/results").iterdir())
    assert sum(path.stat().st_size for path in files) < 600_000
    made = load_script("tools/make_docs.py")
    for name, content in made.read(ROOT / "docs/results").items():
        for part in [content] if "command" in content else content.values():
            assert part["command"], name
            assert part["commit"], name


def test_the_benchmark_scores_what_is_known():
    """One scenario, one pair: the refinement is right, and no motion is not."""
    benchmark = load_script("tools/benchmark.py")
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
