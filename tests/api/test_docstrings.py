"""The examples in the docstrings run, and every public name has one."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any

import pytest

import hybridvo
from tests.project import source_tree as source

PUBLIC = sorted(set(hybridvo.__all__) - {"__version__"})
CHECKS = ("check_kind", "as_rigid", "as_seed", "to_numpy", "_check_image")
"""Functions that raise an InputError for a value that is of no use."""


def has_examples(tree: ast.Module) -> bool:
    """Whether a file has an example that is not skipped."""
    texts = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    lines = [line for text in texts for line in text.splitlines()]
    return any(
        line.lstrip().startswith(">>> ") and "+SKIP" not in line for line in lines
    )


MODULES = [
    source.module_name(path)
    for path, tree in source.files_of_both().items()
    if has_examples(tree)
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name: str) -> None:
    module = importlib.import_module(name)
    results = doctest.testmod(module, optionflags=doctest.IGNORE_EXCEPTION_DETAIL)
    assert results.attempted > 0
    assert results.failed == 0


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_an_example_that_runs(name: str) -> None:
    text = inspect.getdoc(getattr(hybridvo, name)) or ""
    examples = doctest.DocTestParser().get_examples(text)
    skipped = doctest.OPTIONFLAGS_BY_NAME["SKIP"]
    assert [one for one in examples if skipped not in one.options]


def public_functions() -> dict[str, Callable[..., Any]]:
    """Public functions, and the methods of public classes, by name."""
    found: dict[str, Callable[..., Any]] = {}
    for name in PUBLIC:
        value = getattr(hybridvo, name)
        if inspect.isfunction(value):
            found[name] = value
        members = vars(value).items() if inspect.isclass(value) else ()
        for member, function in members:
            plain = getattr(function, "__func__", function)
            if inspect.isfunction(plain) and not member.startswith("_"):
                found[f"{name}.{member}"] = plain
    return found


def raises(function: Callable[..., Any]) -> bool:
    """Whether a function raises, itself or by a check of its arguments."""
    text = inspect.getsource(function)
    code = text.replace(inspect.getdoc(function) or "", "")
    return bool(re.search(rf"\braise\b|\b({'|'.join(CHECKS)})\(", code))


FUNCTIONS = public_functions()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_says_what_it_takes_returns_and_raises(name: str) -> None:
    function = FUNCTIONS[name]
    text = inspect.getdoc(function) or ""
    parameters = set(inspect.signature(function).parameters) - {"self", "cls"}
    section = re.search(r"^Args:\n((?:    .*\n?|\n)*)", text, re.M)
    described = (
        set(re.findall(r"^    (\w+): ", section[1], re.M)) if section else set()
    )
    assert described == parameters
    gives = inspect.signature(function).return_annotation != "None"
    assert ("Returns:" in text) == gives
    if raises(function):
        assert "Raises:" in text


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_class_says_what_it_refuses(name: str) -> None:
    value = getattr(hybridvo, name)
    own = vars(value) if inspect.isclass(value) else {}
    makers = [own.get("__init__"), own.get("__post_init__")]
    if any(raises(maker) for maker in makers if maker and is_written(maker)):
        assert "Raises:" in (inspect.getdoc(value) or "")


def is_written(function: Callable[..., Any]) -> bool:
    """Whether a function stands in a file, and was not made by a decorator."""
    return function.__code__.co_filename.endswith(".py")
