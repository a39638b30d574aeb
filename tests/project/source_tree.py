"""The package as its source says it is."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "hybridvo"


@cache
def files() -> dict[str, ast.Module]:
    """Path below the package -> its syntax tree."""
    return {
        path.relative_to(PACKAGE).as_posix(): ast.parse(
            path.read_text(encoding="utf-8")
        )
        for path in sorted(PACKAGE.rglob("*.py"))
    }


@cache
def files_of_both() -> dict[str, ast.Module]:
    """The same, and of hybridvo-lab, whose paths begin with ``hybridvo_lab/``."""
    laboratory = {
        path.relative_to(ROOT).as_posix(): ast.parse(
            path.read_text(encoding="utf-8")
        )
        for path in sorted((ROOT / "hybridvo_lab").rglob("*.py"))
    }
    return files() | laboratory


@cache
def imported(tree: ast.AST) -> frozenset[str]:
    """Dotted names of all that a source imports, inside functions as well."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def module_name(path: str) -> str:
    """``hybridvo.io.data.open`` of ``io/data/open.py``."""
    below = [] if path.startswith("hybridvo_lab/") else ["hybridvo"]
    parts = [*below, *path.removesuffix(".py").split("/")]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def constants(tree: ast.Module) -> list[str]:
    """Names that a module assigns at its top, as often as it assigns them."""
    targets = []
    for node in tree.body:
        if isinstance(node, ast.AnnAssign):
            targets.append(node.target)
        elif isinstance(node, ast.Assign):
            targets += node.targets
    return [target.id for target in targets if isinstance(target, ast.Name)]
