"""Words that are gone: the field has a better one, which docs/glossary.md names."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from tests.project import source_tree as source

GLOSSARY = source.ROOT / "docs" / "glossary.md"
GOING = {
    # not yet enforced: they still stand in the package. A word that has gone moves, with
    # what stands in its place, into the table at the end of the glossary
    "mover": "moving object",
    "world": "static scene; the world frame keeps its name",
    "truth": "ground truth",
    "facts": "statistics of a hypothesis: HypothesisStats",
    "gap": "frames passed over; score margin",
    "light": "gain and offset",
    "told": "observable; stated",
    "said, says, asked": "states, predicts, requests",
    "hears, heeds": "uses; weighs",
    "doubt": "uncertainty; warning",
    "share": "fraction, ratio",
    "spread": "standard deviation",
    "seen": "visible; known; found",
    "how": "noise and kernel; rule",
    "crowd": "scene with many objects",
    "settled": "unambiguous; significant",
    "trust": "weight; uncertainty",
    "cells": "grid cells; tiles",
    "least, most": "min, max",
    "few": "subset",
}


def unused_words() -> list[str]:
    """The first column of the glossary's table of words that are not used."""
    text = GLOSSARY.read_text(encoding="utf-8")
    table = text.partition("| not used | instead |\n|---|---|\n")[2]
    words = [line.split("|")[1].strip() for line in table.splitlines()]
    return [word for entry in words for word in entry.split(", ")]


def pattern(word: str) -> re.Pattern[str]:
    """What finds a word: names of code as they are written, others in any case."""
    if found := re.fullmatch(r"method `(\w+)`", word):
        name = found[1]
        return re.compile(
            rf"methods?[ =`'\"]{{1,3}}{name}\b(?!ment)|[Mm]ethod `{name}`"
        )
    name = word.strip("`")
    is_code = name != name.lower() or "_" in name
    return re.compile(rf"(?<!\w){re.escape(name)}(?!\w)", 0 if is_code else re.I)


def texts() -> Iterator[tuple[str, str]]:
    """Path and text of every file in which the words must not stand."""
    root = source.ROOT
    paths = [*root.glob("*.md"), root / "Makefile", root / "pyproject.toml"]
    for folder in ("hybridvo", "tools", "docs", "configs", "examples"):
        for kind in ("*.py", "*.md", "*.yaml", "*.yml", "*.txt", "*.html"):
            paths += (root / folder).rglob(kind)
    for path in sorted(paths):
        # the changelog names what was renamed, results.md the commands of earlier versions
        if path.name not in ("CHANGELOG.md", "results.md", GLOSSARY.name):
            yield (
                path.relative_to(root).as_posix(),
                path.read_text(encoding="utf-8"),
            )


@pytest.mark.parametrize("word", unused_words())
def test_a_word_that_is_gone_stays_away(word: str) -> None:
    found = [
        f"{name}: {match[0]}"
        for name, text in texts()
        if not (word.startswith("method ") and name.endswith(".py"))
        for match in pattern(word).finditer(text)
    ]
    assert not found


def test_the_glossary_lists_words() -> None:
    assert len(unused_words()) > 20
    assert "mission" in unused_words()


@pytest.mark.parametrize(
    ("word", "text", "is_found"),
    [
        ("mission", "The Mission in four lines", True),
        ("mission", "permission, submission", False),
        ("`LITTLE`", "LITTLE = 0.1", True),
        ("`LITTLE`", "a little", False),
        ("method `refine`", "--method refine", True),
        ("method `refine`", "--methods refine,pwvo", True),
        ("method `refine`", 'method="refine"', True),
        ("method `refine`", "the method `refine`", True),
        ("method `refine`", "--method pwvo-refine", False),
        ("method `refine`", "a method refinement", False),
    ],
)
def test_words_are_found_as_a_reader_finds_them(
    word: str, text: str, is_found: bool
) -> None:
    assert bool(pattern(word).search(text)) == is_found
