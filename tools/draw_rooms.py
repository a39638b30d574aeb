"""Draw docs/figures/rooms.svg: the rooms of the package, each above those that it may import.

    python tools/draw_rooms.py

The order is that of the layers for import-linter in pyproject.toml, the text of a room the first
line of its docstring.
"""

from __future__ import annotations

import ast
import tomllib
from html import escape

from measuring import ROOT

OUT = ROOT / "docs/figures/rooms.svg"
WIDTH = 1080
HEIGHT = 58
GAP = 14
MARGIN = 12
LETTER = 6.4
"""Width of a letter, px."""


def layers() -> list[list[str]]:
    """Rooms side by side, from the top to the bottom."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    contracts = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    return [layer.split(" | ") for layer in contracts[0]["layers"]]


def about(room: str) -> str:
    """The first line of the docstring of a room, which is a folder or a file."""
    path = ROOT / "hybridvo" / f"{room}.py"
    if not path.is_file():
        path = ROOT / "hybridvo" / room / "__init__.py"
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0].replace("``", "").rstrip(".")


def shortened(text: str, width: float) -> str:
    """A text that fits into a box: up to its last colon or comma, or to a word."""
    letters = int(width / LETTER)
    if len(text) <= letters:
        return text
    for mark in (" (", ":", ","):
        head = text.rpartition(mark)[0]
        if head and len(head) <= letters:
            return head
    return text[: letters - 2].rpartition(" ")[0] + " ..."


def box(room: str, left: float, top: float, width: float) -> list[str]:
    """The lines of SVG of one room."""
    middle = left + width / 2
    rect = (
        f'<rect x="{left:.0f}" y="{top:.0f}" width="{width:.0f}" height="{HEIGHT}"'
    )
    name = f'<text x="{middle:.0f}" y="{top + 24:.0f}" text-anchor="middle"'
    note = f'<text x="{middle:.0f}" y="{top + 43:.0f}" text-anchor="middle"'
    return [
        f'{rect} rx="9" fill="#e3ecfa" stroke="#3b6fb5" stroke-width="1.6"/>',
        f'{name} font-weight="bold">{escape(room, quote=False)}</text>',
        f'{note} fill="#334155">{escape(shortened(about(room), width - 12), quote=False)}</text>',
    ]


def picture() -> str:
    """The whole picture."""
    rows = layers()
    height = 2 * MARGIN + len(rows) * (HEIGHT + GAP) - GAP
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        'font-family="Helvetica,Arial,sans-serif" font-size="13">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for number, rooms in enumerate(rows):
        top = MARGIN + number * (HEIGHT + GAP)
        width = (WIDTH - 2 * MARGIN - GAP * (len(rooms) - 1)) / len(rooms)
        for place, room in enumerate(rooms):
            lines += box(room, MARGIN + place * (width + GAP), top, width)
    return "\n".join([*lines, "</svg>\n"])


if __name__ == "__main__":
    OUT.write_text(picture(), encoding="utf-8")
