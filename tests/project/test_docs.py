"""README and pages are true: commands parse, paths exist, tables are those of the tool."""

from __future__ import annotations

import importlib
import json
import re
import shlex

import pytest

import hybridvo
from hybridvo.network.weights import PRETRAINED
from hybridvo.run.commands.arguments import build_parser
from hybridvo_lab.synthetic.recordings import SPLITS
from hybridvo_lab.synthetic.turned_windows import TRAINING
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
        if first.startswith(
            "examples/"
        ):  # tests/examples/test_examples.py runs them
            return
        script = load_script(first)
        if first == "tools/benchmark.py" and rest:
            script = importlib.import_module(f"bench.{rest.pop(0)}")
        if hasattr(script, "build_parser"):  # a thin door parses elsewhere
            script.build_parser().parse_args(rest)


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


def anchors(text: str) -> set[str]:
    """Names of the headings of a page, by the rule of repositories and of the site."""
    code = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.*)$", code.sub("", text), re.MULTILINE)
    plain = (re.sub(r"[^\w\s-]", "", title).strip().lower() for title in titles)
    return {title.replace(" ", "-") for title in plain}


@pytest.mark.parametrize(
    "page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix()
)
def test_every_part_of_a_page_that_is_linked_exists(page):
    text = page.read_text(encoding="utf-8")
    assert not [name for name in anchors(text) if "--" in name], (
        "the site joins them"
    )
    for link, part in re.findall(r"\]\(([^)#:]*\.md)?#([^)]+)\)", text):
        target = page.parent / link if link else page
        assert part in anchors(target.read_text(encoding="utf-8")), f"{link}#{part}"


def test_every_page_has_a_place_in_the_navigation():
    site = (ROOT / "configs/mkdocs.yml").read_text(encoding="utf-8")
    pages = {page.name for page in (ROOT / "docs").glob("*.md")}
    assert {name for name in pages if f": {name}\n" not in site} == set()


def test_every_reason_that_is_explained_can_occur():
    produced = "\n".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "hybridvo").rglob("*.py")
        if path.name != "advice.py"
    )
    reasons = [reason for reason in hybridvo.Reason if reason.value]
    assert [r.name for r in reasons if f"Reason.{r.name}" not in produced] == []
    outputs = (ROOT / "docs/outputs.md").read_text(encoding="utf-8")
    missing = [r.value for r in reasons if f"| `{r.value}` |" not in outputs]
    assert missing == [], "add a row to docs/outputs.md, Status and reason"


def test_public_names_that_are_written_exist():
    for page in PAGES:
        for name in re.findall(r"\bhvo\.(\w+)", page.read_text(encoding="utf-8")):
            assert hasattr(hybridvo, name), f"{page.name}: hvo.{name}"


def test_generated_tables_are_those_of_the_tool():
    made = load_script("tools/make_docs.py")
    results = made.read(ROOT / "docs/results")
    for path in (ROOT / "README.md", *(ROOT / "docs" / n for n in made.FILLED)):
        filled = path.read_text(encoding="utf-8")
        assert made.PART.search(filled), f"{path.name}: nothing to fill"
        assert made.fill(filled, results) == filled, "run python tools/make_docs.py"
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    assert made.page(results) == page, "run python tools/make_docs.py"
    assert page.count("\n## ") <= 7


def test_the_model_card_has_what_the_weights_were_made_of():
    page = (ROOT / "docs/model-card.md").read_text(encoding="utf-8")
    card = json.loads((PRETRAINED / "pwvo.json").read_text(encoding="utf-8"))
    for run in (card, card["began_with"]):
        assert f"{run['updates']} updates" in page
        assert f"{run['samples']} presentations" in page
    named = re.findall(r"data/[\w/]+\w", card["recordings"])
    sources = [
        source.path for place in SPLITS["train"].values() for source in place
    ]
    names = [path.rpartition("/")[2] for path in sources]
    for recording in (*named, *names, *TRAINING):
        assert f"{recording}`" in page, recording


def test_results_say_how_they_were_made_and_stay_small():
    files = list((ROOT / "docs/results").iterdir())
    assert sum(path.stat().st_size for path in files) < 600_000
    made = load_script("tools/make_docs.py")
    for name, content in made.read(ROOT / "docs/results").items():
        for part in [content] if "command" in content else content.values():
            assert part["command"], name
            assert part["commit"], name


def test_the_picture_of_the_rooms_is_that_of_the_layers():
    drawn = load_script("tools/draw_rooms.py")
    picture = (ROOT / "docs/figures/rooms.svg").read_text(encoding="utf-8")
    assert drawn.picture() == picture, "run python tools/draw_rooms.py"
