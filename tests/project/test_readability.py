"""What a reader feels: the density of lines, and assignments of one value."""

from __future__ import annotations

import ast
import re

import pytest

from tests.project import source_tree as source

MAX_MEAN_LENGTH = 36.0
"""Characters of a code line without its indent, in the mean; kiss-icp has 33.7, evo 27.8."""
LONG_LINE = 80
MAX_LONG_SHARE = 0.06
"""Share of the code lines with so many characters or more."""
MAX_PACKED = 34
"""Assignments of unrelated values: today's rest, which may only fall."""


def all_code_lines() -> list[str]:
    return [
        line
        for path in source.files()
        for line in source.code_lines(
            (source.PACKAGE / path).read_text(encoding="utf-8")
        )
    ]


def test_lines_hold_one_thought() -> None:
    lengths = [len(line.strip()) for line in all_code_lines()]
    assert sum(lengths) / len(lengths) <= MAX_MEAN_LENGTH


def test_few_lines_are_long() -> None:
    lines = all_code_lines()
    long = [line for line in lines if len(line) >= LONG_LINE]
    assert len(long) <= MAX_LONG_SHARE * len(lines), "\n".join(long[:40])


def test_an_assignment_gives_one_value() -> None:
    packed = [
        f"{path}:{node.lineno}: {ast.unparse(node)[:70]}"
        for path, tree in source.files().items()
        for node in ast.walk(tree)
        if source.is_packed(node)
    ]
    assert len(packed) <= MAX_PACKED, "\n".join(packed)


def test_a_statement_makes_one_constant() -> None:
    several = [
        f"{path}:{node.lineno}"
        for path, tree in source.files().items()
        for node in tree.body
        if source.is_several_constants(node)
    ]
    assert not several


@pytest.mark.parametrize(
    ("text", "packed"),
    [
        ("a, b = 1, 2", True),
        ("a, (b, c) = x, y", True),
        ("a[0], a[1] = x, y", True),
        ("a, b = b, a", False),
        ("a, b = f(x)", False),
        ("a, b = range(2)", False),
        ("a = 1, 2", False),
    ],
)
def test_packed_assignments_are_known(text: str, packed: bool) -> None:
    node = ast.parse(text).body[0]
    assert source.is_packed(node) == packed


@pytest.mark.parametrize(
    ("text", "several"),
    [
        ("A, B = 1, 2", True),
        ("A, B = limits()", True),
        ("A = B = 1", True),
        ("A, B = range(2)", False),
        ("A = (1, 2)", False),
        ("ORDER[0] = ORDER[1] = 2", False),
    ],
)
def test_several_constants_are_known(text: str, several: bool) -> None:
    node = ast.parse(text).body[0]
    assert source.is_several_constants(node) == several


def test_comments_and_docstrings_are_no_code() -> None:
    text = '''"""Module,
of two lines."""

A = 1  # one
"""What A is."""


def f():
    """Function."""
    # nothing
    return "# text"
'''
    assert source.code_lines(text) == ["A = 1", "def f():", '    return "# text"']


RULE_OVER_TWO_LINES = re.compile(r"^# -- [^\n]*\n# -+$", re.MULTILINE)
WRAPPED_FOR_A_COMMENT = re.compile(
    r"^ *\w+(?:: | = )[^\n]*\($\n +[\w.|, \[\]]+(?:  #[^\n]*)?\n *\)(?:  #[^\n]*)?$",
    re.MULTILINE,
)
"""A type or a number alone in brackets, which only its comment has made too long."""


def test_no_line_is_broken_where_only_a_tool_would_break_it() -> None:
    scars = [
        f"{path}: {found[0]}"
        for path in source.files()
        for pattern in (RULE_OVER_TWO_LINES, WRAPPED_FOR_A_COMMENT)
        for found in pattern.finditer(
            (source.PACKAGE / path).read_text(encoding="utf-8")
        )
        if "#" in found[0]
    ]
    assert not scars, "\n".join(scars)
