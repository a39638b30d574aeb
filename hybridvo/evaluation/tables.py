"""Numbers to files and tables: JSON, CSV, Markdown and text for terminals.

Numbers are written in full (Python's shortest form that reads back to the same float), tables for
people are rounded. What cannot be computed is ``null`` in JSON, empty in CSV and a dash in tables.
"""

from __future__ import annotations

import csv
import enum
import io
import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.files import atomic_write

__all__ = ["jsonable", "table_markdown", "table_text", "to_json", "write_csv", "write_json"]

MISSING = "-"
"""What a table shows where there is no number."""


def jsonable(value: Any) -> Any:
    """Plain JSON value: NaN and inf become None, arrays lists, paths and enums their text.

    Raises:
        InputError: a value that JSON has no form for; the message names its type.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, enum.Enum):
        return jsonable(value.value)
    if isinstance(value, (np.bool_, np.integer, np.floating)):
        return jsonable(value.item())
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, Mapping):
        return {str(jsonable(key)): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        items = sorted(value, key=str) if isinstance(value, (set, frozenset)) else value
        return [jsonable(item) for item in items]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise InputError(f"report: a {type(value).__name__} cannot be written as JSON.")


def to_json(data: Any) -> str:
    """JSON text, keys sorted, two spaces, a final newline; floats read back to the same value."""
    text = json.dumps(jsonable(data), sort_keys=True, indent=2, ensure_ascii=False) + "\n"
    # a path that is no UTF-8 holds lone surrogates, which no file can: as escapes they read back
    return re.sub("[\ud800-\udfff]", lambda found: f"\\u{ord(found[0]):04x}", text)


def write_json(path: str | os.PathLike[str], data: Any) -> None:
    """Write :func:`to_json` of ``data``, completely or not at all.

    Raises:
        InputError: a value that JSON has no form for. OutputError: the file cannot be written.
    """
    text = to_json(data)
    with atomic_write(path) as file:
        file.write(text)


def _columns(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None) -> list[str]:
    """Given columns, or all keys in the order in which they first appear."""
    return list(columns) if columns is not None else list(dict.fromkeys(k for r in rows for k in r))


def write_csv(
    path: str | os.PathLike[str],
    rows: Iterable[Mapping[str, Any]],
    columns: Sequence[str] | None = None,
) -> None:
    """Write rows as CSV with a header line, numbers in full, completely or not at all.

    Args:
        path: file to write.
        rows: mappings from column to value; None, NaN and inf become empty cells.
        columns: order of the columns; default: as they first appear. Other keys are left out.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = list(rows)
    names = _columns(rows, columns)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        cells = (jsonable(row.get(name)) for name in names)
        # repr, not str(): the same for a float, and explicit that every digit is meant
        writer.writerow([repr(c) if isinstance(c, float) else c for c in cells])
    with atomic_write(path, "wb") as file:  # a message may name a path that is no UTF-8
        file.write(text.getvalue().encode("utf-8", "backslashreplace"))


def _cell(value: Any, spec: str) -> str:
    value = jsonable(value)
    if value is None:
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return format(value, spec)
    return str(value)


def _table(
    rows: Iterable[Mapping[str, Any]],
    columns: Sequence[str] | None,
    headers: Mapping[str, str] | None,
    formats: Mapping[str, str] | None,
) -> tuple[list[str], list[list[str]], list[bool]]:
    """Header, cells, and which columns hold numbers (and stand to the right)."""
    rows = list(rows)
    names = _columns(rows, columns)
    specs = formats or {}
    cells = [[_cell(row.get(name), specs.get(name, ".4g")) for name in names] for row in rows]
    numeric = [
        any(isinstance(row.get(name), (int, float, np.number)) for row in rows)
        and not any(isinstance(row.get(name), (str, Path)) for row in rows)
        for name in names
    ]
    return [(headers or {}).get(name, name) for name in names], cells, numeric


def table_markdown(
    rows: Iterable[Mapping[str, Any]],
    columns: Sequence[str] | None = None,
    *,
    headers: Mapping[str, str] | None = None,
    formats: Mapping[str, str] | None = None,
) -> str:
    """Markdown table, numbers to the right; a missing value is a dash.

    Args:
        rows: mappings from column to value.
        columns: order of the columns; default: as they first appear.
        headers: text above a column, by its name.
        formats: format of a column's floats, by its name; default ``.4g``.
    """
    head, cells, numeric = _table(rows, columns, headers, formats)

    def line(items: Iterable[str]) -> str:
        return (
            "| " + " | ".join(item.replace("|", "\\|").replace("\n", " ") for item in items) + " |"
        )

    rule = "|" + "|".join("---:" if right else "---" for right in numeric) + "|"
    return "\n".join([line(head), rule, *(line(row) for row in cells)]) + "\n"


def table_text(
    rows: Iterable[Mapping[str, Any]],
    columns: Sequence[str] | None = None,
    *,
    headers: Mapping[str, str] | None = None,
    formats: Mapping[str, str] | None = None,
) -> str:
    """Table of plain text with aligned columns, for terminals; arguments of table_markdown."""
    head, cells, numeric = _table(rows, columns, headers, formats)
    widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]

    def line(items: Sequence[str]) -> str:
        padded = [
            item.rjust(width) if right else item.ljust(width)
            for item, width, right in zip(items, widths, numeric, strict=True)
        ]
        return "  ".join(padded).rstrip()

    rule = "  ".join("-" * width for width in widths)
    return "\n".join([line(head), rule, *(line(row) for row in cells)]) + "\n"
