"""The glossary sends readers to names that exist."""

from __future__ import annotations

import re

from tests.project import source_tree as source

GLOSSARY = source.ROOT / "docs" / "glossary.md"


def names_to_use() -> list[str]:
    """The names of code that the glossary gives in place of others."""
    text = GLOSSARY.read_text(encoding="utf-8")
    table = text.partition("| not used | instead |\n|---|---|\n")[2]
    table = table.partition("\n\n")[0]
    instead = [line.split("|")[2] for line in table.splitlines()]
    return re.findall(r"`([A-Z]\w+|_\w+|\w+_\w+)`", " ".join(instead))


def test_the_glossary_sends_readers_to_names_that_exist() -> None:
    """A constant that stands in the place of another one is in the code."""
    folders = ("hybridvo", "tools", "tests")
    files = [
        path for folder in folders for path in (source.ROOT / folder).rglob("*.py")
    ]
    code = "\n".join(path.read_text(encoding="utf-8") for path in files)
    names = names_to_use()
    assert len(names) > 10
    assert [name for name in names if not re.search(rf"\b{name}\b", code)] == []
