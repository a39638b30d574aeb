"""The package as its source says it is: files, imports, functions, constants."""

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


def _for_types_only(tree: ast.AST) -> set[ast.AST]:
    """Nodes below ``if TYPE_CHECKING:``."""
    return {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If)
        and ast.unparse(node.test).endswith("TYPE_CHECKING")
        for part in node.body
        for inner in ast.walk(part)
    }


@cache
def imported(tree: ast.AST) -> frozenset[str]:
    """Dotted names of all that a source imports, inside functions as well, not for types alone."""
    names: set[str] = set()
    skipped = _for_types_only(tree)
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, (
                f"line {node.lineno}: relative import"
            )
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def module_name(path: str) -> str:
    """``hybridvo.data.base`` of ``data/base.py``."""
    parts = ["hybridvo", *path.removesuffix(".py").split("/")]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def own_imports() -> dict[str, set[str]]:
    """Path -> paths of the package's files that it imports."""
    by_module = {module_name(path): path for path in files()}
    found = {}
    for path, tree in files().items():
        names = {
            name for name in imported(tree) if name.split(".")[0] == "hybridvo"
        }
        targets = {
            by_module.get(name) or by_module.get(name.rpartition(".")[0]) or "?"
            for name in names
        }
        found[path] = targets - {path}
    return found


def room(path: str) -> str:
    """The folder, or the file at the top."""
    return path.split("/")[0].removesuffix(".py")


def functions() -> dict[str, int]:
    """``file:name`` -> lines of each function or method, with its docstring."""
    return {
        f"{path}:{node.name}": (node.end_lineno or 0) - node.lineno + 1
        for path, tree in files().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }


def numeric_constants() -> dict[str, int]:
    """Path -> how many module-level names in capitals hold a number or some numbers."""

    def is_numeric(value: ast.expr) -> bool:
        numbers = [
            node
            for node in ast.walk(value)
            if isinstance(node, ast.Constant)
            and isinstance(node.value, int | float)
            and not isinstance(node.value, bool)
        ]
        texts = any(
            isinstance(node, ast.Constant) and isinstance(node.value, str)
            for node in ast.walk(value)
        )
        return bool(numbers) and not texts

    found = {}
    for path, tree in files().items():
        targets = [
            (
                node.targets[0] if isinstance(node, ast.Assign) else node.target,
                node.value,
            )
            for node in tree.body
            if isinstance(node, ast.Assign | ast.AnnAssign)
            and node.value is not None
        ]
        found[path] = sum(
            isinstance(target, ast.Name)
            and target.id.lstrip("_").isupper()
            and is_numeric(value)  # type: ignore[arg-type]
            for target, value in targets
        )
    return found
