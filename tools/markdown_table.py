"""Markdown tables, as the pages have them."""

from __future__ import annotations


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table, names left and numbers right; none without rows."""
    if not rows:
        return []
    ruler = "|---" * 1 + "|---:" * (len(header) - 1) + "|"
    return [line(header), ruler, *map(line, rows)]


def line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def number(value: float | None) -> str:
    """Three significant digits; a dash where there is none."""
    if value is None:
        return "-"
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
