"""Words that are gone: the field has a better one, which docs/glossary.md names."""

from __future__ import annotations

import functools
import io
import re
import tokenize
from typing import NamedTuple

import pytest

from tests.project import source_tree as source

GLOSSARY = source.ROOT / "docs" / "glossary.md"


class Rule(NamedTuple):
    """Where a word that has other meanings as well must not stand."""

    prose: str = ""
    """Pattern in comments, docstrings, messages and pages."""
    names: str = ""
    """Pattern in the names of code."""
    only_in: tuple[str, ...] = ("",)
    """Starts of the paths that are searched."""


RULES = {
    "mover": Rule(r"movers?", r"movers?"),
    "world": Rule(
        r"(?<!camera to )(?<!camera-to-)worlds?(?! frame)(?! to camera)(?!-to-camera)"
    ),
    "truth": Rule(r"(?<!ground )truths?(?!:)"),
    "facts": Rule(r"facts", r"facts?"),
    "gap": Rule(
        r"gaps?",
        r"gap",
        (
            *("hybridvo/refinement", "hybridvo/hypotheses", "hybridvo/network"),
            *("hybridvo/synthetic", "hybridvo/training", "hybridvo/photometric"),
        ),
    ),
    "light": Rule(
        r"light", r"light", ("hybridvo/photometric", "hybridvo/refinement")
    ),
    "told": Rule(r"told|tells?"),
    "said, says, asked": Rule(r"said|says?(?![:=])|asks?|asked"),
    "hears, heeds": Rule(r"hears?|heard|heeds?"),
    "doubt": Rule(r"doubt(s|ful)?", r"doubt(s|ful)?"),
    "share": Rule(
        r"shares? of|(a|the|this|its|which|that|same|moving|target) shares?",
        r"shares?",
    ),
    "spread": Rule(r"spreads?", r"spreads?"),
    "seen": Rule(r"seen", r"seen"),
    "how": Rule("", r"^how$"),
    "crowd": Rule(r"crowd(s|ed)?", r"crowd(s|ed)?"),
    "settled": Rule(r"settled?", r"settled?"),
    "trust": Rule(r"trust(s|ed)?", r"trust(s|ed)?"),
    "cells": Rule(r"of the cells"),
    "least, most": Rule("", r"^(least|most)"),
    "few": Rule("", r"^few$"),
}
"""A word of the glossary's second table -> where it must not stand."""

PUBLIC_NAMES = {
    # keys of the files of presets and recipes
    *("degraded_share", "dis_share", "backward_share", "final_share"),
    "no_motion_share",
    # hybridvo train --shares
    *("shares", "Shares"),
    # constants of calibration.py, by which tools/golden_mutations.py changes them
    *("MIN_DEPTH_SHARE", "MAX_LATE_SHARE", "MODEL_SHARE", "LIGHT_SIDE"),
    *("DOUBTFUL_SPREAD", "NO_SPREAD", "DEPTH_SPREAD_QUANTILES"),
    # of other libraries
    *("most_common", "least_squares"),
    # here it is the verb
    "_share_frame_numbers",
}
"""Names that keep such a word: users write them in files, or other files name them."""
KEPT = {
    ("hybridvo/photometric", "seen"): "a mask of visible pixels, inside of kernels",
    (
        "hybridvo/photometric",
        "least, most",
    ): "the smallest cost so far, inside of kernels",
    ("hybridvo/motion_model.py", "spread"): "a field of the state of a tracker",
    (
        "hybridvo/commands/text.py",
        "told",
    ): "'cannot tell' is a state that doctor writes",
    ("SECURITY.md", "trust"): "the word of that field",
    ("hybridvo/data/open.py", "trust"): "an argument, as the option --trust",
    ("hybridvo/data/confined/", "trust"): "the option --trust",
    ("hybridvo/cameras/choose.py", "trust"): "the option --trust",
    ("hybridvo/commands/", "trust"): "the option --trust",
}
"""Start of a path and a word -> why it may stay there."""


def column(head: str) -> list[str]:
    """The first column of a table of the glossary, by the head of the table."""
    text = GLOSSARY.read_text(encoding="utf-8")
    table = text.partition(f"{head}\n|---|---|\n")[2].partition("\n\n")[0]
    return [line.split("|")[1].strip() for line in table.splitlines()]


def unused_words() -> list[str]:
    """The words of the glossary that are not used in any sense."""
    words = column("| not used | instead |")
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


@functools.cache
def texts() -> list[tuple[str, str]]:
    """Path and text of every file in which the words must not stand."""
    root = source.ROOT
    paths = [*root.glob("*.md"), root / "Makefile", root / "pyproject.toml"]
    for folder in ("hybridvo", "tools", "docs", "configs", "examples"):
        for kind in ("*.py", "*.md", "*.yaml", "*.yml", "*.txt", "*.html"):
            paths += (root / folder).rglob(kind)
    found = []
    for path in sorted(paths):
        # the changelog names what was renamed, results.md the commands of earlier versions
        if path.name not in ("CHANGELOG.md", "results.md", GLOSSARY.name):
            name = path.relative_to(root).as_posix()
            found.append((name, path.read_text(encoding="utf-8")))
    return found


