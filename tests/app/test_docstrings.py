"""The examples in the docstrings of readers, commands and options run."""

from __future__ import annotations

import doctest
import importlib

import pytest

MODULES = (
    "hybridvo.commands.advice",
    "hybridvo.data.camera_file",
    "hybridvo.evaluation.report",
    "hybridvo.options",
    "hybridvo.data.lists",
    "hybridvo.data.resize",
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name):
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted > 0
    assert results.failed == 0
