"""The package as its source says it is: files, imports, functions, constants."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "hybridvo"
CLASSES = ROOT / "tests" / "project" / "numbers.yaml"
"""The class of every number that does not decide an answer, by hand."""
DECIDES = "decides"
"""Heading of the numbers that decide and yet stand elsewhere than in ``calibration.py``."""


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
def imported(tree: ast.AST, for_types: bool = False) -> frozenset[str]:
    """Dotted names of all that a source imports, inside functions as well.

    Imports under ``if TYPE_CHECKING:`` count where ``for_types`` is set.
    """
    names: set[str] = set()
    skipped = set() if for_types else _for_types_only(tree)
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
    """``hybridvo.io.data.open`` of ``data/open.py``."""
    parts = ["hybridvo", *path.removesuffix(".py").split("/")]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def own_imports(for_types: bool = False) -> dict[str, set[str]]:
    """Path -> paths of the package's files that it imports; see :func:`imported`."""
    by_module = {module_name(path): path for path in files()}
    found = {}
    for path, tree in files().items():
        names = {
            name
            for name in imported(tree, for_types)
            if name.split(".")[0] == "hybridvo"
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


# --- numbers --------------------------------------------------------------------------

TRIVIAL = {0.0, 0.5, 1.0, 2.0, 90.0, 100.0, 180.0, 255.0, 360.0, 1000.0}
"""Numbers that decide nothing: halves and doubles, angles, per cent, units, grey levels."""
SMALLEST = 1e-5
"""Smaller numbers guard divisions and logarithms."""
SMALL_INTEGER = 3
"""Integers up to this one count dimensions, steps and neighbours."""
WITHOUT_ANSWERS = {"core/options.py"}
"""Files whose numbers are not counted, beside the calibrations: the documented options."""
WITHOUT_ANSWERS_ROOMS = ("lab/synthetic/", "lab/training/")
"""Rooms that draw scenes and train networks: no answer depends on their numbers."""


def numeric_constants() -> dict[str, list[str]]:
    """Numbers outside ``calibration.py`` on which an answer may depend, by file.

    Most of them decide nothing: ``numbers.yaml`` has the class of each.

    They are found in constants of a module, alone or several in one statement, in the defaults of
    parameters and fields, and in bodies of functions: there decimal fractions everywhere, integers
    where something is compared with them. Names of rows (``A, B = range(2)``) are no numbers.
    """
    return {
        path: [*_in_constants(tree), *_in_defaults(tree), *_in_bodies(tree)]
        for path, tree in files().items()
        if path not in WITHOUT_ANSWERS
        and not path.endswith("/calibration.py")
        and not path.startswith(WITHOUT_ANSWERS_ROOMS)
    }


class Number(NamedTuple):
    """A number outside of ``calibration.py``."""

    path: str
    text: str  # as :func:`numeric_constants` prints it
    heading: str | None  # its class in ``numbers.yaml``


def classified() -> list[tuple[str, str, str]]:
    """Heading, path and entry of all that ``numbers.yaml`` holds."""
    headings = yaml.safe_load(CLASSES.read_text(encoding="utf-8"))
    return [
        (heading, path, entry)
        for heading, paths in headings.items()
        for path, entries in paths.items()
        for entry in entries
    ]


def entries_of(text: str) -> set[str]:
    """What stands for a number in ``numbers.yaml``: its text, or the name of a constant."""
    name = text.partition(" = ")[0]
    return {text} if "(" in name or ": " in name else {text, name}


def numbers_with_class() -> list[Number]:
    """The numbers of :func:`numeric_constants`, each with its class."""
    headings = {(path, entry): heading for heading, path, entry in classified()}

    def heading_of(path: str, text: str) -> str | None:
        found = (headings.get((path, entry)) for entry in entries_of(text))
        return next(filter(None, found), None)

    return [
        Number(path, text, heading_of(path, text))
        for path, texts in numeric_constants().items()
        for text in texts
    ]


def _numbers(tree: ast.AST) -> list[int | float]:
    """The numbers below a node that are not trivial."""
    return [
        value
        for value in _all_numbers(tree)
        if value >= SMALLEST
        and value not in TRIVIAL
        and (isinstance(value, float) or value > SMALL_INTEGER)
    ]


def _all_numbers(tree: ast.AST) -> list[int | float]:
    """The numbers below a node, of which True and False are none."""
    values = [
        node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)
    ]
    return [
        value
        for value in values
        if isinstance(value, int | float) and not isinstance(value, bool)
    ]