@functools.cache
def prose(name: str, text: str) -> str:
    """What a reader of a file reads as sentences, on one line."""
    if name.endswith(".py"):
        parts = [
            token.string
            for token in tokenize.generate_tokens(io.StringIO(text).readline)
            if token.type == tokenize.COMMENT
            or (token.type == tokenize.STRING and " " in token.string)
        ]
        text = "\n".join(parts)
        text = re.sub(r"^ *(>>>|\.\.\.).*$", "", text, flags=re.M)
        text = re.sub(r"\{[^{}]*\}", "", text)  # values in messages
    else:
        text = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
        text = re.sub(r"\{[{%#].*?[}%#]\}", "", text, flags=re.S)
    text = re.sub(r"``[^`]+``|`[^`]+`|https?:\S+", "", text)
    return re.sub(r"\s*\n\s*(# ?)?", " ", text)


@functools.cache
def code_names(text: str) -> frozenset[str]:
    """The names in the code of a Python file."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return frozenset(
        token.string for token in tokens if token.type == tokenize.NAME
    )


def matches(rule: Rule, name: str, text: str) -> list[str]:
    """What a rule finds in a file."""
    found = []
    if rule.prose:
        pattern = rf"(?i)(?<![\w-])(?:{rule.prose})(?![\w-])"
        line = prose(name, text)
        found = [
            line[max(m.start() - 30, 0) :][:80] for m in re.finditer(pattern, line)
        ]
    if rule.names and name.endswith(".py"):
        pattern = rf"(?i)(?:^|_)(?:{rule.names})(?:_|$)"
        names = code_names(text) - PUBLIC_NAMES
        found += [one for one in names if re.search(pattern, snake_case(one))]
    return found


def snake_case(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)


@pytest.mark.parametrize("word", RULES)
def test_a_word_with_a_better_one_stays_where_it_belongs(word: str) -> None:
    rule = RULES[word]
    wrong = [
        f"{name}: {found}"
        for name, text in texts()
        if name.startswith(rule.only_in)
        # the names of their cases stand in docs/golden.json and docs/golden_quick.json
        and not name.startswith("tools/golden")
        and not any(name.startswith(start) and of == word for start, of in KEPT)
        for found in matches(rule, name, text)
    ]
    assert not wrong


def test_the_glossary_states_what_stands_in_their_place() -> None:
    assert column("| other meaning only | instead |") == list(RULES)


def test_every_exception_is_needed() -> None:
    files = dict(texts())
    names: set[str] = set().union(
        *(code_names(text) for n, text in files.items() if n[-3:] == ".py")
    )
    assert names >= PUBLIC_NAMES
    for start, word in KEPT:
        of_word = (
            matches(RULES[word], name, text)
            for name, text in files.items()
            if name.startswith(start)
        )
        assert any(of_word), (start, word)


@pytest.mark.parametrize("word", unused_words())
def test_a_word_that_is_gone_stays_away(word: str) -> None:
    found = [
        f"{name}: {match[0]}"
        for name, text in texts()
        if not (word.startswith("method ") and name.endswith(".py"))
        for match in pattern(word).finditer(text)
    ]
    assert not found


def test_the_glossary_sends_readers_to_names_that_exist() -> None:
    """A constant that stands in the place of another one is in the code."""
    code = "\n".join(text for name, text in texts() if name.endswith(".py"))
    text = GLOSSARY.read_text(encoding="utf-8")
    table = text.partition("| not used | instead |\n|---|---|\n")[2]
    table = table.partition("\n\n")[0]
    instead = [line.split("|")[2] for line in table.splitlines()]
    names = re.findall(r"`([A-Z]\w+|_\w+|\w+_\w+)`", " ".join(instead))
    assert len(names) > 10
    assert [name for name in names if not re.search(rf"\b{name}\b", code)] == []


def test_the_glossary_lists_words() -> None:
    assert len(unused_words()) > 20
    assert "mission" in unused_words()


@pytest.mark.parametrize(
    ("word", "text", "is_found"),
    [
        ("mission", "The Mission in four lines", True),
        ("mission", "permission, submission", False),
        ("`ASIDE`", "ASIDE = 0.1", True),
        ("`ASIDE`", "set aside", False),
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


@pytest.mark.parametrize(
    ("word", "text", "is_found"),
    [
        ("world", '"""A pose in the world."""', True),
        ("world", '"""A pose, camera to world, and T_world_cam."""', False),
        ("truth", '"""Errors against the truth."""', True),
        ("truth", '"""Errors against the ground\n    truth."""', False),
        ("truth", '"""Give ``truth``, or --topic-truth."""', False),
        ("share", "# a share of the pixels", True),
        ("share", "# what neighbours share", False),
        ("share", "moving_share = 0.5", True),
        ("share", "final_share = 0.5", False),
        ("seen", "seen = 1", True),
        ("how", "how = 1", True),
        ("how", "# how far it is", False),
        ("facts", "class TopicFacts: pass", True),
        ("said, says, asked", "raise ValueError('the file says no')", True),
        ("said, says, asked", "say('no')", False),
        ("trust", "print(f'{trusted} of 3')", False),
    ],
)
def test_rules_find_a_word_in_its_sense(
    word: str, text: str, is_found: bool
) -> None:
    assert bool(matches(RULES[word], "x.py", text)) == is_found