def assigned(node: ast.stmt) -> list[tuple[str, ast.expr]]:
    """Names that a statement assigns, each with its value; of a tuple the parts of both."""
    if isinstance(node, ast.AnnAssign) and node.value is not None:
        return [(ast.unparse(node.target), node.value)]
    if not isinstance(node, ast.Assign):
        return []
    found: list[tuple[str, ast.expr]] = []
    for target in node.targets:
        if not isinstance(target, ast.Tuple):
            found.append((ast.unparse(target), node.value))
        elif isinstance(node.value, ast.Tuple):
            names = map(ast.unparse, target.elts)
            found += zip(names, node.value.elts, strict=False)
        else:
            found += ((ast.unparse(name), node.value) for name in target.elts)
    return found


def _in_constants(tree: ast.Module) -> Iterator[str]:
    """Module-level names in capitals that hold numbers; a name counts once."""
    for node in tree.body:
        for name, value in assigned(node):
            is_rows = isinstance(value, ast.Call) and "range" in ast.unparse(value)
            texts = any(
                isinstance(part, ast.Constant) and isinstance(part.value, str)
                for part in ast.walk(value)
            )
            if name.lstrip("_").isupper() and not is_rows and not texts:
                if _all_numbers(value):
                    yield f"{name} = {ast.unparse(value)[:60]}"


def _in_defaults(tree: ast.Module) -> Iterator[str]:
    """Defaults of parameters, and of the fields of classes; shapes of arrays are none."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            name = getattr(node, "name", "lambda")
            values = [*node.args.defaults, *filter(None, node.args.kw_defaults)]
            for value in values:
                yield from (f"{name}(... = {number})" for number in _numbers(value))
        elif isinstance(node, ast.ClassDef):
            for field in node.body:
                for name, value in assigned(field):
                    if isinstance(value, ast.Call):
                        continue
                    for number in _numbers(value):
                        yield f"{node.name}.{name} = {number}"


def _in_bodies(tree: ast.Module) -> Iterator[str]:
    """Numbers in the bodies of functions."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        compared = {
            id(part)
            for inside in ast.walk(node)
            if isinstance(inside, ast.Compare)
            for part in [inside.left, *inside.comparators]
        }
        for statement in node.body:
            for part in ast.walk(statement):
                if isinstance(part, ast.Constant) and (
                    isinstance(part.value, float) or id(part) in compared
                ):
                    yield from (
                        f"{node.name}: {number}" for number in _numbers(part)
                    )


# --- what a line is like to read ------------------------------------------------------


def code_lines(source: str) -> list[str]:
    """Lines that hold code, without comments, docstrings and what trails them."""
    lines = source.splitlines()
    skipped: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            skipped.update(range(node.lineno, (node.end_lineno or 0) + 1))
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    return [
        line.rstrip()
        for number, line in enumerate(lines, 1)
        if number not in skipped and line.strip()
    ]


def is_packed(node: ast.AST) -> bool:
    """Whether an assignment gives unrelated values to several names at once.

    A swap does not, nor what unpacks the result of one call.
    """
    if not isinstance(node, ast.Assign):
        return False
    target = node.targets[0]
    value = node.value
    if not isinstance(target, ast.Tuple) or not isinstance(value, ast.Tuple):
        return False
    names = sorted(map(ast.unparse, target.elts))
    return names != sorted(map(ast.unparse, value.elts))


def is_several_constants(node: ast.stmt) -> bool:
    """Whether one statement at the top of a module makes several constants."""
    if not isinstance(node, ast.Assign):
        return False
    is_tuple = isinstance(node.targets[0], ast.Tuple)
    is_rows = (
        isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "range"
    )
    names = [name for name in node.targets if isinstance(name, ast.Name)]
    return (is_tuple and not is_rows) or len(names) > 1
